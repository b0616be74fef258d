use super::{Conv2d, lattice, rows};
use crate::gpu::step::Step;
use crate::gpu::tensor::{blocks, constant_texture};
use crate::gpu::{Device, GpuError};

/// The sums, what stores them, and what reads the weights.
macro_rules! source {
    ($stores:literal, $reads:literal) => {
        concat!(
            include_str!("../../../shaders/conv2d_lattice.wgsl"),
            include_str!("../../../shaders/conv2d_rows.wgsl"),
            include_str!(concat!("../../../shaders/conv2d_", $stores, ".wgsl")),
            include_str!(concat!("../../../shaders/conv2d_", $reads, ".wgsl")),
        )
    };
}

/// `shaders/conv2d_rows.wgsl`: every convolution between textures. With `subgroups` of eight or more
/// invocations they share the reading of weights (`conv2d_subgroup`), and make a max-pool too, without each
/// reads all weights (`conv2d_texture`).
pub fn texture(device: &Device, conv: &Conv2d<'_>, subgroups: bool) -> Result<Step, GpuError> {
    let Conv2d { label, output, .. } = *conv;
    let kernel = conv.kernel;
    // [pair of out blocks][in block][column][row][block of the pair][in channel] of four outputs
    let pairs = blocks(output.shape.channels).div_ceil(2);
    let size = [
        8 * kernel * kernel,
        blocks(conv.input.shape.channels),
        pairs,
    ];
    let weights = conv.packed(4 * size.iter().product::<usize>(), |[o, i, row, column]| {
        let tap = column * kernel + row;
        let texel = (o / 8 * size[1] + i / 4) * size[0] + tap * 8 + o / 4 % 2 * 4 + i % 4;
        texel * 4 + o % 4
    });
    let weights = constant_texture(device, &format!("{label}: weight"), size, &weights)?;
    // Rows that share what they read need all of their taps within the margin.
    let shared = conv.input.margin() >= Some(conv.reach());
    let rows = if shared { rows(conv) } else { 1 };
    let kernel = match (subgroups, conv.pool) {
        (true, None) => ("conv2d_subgroup", source!("pixels", "subgroup")),
        (true, Some(_)) => ("conv2d_subgroup", source!("pooled", "subgroup")),
        (false, _) => ("conv2d_texture", source!("pixels", "texture")),
    };
    lattice(device, conv, kernel, &weights, rows, pairs)
}
