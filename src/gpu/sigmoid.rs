use super::step::{Step, Tensors};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// `1 / (1 + exp(-x))` of each value (`shaders/sigmoid.wgsl`).
pub(super) fn sigmoid(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    Step::by_texel(
        device,
        label,
        ("sigmoid", include_str!("../../shaders/sigmoid.wgsl")),
        &[],
        Tensors::from_to(input, output),
    )
}
