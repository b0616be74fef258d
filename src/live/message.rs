use std::time::{Duration, Instant};

use super::Observation;

/// What threads tell the one that calls the sinks.
#[derive(Debug)]
pub(super) enum Message {
    /// A frame came.
    Arrived { camera: usize, at: Instant },
    /// A source failed.
    Failed {
        camera: usize,
        reason: String,
        retry_in: Duration,
    },
    /// A source came to its end.
    Ended { camera: usize },
    /// A frame was searched.
    Answered(Box<Observation>),
    /// The GPU failed.
    DeviceLost { reason: String },
    /// The GPU is back.
    DeviceBack,
}
