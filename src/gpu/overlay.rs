use super::step::{Step, Tensors};
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
    Step::by_texel(
        device,
        "overlay",
        ("overlay", include_str!("../../shaders/overlay.wgsl")),
        &rule_constants(rule),
        Tensors::both_to(image, mask, output),
    )
}

/// What the kernels that make an overlay know of its `rule`.
pub(super) fn rule_constants(rule: Overlay) -> [(&'static str, f64); 2] {
    let (soft, threshold) = match rule {
        Overlay::Multiply {} => (1.0, 0.0),
        Overlay::Threshold { threshold } => (0.0, f64::from(threshold)),
    };
    [("SOFT", soft), ("THRESHOLD", threshold)]
}
