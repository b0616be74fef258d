//! Where cameras are, told by the robot that they see: rigid registration of joints, and rigs of cameras.
//!
//! The paper (section 6) replaces hand-eye calibration with this: joints that are known in a camera's frame and in
//! another frame give the transform between the two. Pure geometry: no GPU, no files. Points are in metres; a frame is
//! a camera's optical frame (REP 103), or the robot's base frame.

mod eigen;
mod error;
mod registration;
mod rig;
mod smoothing;

pub use error::RegistrationError;
pub use registration::{Pair, Registration, kabsch, register};
pub use rig::{CameraPose, FusedJoint, Rig, RigOptions, Spread};
pub use smoothing::Smoother;
