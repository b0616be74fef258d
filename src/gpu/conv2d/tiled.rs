use super::{Conv2d, planes};
use crate::gpu::step::Step;
use crate::gpu::tensor::blocks;
use crate::gpu::{Device, GpuError};

/// Invocations of a workgroup, as in the kernel.
const GROUP: usize = 64;

/// How `shaders/conv2d_tiled.wgsl` cuts a layer into workgroups.
#[derive(Debug, Clone, Copy)]
pub struct Tiling {
    /// Pixels an invocation makes.
    pixels: usize,
    /// Pairs of output blocks a workgroup makes: a power of two.
    pairs: usize,
    /// Input blocks that it brings at a time.
    step: usize,
    /// Pixels a workgroup makes.
    tile: usize,
    padded_in: usize,
    padded_out: usize,
    tiles: usize,
}

impl Tiling {
    pub fn new(conv: &Conv2d<'_>, pixels: usize) -> Self {
        let shape = conv.output.shape;
        let in_blocks = blocks(conv.input.shape.channels);
        let out_blocks = blocks(shape.channels);
        let pairs = out_blocks.div_ceil(2).next_power_of_two().min(4);
        let step = in_blocks.min(pairs);
        let tile = GROUP / pairs * pixels;
        Self {
            pixels,
            pairs,
            step,
            tile,
            padded_in: in_blocks.next_multiple_of(step),
            padded_out: out_blocks.next_multiple_of(2 * pairs),
            tiles: conv.output.batch * (shape.height * shape.width).div_ceil(tile),
        }
    }

    pub fn workgroups(&self) -> usize {
        self.tiles * (self.padded_out / (2 * self.pairs))
    }
}

/// `shaders/conv2d_tiled.wgsl`: every convolution between buffers, with `pixels` pixels an invocation. Many
/// need few reads, few make more workgroups.
pub fn tiled(device: &Device, conv: &Conv2d<'_>, pixels: usize) -> Result<Step, GpuError> {
    let tiling = Tiling::new(conv, pixels);
    let source = concat!(
        include_str!("../../../shaders/conv2d_planes.wgsl"),
        include_str!("../../../shaders/conv2d_tiled.wgsl")
    );
    planes(
        device,
        conv,
        ("conv2d_tiled", source),
        &[
            ("PIXELS", tiling.pixels),
            ("PAIRS", tiling.pairs),
            ("STEP", tiling.step),
            ("STAGED", (tiling.step * tiling.tile).div_ceil(GROUP)),
        ],
        &conv.packed_matrices(tiling.padded_in, tiling.padded_out),
        tiling.padded_out,
        tiling.workgroups(),
    )
}
