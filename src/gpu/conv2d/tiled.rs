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
        // Few pixels leave room to bring more at a time, and wait for it less often.
        let step = in_blocks.min(pairs * (4 / pixels).max(1));
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
    let weights = conv.packed_matrices(tiling.padded_in, tiling.padded_out);
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
            ("VALUES_EACH", (tiling.step * tiling.tile).div_ceil(GROUP)),
            (
                "TAPS_EACH",
                (tiling.step * tiling.pairs * 8).div_ceil(GROUP),
            ),
        ],
        &[(3, conv.weights(device, &weights)?.as_entire_binding())],
        tiling.padded_out,
        tiling.workgroups(),
    )
}
