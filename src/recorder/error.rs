use std::path::PathBuf;

use crate::gpu::GpuError;
use crate::recording::RecordingError;
use crate::robot::RobotError;

/// Why a recording could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecorderError {
    /// The robot's description cannot be used.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// The description is of another robot than the name that the recording is to carry.
    #[error(
        "{}: expected the arm of a {robot}, {expected:.2} m from shoulder to elbow to wrist, found {}",
        urdf.display(),
        found.map_or("none of six joints".to_owned(), |found| format!("one of {found:.2} m"))
    )]
    OtherRobot {
        /// The description.
        urdf: PathBuf,
        /// The name.
        robot: String,
        /// How long its arm is, in metres.
        expected: f64,
        /// How long the description's is; `None` where it has not six joints.
        found: Option<f64>,
    },
    /// What is in the output folder cannot be continued, or not be written.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A file or folder could not be read or written.
    #[error("{}: {cause}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// No picture in the folder could be used as a background.
    #[error("{}: expected at least one readable JPEG or PNG picture, found none", path.display())]
    NoBackgrounds {
        /// The folder.
        path: PathBuf,
    },
    /// A background could not be decoded, or a picture not encoded.
    #[error("{}: {cause}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// What the codec said.
        cause: image::ImageError,
    },
    /// No scene that keeps the rules (camera, coverage, no collision) was found.
    #[error("sample {id}: found no pose without collision that fills the picture as asked")]
    NoScene {
        /// The sample's number.
        id: u64,
    },
    /// A sweep of the joints has too few poses that a fixed camera can see.
    #[error(
        "expected {wanted} poses without collision and with all joints in the picture, found {found}"
    )]
    TooFewPoses {
        /// How many samples were asked for.
        wanted: usize,
        /// How many poses there are.
        found: usize,
    },
    /// The GPU could not draw.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl RecorderError {
    /// Attaches the path to an input or output error, for `map_err`.
    pub(super) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |cause| Self::Io { path, cause }
    }
}
