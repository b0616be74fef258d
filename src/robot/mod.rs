//! Robots from their URDFs: links, joints, meshes, forward kinematics.
//!
//! Points are in metres, in the robot's base frame (the frame of the first joint's parent link, z up), a link's or a joint's, as
//! each name says.

mod error;
mod mesh;
mod urdf;

pub use error::RobotError;
pub use mesh::Mesh;
pub use urdf::{Frames, Joint, Link, Robot};
