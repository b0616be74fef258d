use super::step::Step;
use super::tensor::Tensor;
use super::{Device, GpuError};

/// Slopes and the logarithm of depth to points (`shaders/back_project.wgsl`).
pub(super) fn back_project(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    let joints = input.shape.channels / 3;
    Step::from_to(
        device,
        label,
        (
            "back_project",
            include_str!("../../shaders/back_project.wgsl"),
        ),
        &[("JOINTS", joints as f64), ("BATCH", input.batch as f64)],
        (input, output),
        input.batch * joints,
    )
}
