//! Recordings on disk, rendered ones and a lab's own: reading and writing them.
//!
//! Points are in metres, in the camera optical frame (x right, y down, z forward) or in the robot's
//! base frame (the frame of the first joint's parent link, z up), as each name says.

mod error;
mod format;
mod reader;

pub use error::RecordingError;
pub use format::{FORMAT, FRAME, Header, Protocol, Sample, Source, SourceKind, VERSION, Writer};
pub use reader::Reader;
