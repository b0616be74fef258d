use std::io::{ErrorKind, Read};
use std::process::{ChildStdout, Command, Stdio};
use std::sync::Arc;

use image::RgbaImage;

use super::child::{Announced, Child};
use super::{Location, Shot, Source, SourceError, Stream};
use crate::live::Stop;
use crate::live::frame::resize;

/// Everything that `ffmpeg` can read, through a child process that writes raw frames to a pipe.
///
/// Its filter `showinfo` announces each frame with its size on stderr, so that a stream may change its size.
#[derive(Debug)]
pub(super) struct Ffmpeg {
    location: Location,
    fps: Option<f64>,
    repeat: bool,
}

struct Frames {
    child: Child,
    pixels: ChildStdout,
    ends: bool,
}

impl Ffmpeg {
    /// How long a server may be silent before `ffmpeg` ends by itself, in microseconds: longer than it takes us to end it, for when
    /// we were killed.
    const SILENCE_US: &str = "60000000";

    pub fn new(location: Location, fps: Option<f64>, repeat: bool) -> Self {
        Self {
            location,
            fps,
            repeat,
        }
    }

    /// Whether there is one.
    pub fn check() -> Result<(), SourceError> {
        let status = Command::new("ffmpeg")
            .arg("-version")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status();
        status.map(drop).map_err(SourceError::NoFfmpeg)
    }

    fn command(&self) -> Command {
        let mut command = Command::new("ffmpeg");
        command.env("AV_LOG_FORCE_NOCOLOR", "1");
        command.args(["-nostdin", "-hide_banner", "-nostats"]);
        command.args(["-loglevel", "level+info"]);
        // Decoding several frames at a time would delay each by as many.
        command.args(["-thread_type", "slice"]);
        match &self.location {
            Location::Device(path) => {
                command.args(["-f", "v4l2", "-fflags", "nobuffer"]);
                if let Some(fps) = self.fps {
                    command.args(["-framerate", &fps.to_string()]);
                }
                command.arg("-i").arg(path);
            }
            Location::Stream(address) => {
                // The frame rate is none of our business: finding it out would take many frames.
                command.args(["-fflags", "nobuffer", "-fpsprobesize", "0"]);
                if address.starts_with("rtsp") {
                    // Over UDP, a lost packet spoils a picture.
                    command.args(["-rtsp_transport", "tcp"]);
                    command.args(["-timeout", Self::SILENCE_US]);
                } else if address.starts_with("http") {
                    command.args(["-rw_timeout", Self::SILENCE_US]);
                }
                command.args(["-i", address]);
            }
            Location::Video(path) | Location::Folder(path) | Location::Recording(path) => {
                command.arg("-re");
                if self.repeat {
                    command.args(["-stream_loop", "-1"]);
                }
                // What it is, not what it is called: `a:b.mp4` has no protocol.
                let mut file = std::ffi::OsString::from("file:");
                file.push(path);
                command.arg("-i").arg(file);
            }
        }
        // Every frame once, as it is.
        command.args(["-map", "0:v:0", "-vf", "format=rgba,showinfo=checksum=0"]);
        command.args(["-fps_mode", "passthrough", "-autoscale", "0"]);
        command.args(["-f", "rawvideo", "pipe:1"]);
        command
    }
}

impl Source for Ffmpeg {
    fn ends(&self) -> bool {
        self.location.ends() && !self.repeat
    }

    fn open(&mut self, stop: &Arc<Stop>) -> Result<Box<dyn Stream>, SourceError> {
        // An address may hold a password.
        let secret = match &self.location {
            Location::Stream(address) => Some(address.clone()),
            _ => None,
        };
        let ends = self.location.ends();
        let (child, pixels) = Child::start(self.command(), secret, !ends, stop)?;
        Ok(Box::new(Frames {
            child,
            pixels,
            ends,
        }))
    }
}

impl Stream for Frames {
    fn next(&mut self, image: &mut RgbaImage) -> Result<Option<Shot>, SourceError> {
        let Some(Announced { shot, size }) = self.child.announced() else {
            let ended = self.child.end();
            return match ended {
                Ok(()) if self.ends => Ok(None),
                Ok(()) => Err(SourceError::Ffmpeg("the stream ended".into())),
                Err(error) => Err(error),
            };
        };
        let [width, height] = size;
        resize(image, width, height);
        if let Err(cause) = self.pixels.read_exact(image) {
            let ended = self.child.end();
            // It was told to end, or the frame that it announced is its last.
            if self.child.stopped() {
                return Ok(None);
            }
            ended?;
            let what = match cause.kind() {
                ErrorKind::UnexpectedEof => "ffmpeg ended in the middle of a frame".to_owned(),
                _ => format!("ffmpeg's frames cannot be read: {cause}"),
            };
            return Err(SourceError::Ffmpeg(what));
        }
        self.child.touch();
        Ok(Some(shot))
    }
}
