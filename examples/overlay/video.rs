//! A video's frames at its own pace, decoded by the program `ffmpeg`.

use std::error::Error;
use std::io::{BufRead, BufReader, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, TryRecvError, TrySendError, sync_channel};

use image::RgbaImage;

pub struct Video {
    file: PathBuf,
    ffmpeg: Child,
    frames: Receiver<RgbaImage>,
    first: Option<RgbaImage>,
    size: [u32; 2],
}

impl Video {
    /// Plays `file`, over and over.
    pub fn open(file: &Path) -> Result<Self, Box<dyn Error>> {
        // Each frame is a PPM: it says its size itself, and is upright.
        let mut ffmpeg = Command::new("ffmpeg")
            .args(["-v", "error", "-re", "-stream_loop", "-1", "-i"])
            .arg(file)
            .args(["-an", "-f", "image2pipe", "-c:v", "ppm", "-"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| match error.kind() {
                ErrorKind::NotFound => "ffmpeg plays videos, and is not installed".into(),
                _ => format!("ffmpeg: {error}"),
            })?;
        let mut output = BufReader::new(ffmpeg.stdout.take().ok_or("ffmpeg: no output")?);
        let (sender, frames) = sync_channel(1);
        std::thread::spawn(move || {
            while let Some(frame) = read_ppm(&mut output) {
                // A camera does not wait for who is late.
                if let Err(TrySendError::Disconnected(_)) = sender.try_send(frame) {
                    return;
                }
            }
        });
        let mut video = Self {
            file: file.to_owned(),
            ffmpeg,
            first: frames.recv().ok(),
            frames,
            size: [0, 0],
        };
        let first = video.first.as_ref().ok_or_else(|| video.ended())?;
        video.size = [first.width(), first.height()];
        Ok(video)
    }

    pub fn file(&self) -> &Path {
        &self.file
    }

    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// The next frame; `None` until there is one.
    pub fn next(&mut self) -> Result<Option<RgbaImage>, Box<dyn Error>> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        match self.frames.try_recv() {
            Ok(frame) => Ok(Some(frame)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(self.ended().into()),
        }
    }

    /// Why is on standard error: ffmpeg said so.
    fn ended(&self) -> String {
        format!("{}: ffmpeg gives no more frames", self.file.display())
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.ffmpeg.kill();
        let _ = self.ffmpeg.wait();
    }
}

/// The next of the pictures as ffmpeg writes them: `P6`, columns and rows, 255, a line each; then the pixels.
fn read_ppm(input: &mut impl BufRead) -> Option<RgbaImage> {
    let mut line = || {
        let mut line = String::new();
        input.read_line(&mut line).ok()?;
        Some(line.trim().to_owned())
    };
    let (kind, size, depth) = (line()?, line()?, line()?);
    if (kind.as_str(), depth.as_str()) != ("P6", "255") {
        return None;
    }
    let (width, height) = size.split_once(' ')?;
    let (width, height) = (width.parse().ok()?, height.parse().ok()?);
    let mut rgb = vec![0; 3 * width as usize * height as usize];
    input.read_exact(&mut rgb).ok()?;
    let pixels = rgb.as_chunks::<3>().0;
    let rgba = pixels.iter().flat_map(|&[r, g, b]| [r, g, b, 255]);
    RgbaImage::from_raw(width, height, rgba.collect())
}
