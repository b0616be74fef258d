use super::{Conv2d, planes};
use crate::gpu::step::Step;
use crate::gpu::tensor::blocks;
use crate::gpu::{Device, GpuError};

/// Columns of a workgroup, as in the kernel, and rows of an invocation.
const LANES: usize = 32;
const ROWS: usize = 4;
/// Parts that share the input blocks, as in the kernel.
const PARTS: usize = 4;

/// `shaders/conv2d_one.wgsl`: a convolution between buffers to one channel, of a kernel of at most seven rows.
pub fn one(device: &Device, conv: &Conv2d<'_>) -> Result<Step, GpuError> {
    let (shape, kernel) = (conv.output.shape, conv.kernel);
    let padded_in = blocks(conv.input.shape.channels).next_multiple_of(PARTS);
    let texels = padded_in * kernel * kernel;
    // [in block][column][row] of four input channels
    let weights = conv.packed(4 * texels, |[_, i, row, column]| {
        ((i / 4 * kernel + column) * kernel + row) * 4 + i % 4
    });
    let lattice = conv.dilation.min(shape.height);
    let down = shape.height.div_ceil(lattice * ROWS) * lattice;
    let source = concat!(
        include_str!("../../../shaders/conv2d_planes.wgsl"),
        include_str!("../../../shaders/conv2d_one.wgsl")
    );
    planes(
        device,
        conv,
        ("conv2d_one", source),
        &[("ROWS", ROWS), ("SIDE", kernel)],
        &[(3, conv.weights(device, &weights)?.as_entire_binding())],
        1,
        conv.output.batch * down * shape.width.div_ceil(LANES),
    )
}
