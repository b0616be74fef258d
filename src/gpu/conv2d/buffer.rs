use super::{Conv2d, planes};
use crate::gpu::step::Step;
use crate::gpu::tensor::blocks;
use crate::gpu::{Device, GpuError};

/// Pixels an invocation makes, as in the kernel.
const COLUMNS: usize = 4;

/// `shaders/conv2d_buffer.wgsl`: every convolution between buffers, on every adapter.
pub fn buffer(device: &Device, conv: &Conv2d<'_>) -> Result<Step, GpuError> {
    let output = conv.output;
    let taps = conv.kernel * conv.kernel;
    let (in_blocks, out_blocks) = (
        blocks(conv.input.shape.channels),
        blocks(output.shape.channels),
    );
    // [out block][row][column][in block] of 4 x 4 matrices, a column of four outputs for each input.
    let weights = conv.packed(out_blocks * taps * in_blocks * 16, |[o, i, row, column]| {
        let matrix = (o / 4 * taps + row * conv.kernel + column) * in_blocks + i / 4;
        matrix * 16 + i % 4 * 4 + o % 4
    });
    let tiles = output.shape.width.div_ceil(COLUMNS);
    let invocations = output.batch * out_blocks.div_ceil(2) * output.shape.height * tiles;
    let source = concat!(
        include_str!("../../../shaders/conv2d_planes.wgsl"),
        include_str!("../../../shaders/conv2d_buffer.wgsl")
    );
    planes(
        device,
        conv,
        ("conv2d_buffer", source),
        &[],
        &[(3, conv.weights(device, &weights)?.as_entire_binding())],
        out_blocks,
        invocations.div_ceil(64),
    )
}
