use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::{Tensor, constant_buffer};
use super::{Device, GpuError};
use crate::network::Arm;

/// The `joints` `[18, 1, 1]`, moved to where the `arm` can have them (`shaders/kinematic_fit.wgsl`), to `output` of the same
/// shape.
///
/// # Errors
/// More images than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
pub fn kinematic_fit(
    device: &Device,
    joints: &Tensor,
    output: &Tensor,
    arm: &Arm,
) -> Result<Step, GpuError> {
    let links = arm.bodies.iter().flat_map(|links| links.values());
    let matrices = [&arm.across, &arm.along].into_iter().flatten().flatten();
    let values: Vec<f32> = links.chain(matrices.copied()).collect();
    let buffer = constant_buffer(device, "kinematic_fit: arm", &values)?;
    let tensors = Tensors::from_to(joints, output);
    Step::new(
        device,
        &StepDescriptor {
            label: "kinematic_fit",
            kernel: "kinematic_fit",
            source: include_str!("../../shaders/kinematic_fit.wgsl"),
            entry_point: "main",
            tensors,
            constants: &[("BODIES", arm.bodies.len() as f64)],
            sizes: &[],
            bindings: &[(3, buffer.as_entire_binding())],
            workgroups: joints.batch,
            work: Work::new(tensors, values.len(), 0),
        },
    )
}
