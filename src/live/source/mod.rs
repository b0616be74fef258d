//! Where frames come from.

mod child;
mod ffmpeg;
mod folder;
mod lateness;
mod location;
mod pace;
mod recording;
mod showinfo;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use image::RgbaImage;

pub use location::Location;

use super::Stop;
use crate::camera::{Camera, CameraError};
use crate::recording::RecordingError;

/// What gives a camera's frames. It is opened again after it failed, unless it has an end.
pub trait Source: Send {
    /// Opens it. Whoever waits for a frame of it returns soon after `stop` is set.
    ///
    /// # Errors
    /// What keeps it from being opened now; it may be tried again.
    fn open(&mut self, stop: &Arc<Stop>) -> Result<Box<dyn Stream>, SourceError>;

    /// Whether it is of a length of its own, as a file is. Opened again, it would begin again.
    fn ends(&self) -> bool {
        false
    }
}

/// A source that is open; dropped, it is closed.
pub trait Stream {
    /// Waits for the next frame and makes `image` it. `None` at the source's end, or when everything is to stop.
    ///
    /// # Errors
    /// [`SourceError::Frame`] for a frame that is none: the stream goes on with the next one. After any other,
    /// it is of no use any more.
    fn next(&mut self, image: &mut RgbaImage) -> Result<Option<Shot>, SourceError>;
}

/// What there is to know about a frame besides its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// When it was taken, by the wall clock.
    pub acquired: SystemTime,
    /// The same by the monotonic clock.
    pub acquired_at: Instant,
    /// Its camera, where the source knows: of the image's size.
    pub camera: Option<Camera>,
    /// The file that it is all of, where it is.
    pub file: Option<Arc<Path>>,
}

impl Shot {
    /// Of a frame that is taken now.
    pub fn now() -> Self {
        Self {
            acquired: SystemTime::now(),
            acquired_at: Instant::now(),
            camera: None,
            file: None,
        }
    }

    /// Of a frame that was taken so long before.
    fn before(self, late: Duration) -> Self {
        Self {
            acquired: self.acquired.checked_sub(late).unwrap_or(self.acquired),
            acquired_at: self
                .acquired_at
                .checked_sub(late)
                .unwrap_or(self.acquired_at),
            ..self
        }
    }
}

/// Why a source gives no frames.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// A frame that is none. The next one may be.
    #[error("{0}")]
    Frame(String),
    /// The frame is not the camera's.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A recording that cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A folder that cannot be read, or has no images.
    #[error("{0}")]
    Folder(String),
    /// `ffmpeg` is not there, or cannot be started.
    #[error(
        "ffmpeg cannot be started ({0}): it reads videos, streams and webcams, and must be installed and on the PATH"
    )]
    NoFfmpeg(std::io::Error),
    /// `ffmpeg` ended, or gave something else than frames.
    #[error("{0}")]
    Ffmpeg(String),
    /// It panicked: a defect of the source.
    #[error("the source panicked: {0}")]
    Panicked(String),
    /// No frame came for so long.
    #[error("no frame for {0:?}")]
    Stalled(Duration),
    /// Its frames came so late.
    #[error("frames come {0:.1?} late: they are not decoded as fast as they are taken")]
    Late(Duration),
}
