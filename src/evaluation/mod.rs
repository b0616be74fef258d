//! How good a model is: the paper's measures (section 5), and those that it leaves out.
//!
//! Errors are distances in centimetres, in the camera optical frame, or in pixels of the image as given.
//! Masks are judged at the networks' size, on photos at the photo's.

mod error;
mod figures;
mod measures;
#[cfg(feature = "cli")]
mod photo;
mod rig;
mod score;

pub use error::{EvaluationError, NotFinite};
pub use figures::{Figures, JointFigures, MaskFigures, NamedJoint, Presence, Statuses};
pub use measures::{MaskCounts, Summary, distances_cm, distances_px};
#[cfg(feature = "cli")]
pub use photo::{Annotation, JointMark, PhotoFigures, PhotoScore, Scene, read_annotations};
pub use rig::{PoseFigures, RigFigures, RigFrame, TogetherFigures};
pub use score::{BARELY_IN_VIEW, JointErrors, JointScore, Score, network_mask};
