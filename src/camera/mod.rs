//! Cameras: intrinsics, lens distortion, projection.
//!
//! Points are in the camera optical frame of REP 103 (x right, y down, z forward, metres);
//! pixel (0, 0) is the centre of the top-left pixel.

mod calibration;
mod camera_info;
mod gaze;
pub mod graphics;
mod intrinsics;
mod lens;
mod orientation;
mod rectification;
mod unrectification;

pub use calibration::{Camera, CameraError};
pub use gaze::Gaze;
pub use image::metadata::Orientation;
pub use intrinsics::Intrinsics;
pub use lens::{Distortion, Lens};
pub use orientation::{Crop, Texels};
pub use rectification::Rectification;
pub use unrectification::Unrectification;
