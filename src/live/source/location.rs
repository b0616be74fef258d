use std::fs::Metadata;
use std::path::{Path, PathBuf};

use super::ffmpeg::Ffmpeg;
use super::folder::{self, Folder};
use super::recording::Recording;
use super::{Source, SourceError};

/// Where a camera's frames come from, as people write it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Location {
    /// A folder of images.
    Folder(PathBuf),
    /// A folder with a `recording.json`.
    Recording(PathBuf),
    /// A video file.
    Video(PathBuf),
    /// A webcam of Video4Linux: `/dev/video0`.
    Device(PathBuf),
    /// What has a scheme, such as `rtsp://` or `http://`.
    Stream(String),
}

impl Location {
    /// Pictures of folders and recordings, a second: the format has no times.
    pub const FPS: f64 = 30.0;

    /// Of `text`: a number is a webcam (0 is `/dev/video0`), what has `://` a stream, everything else a path
    /// from `folder` on.
    ///
    /// # Errors
    /// A path where there is nothing, or a folder without images; what was expected.
    pub fn new(text: &str, folder: &Path) -> Result<Self, String> {
        if let Ok(number) = text.parse::<u32>() {
            let path = PathBuf::from(format!("/dev/video{number}"));
            return if path.exists() {
                Ok(Self::Device(path))
            } else {
                Err(format!(
                    "expected a webcam, found none at `{}`",
                    path.display()
                ))
            };
        }
        if text.contains("://") {
            return Ok(Self::Stream(text.to_owned()));
        }
        let path = folder.join(text);
        if std::fs::metadata(&path).is_ok_and(|found| is_device(&found)) {
            return Ok(Self::Device(path));
        }
        if path.join("recording.json").is_file() {
            return Ok(Self::Recording(path));
        }
        if path.is_dir() {
            folder::images(&path).map_err(|error| error.to_string())?;
            return Ok(Self::Folder(path));
        }
        if path.is_file() {
            return Ok(Self::Video(path));
        }
        Err(format!(
            "expected a webcam's number, a stream's address, or a recording, a folder or a video that is there, \
             found none at `{}`",
            path.display()
        ))
    }

    /// Whether it comes to an end: what is on a disk does, other sources are opened again.
    pub fn ends(&self) -> bool {
        matches!(self, Self::Folder(_) | Self::Recording(_) | Self::Video(_))
    }

    /// Whether frames come at a pace of our own.
    pub fn is_paced(&self) -> bool {
        matches!(self, Self::Folder(_) | Self::Recording(_))
    }

    /// The source. `fps` sets the pace of folders and recordings ([`Location::FPS`] where `None`) and asks webcams
    /// for it; `repeat` begins again at the end of what has one.
    pub fn source(&self, fps: Option<f64>, repeat: bool) -> Box<dyn Source> {
        let pace = fps.unwrap_or(Self::FPS);
        match self {
            Self::Folder(path) => Box::new(Folder {
                path: path.clone(),
                fps: pace,
                repeat,
            }),
            Self::Recording(path) => Box::new(Recording {
                path: path.clone(),
                fps: pace,
                repeat,
            }),
            _ => Box::new(Ffmpeg::new(self.clone(), fps, repeat)),
        }
    }

    /// Whether what it needs is installed.
    ///
    /// # Errors
    /// [`SourceError::NoFfmpeg`].
    pub fn check(&self) -> Result<(), SourceError> {
        if self.is_paced() {
            Ok(())
        } else {
            Ffmpeg::check()
        }
    }
}

#[cfg(unix)]
fn is_device(found: &Metadata) -> bool {
    std::os::unix::fs::FileTypeExt::is_char_device(&found.file_type())
}

#[cfg(not(unix))]
fn is_device(_: &Metadata) -> bool {
    false
}
