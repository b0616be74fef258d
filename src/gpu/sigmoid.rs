use super::step::Step;
use super::tensor::Tensor;
use super::{Device, GpuError};

/// `1 / (1 + exp(-x))` of each value (`shaders/sigmoid.wgsl`).
pub(super) fn sigmoid(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    Step::from_to(
        device,
        label,
        ("sigmoid", include_str!("../../shaders/sigmoid.wgsl")),
        &[("LENGTH", input.texels() as f64)],
        (input, output),
        input.texels(),
    )
}
