use std::sync::{Arc, Mutex, PoisonError};
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
        /// `None` where it is not tried again.
        retry_in: Option<Duration>,
    },
    /// The engine does not take a camera's frames.
    Refused { camera: usize, reason: String },
    /// A source came to its end.
    Ended { camera: usize },
    /// A frame was searched.
    Answered(Answer),
    /// The GPU failed.
    DeviceLost { reason: String },
    /// The GPU is back.
    DeviceBack,
}

/// What was found in a frame, for the first who takes it.
#[derive(Debug, Clone, Default)]
pub(super) struct Answer(Arc<Mutex<Option<Box<Observation>>>>);

impl Answer {
    pub fn new(observation: Observation) -> Self {
        Self(Arc::new(Mutex::new(Some(Box::new(observation)))))
    }

    pub fn take(&self) -> Option<Box<Observation>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}
