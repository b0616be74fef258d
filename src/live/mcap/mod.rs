//! `--record`: what cameras saw and what was found in it, in an MCAP file that Foxglove, Rerun and `ros2 bag` open.
//!
//! ROS 2 messages in CDR, with their definitions as `ros2msg`, of the types that ROS 2 comes with (profile `ros2`). `NAME` is the
//! camera's, with `_` in place of what a ROS name cannot hold.
//!
//! | topic | type | of each |
//! |---|---|---|
//! | `/NAME/image/compressed` | `sensor_msgs/msg/CompressedImage` | answer: the frame as it was searched, JPEG |
//! | `/NAME/mask/compressed` | `sensor_msgs/msg/CompressedImage` | answer: 255 times each pixel's probability, PNG, mono8, of the image's size |
//! | `/NAME/camera_info` | `sensor_msgs/msg/CameraInfo` | answer |
//! | `/NAME/joints` | `visualization_msgs/msg/MarkerArray` | answer: the arm as a line, joints as spheres with their names, metres; without joints, all is deleted |
//! | `/NAME/joint_poses` | `geometry_msgs/msg/PoseArray` | answer: joints in the model's order, metres; orientations say nothing; empty without joints |
//! | `/NAME/status` | `diagnostic_msgs/msg/DiagnosticArray` | answer and event |
//! | `/tf` | `tf2_msgs/msg/TFMessage` | answer: how `NAME_optical` lies in `NAME_link` (x forward, y left, z up) |
//! | `/status` | `diagnostic_msgs/msg/DiagnosticArray` | event of all cameras |
//! | `/statistics` | `diagnostic_msgs/msg/DiagnosticArray` | second |
//!
//! Everything is in the frame `NAME_optical` (REP 103: x right, y down, z forward). What an answer says is stamped, logged and
//! published with the frame's acquisition time, and its sequence number is the frame's.

mod definitions;
mod encode;
mod messages;
mod recorder;

use std::path::PathBuf;

pub use encode::RecordedCamera;
pub use recorder::Recorder;

/// Why a recording could not be made, or ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum McapError {
    /// The file is there already.
    #[error("{}: expected a new file, found one that is never overwritten", file.display())]
    Taken {
        /// The file.
        file: PathBuf,
    },
    /// The file could not be made.
    #[error("{}: {cause}", file.display())]
    Create {
        /// The file.
        file: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// The file could not be written. What was written before can be read: it lacks an index, which `mcap recover` and
    /// `ros2 bag reindex` make.
    #[error("{}: the recording ended early, and can be read as far as it got: {cause}", file.display())]
    Write {
        /// The file.
        file: PathBuf,
        /// What the system said.
        cause: mcap::McapError,
    },
    /// A message could not be made.
    #[error("{}: the recording ended early: {message}", file.display())]
    Message {
        /// The file.
        file: PathBuf,
        /// What could not be made, and why.
        message: String,
    },
    /// What was waiting could not be written in the time there is at the end.
    #[error("{}: what was waiting could not be written within {} ms: the file has no index", file.display(), limit.as_millis())]
    Unfinished {
        /// The file.
        file: PathBuf,
        /// How long there is.
        limit: std::time::Duration,
    },
    /// Two cameras would have the same topics.
    #[error(
        "cameras `{first}` and `{second}` would both be /{topic} in the recording: give one another name"
    )]
    SameTopic {
        /// The one's name.
        first: String,
        /// The other's.
        second: String,
        /// What both become.
        topic: String,
    },
}
