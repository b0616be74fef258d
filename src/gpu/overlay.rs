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
        (
            "overlay",
            concat!(
                include_str!("../../shaders/overlay_share.wgsl"),
                include_str!("../../shaders/overlay.wgsl")
            ),
        ),
        &share_constants(rule),
        Tensors::both_to(image, mask, output),
    )
}

/// The constants of `shaders/overlay_share.wgsl`.
pub(super) fn share_constants(rule: Overlay) -> [(&'static str, f64); 2] {
    let (low, high) = rule.bounds();
    [("LOW", low.into()), ("HIGH", high.into())]
}
