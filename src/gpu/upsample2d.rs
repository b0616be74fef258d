use super::step::{Step, Tensors};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// Bilinear enlargement by `scale` (`shaders/upsample2d.wgsl`).
pub(super) fn upsample2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    scale: usize,
) -> Result<Step, GpuError> {
    Step::by_texel(
        device,
        label,
        ("upsample2d", include_str!("../../shaders/upsample2d.wgsl")),
        &[("SCALE", scale as f64)],
        Tensors::from_to(input, output),
    )
}
