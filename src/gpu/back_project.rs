use super::step::{Step, Tensors};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// Slopes and the logarithm of depth to points (`shaders/back_project.wgsl`).
pub(super) fn back_project(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    Step::by_texel(
        device,
        label,
        (
            "back_project",
            include_str!("../../shaders/back_project.wgsl"),
        ),
        &[("JOINTS", (input.shape.channels / 3) as f64)],
        Tensors::from_to(input, output),
    )
}
