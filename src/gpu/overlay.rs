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
    let (soft, threshold) = match rule {
        Overlay::Multiply {} => (true, 0.0),
        Overlay::Threshold { threshold } => (false, threshold),
    };
    Step::by_texel(
        device,
        "overlay",
        ("overlay", include_str!("../../shaders/overlay.wgsl")),
        &[
            ("SOFT", f64::from(u8::from(soft))),
            ("THRESHOLD", f64::from(threshold)),
        ],
        Tensors::both_to(image, mask, output),
    )
}
