//! Pictures for people: masks, tinted overlays, joints drawn along the arm.

#[cfg(feature = "cli")]
mod annotated;
mod mask;

#[cfg(feature = "cli")]
pub use annotated::{JOINT_COLOURS, annotated};
pub use mask::mask_image;
