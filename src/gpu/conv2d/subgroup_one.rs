use super::{Conv2d, lattice, rows};
use crate::gpu::step::Step;
use crate::gpu::tensor::{blocks, constant_texture};
use crate::gpu::{Device, GpuError};

/// `shaders/conv2d_subgroup_one.wgsl`: a convolution between textures to one channel, of a kernel of
/// at most seven rows that reaches no farther than the input's margin.
pub fn subgroup_one(device: &Device, conv: &Conv2d<'_>) -> Result<Step, GpuError> {
    let Conv2d { label, kernel, .. } = *conv;
    // [in block][column][row, to eight] of four input channels
    let size = [8 * kernel, blocks(conv.input.shape.channels), 1];
    let weights = conv.packed(4 * size.iter().product::<usize>(), |[_, i, row, column]| {
        (i / 4 * size[0] + column * 8 + row) * 4 + i % 4
    });
    let weights = constant_texture(device, &format!("{label}: weight"), size, &weights)?;
    let source = concat!(
        include_str!("../../../shaders/conv2d_lattice.wgsl"),
        include_str!("../../../shaders/conv2d_subgroup_one.wgsl")
    );
    let kernel = ("conv2d_subgroup_one", source);
    lattice(device, conv, kernel, &weights, rows(conv), 1)
}
