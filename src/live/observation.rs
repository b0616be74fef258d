use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use image::RgbaImage;

use super::Fused;
use super::warning::{ActionReport, Warning};
use crate::camera::Camera;
use crate::cascade::Estimate;

/// What was found in one frame of one camera.
#[derive(Debug, Clone)]
pub struct Observation {
    /// The camera's place in the configuration.
    pub camera: usize,
    /// The frame's number among all that the source gave, from 0: gaps are frames that were dropped.
    pub frame: u64,
    /// When the frame was taken, by the wall clock; by the recording's own pace for recordings.
    pub acquired: SystemTime,
    /// The same by the monotonic clock, which ages are measured with.
    pub acquired_at: Instant,
    /// When the answer was there.
    pub answered_at: Instant,
    /// The file that the frame is all of, where its source is a folder of images.
    pub file: Option<Arc<Path>>,
    /// The frame as it was searched: upright, of `view`'s size.
    pub image: Arc<RgbaImage>,
    /// The camera of that image.
    pub view: Camera,
    /// What was found, in that image and in the camera's optical frame; with a mask where a sink asked for masks.
    pub estimate: Estimate,
}

impl Observation {
    /// From the frame's acquisition to its answer.
    pub fn age(&self) -> Duration {
        self.answered_at.saturating_duration_since(self.acquired_at)
    }
}

/// Something that happened to a camera, or to all (`camera` is `None`).
#[derive(Debug, Clone)]
pub struct Event {
    /// When, by the wall clock.
    pub at: SystemTime,
    /// The camera's place in the configuration.
    pub camera: Option<usize>,
    /// What.
    pub kind: EventKind,
}

/// What can happen to a camera.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum EventKind {
    /// Its source gives frames, for the first time or again.
    Live,
    /// No frame for longer than two frame periods and 100 ms.
    Stale,
    /// Its source failed, or its frames cannot be searched; it is tried again after `retry_in`.
    Failed {
        /// Why.
        reason: String,
        /// When it is tried again; `None` where it is not.
        retry_in: Option<Duration>,
    },
    /// Its source came to its end.
    Ended,
    /// The GPU failed; frames are lost until a device is open again.
    DeviceLost {
        /// Why.
        reason: String,
    },
    /// A device is open again.
    DeviceBack,
    /// A warning rule's state changed; the camera is the one that changed it.
    Warning(Warning),
    /// An action was done for a warning, or failed.
    Action(ActionReport),
}

/// A camera's figures over the last second.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Rates {
    /// Frames that its source gave, a second.
    pub frames_per_s: f64,
    /// Answers, a second.
    pub answers_per_s: f64,
    /// Frames that got no answer, since the start: replaced by newer ones before they were searched, refused by the
    /// engine, under way when a device was lost, or answered while a sink made the answer before them wait.
    pub dropped: u64,
    /// Median of the answers' ages.
    pub age_p50: Option<Duration>,
    /// 99th percentile of the answers' ages.
    pub age_p99: Option<Duration>,
}

/// Figures of the last second, of each camera in the configuration's order.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// When, by the wall clock.
    pub at: SystemTime,
    /// A camera each.
    pub cameras: Vec<Rates>,
}

/// What a sink has to say to all others.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Word {
    /// Something happened.
    Event(Event),
    /// What the cameras of a rig see together.
    Fused(Fused),
}

/// Why a sink gave up.
pub type SinkError = Box<dyn std::error::Error + Send + Sync>;

/// Where results go. Calls come from one thread, in order, and must not wait: what writes to a disk or a network has
/// a thread and a bounded queue of its own.
pub trait Sink: Send {
    /// A frame was searched.
    fn observation(&mut self, observation: &Observation);

    /// Something happened.
    fn event(&mut self, event: &Event);

    /// A second is over.
    fn statistics(&mut self, statistics: &Statistics);

    /// The cameras of a rig were put together.
    fn fused(&mut self, _: &Fused) {}

    /// Nothing more comes: what is waiting is brought to its end, within a second.
    ///
    /// # Errors
    /// Why the sink gave up, also where that was long ago and it only ignored what came since.
    fn finish(&mut self) -> Result<(), SinkError> {
        Ok(())
    }
}
