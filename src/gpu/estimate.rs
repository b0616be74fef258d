use super::coverage::Totals;
use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// The WGSL of what [`estimate`] writes, for a host's shaders: `struct Estimate`, and the values of its
/// status. A host binds an `array<Estimate>`, one an image of the batch.
pub fn estimate_wgsl(joints: usize) -> String {
    format!(
        "const JOINTS = {joints}u;\n{}",
        include_str!("../../shaders/estimate_layout.wgsl")
    )
}

/// Bytes of an `Estimate`.
pub fn estimate_size(joints: usize) -> u64 {
    16 * (joints as u64 + 1)
}

/// Says of each image whether there is a robot, and where its joints are: from the `joints` network's
/// output `[3 joints, 1, 1]` and the [`Totals`] of its mask, of which `min_sure` pixels must surely be
/// robot. `max_radius` holds a number an image: [`Rectification::max_radius`].
///
/// # Errors
/// Driver errors reach the caller's [`Device::scoped`].
///
/// [`Rectification::max_radius`]: crate::camera::Rectification::max_radius
pub fn estimate(
    device: &Device,
    joints: &Tensor,
    totals: &wgpu::Buffer,
    max_radius: &wgpu::Buffer,
    estimates: &wgpu::Buffer,
    min_sure: u32,
) -> Result<Step, GpuError> {
    Step::new(
        device,
        &StepDescriptor {
            label: "estimate",
            kernel: "estimate",
            source: concat!(
                include_str!("../../shaders/estimate_layout.wgsl"),
                include_str!("../../shaders/estimate.wgsl")
            ),
            entry_point: "main",
            tensors: Tensors::from(joints),
            constants: &[("MIN_SURE", min_sure.into())],
            sizes: &[("JOINTS", joints.shape.channels / 3)],
            bindings: &[
                (3, totals.as_entire_binding()),
                (4, max_radius.as_entire_binding()),
                (5, estimates.as_entire_binding()),
            ],
            workgroups: joints.batch.div_ceil(64),
            work: Work {
                operations: 0,
                bytes: joints.bytes()
                    + (joints.batch * size_of::<Totals>()) as u64
                    + estimates.size(),
            },
        },
    )
}
