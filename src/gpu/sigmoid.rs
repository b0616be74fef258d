use super::step::{Step, StepDescriptor};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// `1 / (1 + exp(-x))` of each value (`shaders/sigmoid.wgsl`).
pub(super) fn sigmoid(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    Step::new(
        device,
        &StepDescriptor {
            label,
            source: include_str!("../../shaders/sigmoid.wgsl"),
            entry_point: "main",
            constants: &[("LENGTH", input.texels() as f64)],
            bindings: &[
                (0, input.buffer.as_entire_binding()),
                (1, output.buffer.as_entire_binding()),
            ],
            workgroups: input.texels().div_ceil(64),
        },
    )
}
