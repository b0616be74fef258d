use super::step::{Step, StepDescriptor, Work};
use super::tensor::Tensor;
use super::{Device, GpuError};
use crate::network::Overlay;

/// The joint network's input (`shaders/overlay.wgsl`): `image` `[3, height, width]` masked by `mask`
/// `[1, height, width]`.
///
/// # Errors
/// More pixels than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
pub fn overlay(
    device: &Device,
    image: &Tensor,
    mask: &Tensor,
    output: &Tensor,
    rule: Overlay,
) -> Result<Step, GpuError> {
    let (soft, threshold) = match rule {
        Overlay::Multiply {} => (true, 0.0),
        Overlay::Threshold { threshold } => (false, threshold),
    };
    Step::new(
        device,
        &StepDescriptor {
            label: "overlay",
            kernel: "overlay",
            source: include_str!("../../shaders/overlay.wgsl"),
            entry_point: "main",
            constants: &[
                ("PIXELS", mask.texels() as f64),
                ("SOFT", f64::from(u8::from(soft))),
                ("THRESHOLD", f64::from(threshold)),
            ],
            bindings: &[
                (0, image.buffer.as_entire_binding()),
                (1, mask.buffer.as_entire_binding()),
                (2, output.buffer.as_entire_binding()),
            ],
            workgroups: mask.texels().div_ceil(64),
            work: Work::new(&[image, mask], 0, 0, output),
        },
    )
}
