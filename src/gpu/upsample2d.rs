use super::step::Step;
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// Bilinear enlargement by `scale` (`shaders/upsample2d.wgsl`).
pub(super) fn upsample2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    scale: usize,
) -> Result<Step, GpuError> {
    let planes = input.batch * blocks(input.shape.channels);
    Step::from_to(
        device,
        label,
        ("upsample2d", include_str!("../../shaders/upsample2d.wgsl")),
        &[
            ("PLANES", planes as f64),
            ("IN_HEIGHT", input.shape.height as f64),
            ("IN_WIDTH", input.shape.width as f64),
            ("SCALE", scale as f64),
        ],
        (input, output),
        output.texels(),
    )
}
