use std::fmt;

use crate::camera::{Camera, CameraError, Orientation};

use super::Source;

/// A camera to watch.
pub struct Input {
    /// Where its frames come from.
    pub source: Box<dyn Source>,
    /// What they were taken with, where the source does not know.
    pub calibration: Calibration,
    /// What makes them upright.
    pub orientation: Orientation,
    /// The robot in view: its place among the engine's models.
    pub robot: usize,
    /// The rig that it belongs to: frames of a rig's cameras are taken at the same moment, however few go into a
    /// submission.
    pub rig: Option<usize>,
}

impl fmt::Debug for Input {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Input")
            .field("calibration", &self.calibration)
            .field("orientation", &self.orientation)
            .field("robot", &self.robot)
            .field("rig", &self.rig)
            .finish_non_exhaustive()
    }
}

/// The camera of images as a source gives them, before they are made upright.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Calibration {
    /// A ROS `camera_info`: images have its size.
    CameraInfo(Camera),
    /// Horizontal field of view, radians, of a lens without distortion.
    Hfov(f64),
    /// Nothing is known: [`Camera::assumed`].
    #[default]
    Assumed,
}

impl Calibration {
    /// The camera of images of a size.
    ///
    /// # Errors
    /// [`CameraError::Size`] where it takes images of another size.
    pub fn camera(&self, width: u32, height: u32) -> Result<Camera, CameraError> {
        match self {
            Self::CameraInfo(camera) => camera.for_image(width, height),
            Self::Hfov(hfov) => Ok(Camera::from_hfov(width, height, *hfov)),
            Self::Assumed => Ok(Camera::assumed(width, height)),
        }
    }
}
