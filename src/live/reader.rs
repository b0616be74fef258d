use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use image::RgbaImage;

use super::frame::{Pool, resize};
use super::guard::guarded;
use super::mailbox::Mailboxes;
use super::message::Message;
use super::{Frame, Input, SourceError, Stop, Stream};
use crate::camera::{Camera, Crop, Orientation, Texels};

/// Reads a camera's source, in a thread of its own.
pub(super) struct Reader {
    pub camera: usize,
    pub input: Input,
    /// The longest side that the engine takes now, in pixels.
    pub max_side: Arc<AtomicU32>,
    pub mailboxes: Arc<Mailboxes>,
    pub messages: Sender<Message>,
    pub stop: Arc<Stop>,
}

/// What a reader has besides: it stays when the source is opened again.
#[derive(Default)]
struct Memory {
    number: u64,
    pool: Pool,
    /// The frame as it is stored, where it is not upright.
    stored: RgbaImage,
}

impl Reader {
    /// Until the source ends or everything is to stop. A source that fails is opened again, unless it would begin again.
    pub fn run(mut self) {
        let mut memory = Memory::default();
        let mut patience = Patience::default();
        while let Err(error) = self.guarded_read(&mut memory, &mut patience) {
            if self.stop.is_set() {
                break;
            }
            if self.input.source.ends() {
                self.fail(&error, None);
                break;
            }
            if self.wait(&error, &mut patience) {
                break;
            }
        }
        if !self.stop.is_set() {
            self.tell(Message::Ended {
                camera: self.camera,
            });
        }
    }

    /// A source may be somebody else's.
    fn guarded_read(
        &mut self,
        memory: &mut Memory,
        patience: &mut Patience,
    ) -> Result<(), SourceError> {
        let read = guarded(|| self.read(memory, patience));
        read.unwrap_or_else(|words| Err(SourceError::Panicked(words)))
    }

    /// Opens the source and reads it to its end.
    fn read(&mut self, memory: &mut Memory, patience: &mut Patience) -> Result<(), SourceError> {
        let mut stream = self.input.source.open(&self.stop)?;
        loop {
            match self.frame(stream.as_mut(), memory) {
                Ok(Some(frame)) => {
                    patience.frame_came();
                    // Before the frame itself: whoever sees its answer knows that the camera lives.
                    self.tell(Message::Arrived {
                        camera: self.camera,
                        at: Instant::now(),
                    });
                    self.mailboxes.put(frame);
                }
                Ok(None) => return Ok(()),
                Err(error @ (SourceError::Frame(_) | SourceError::Camera(_))) => {
                    if self.wait(&error, patience) {
                        return Ok(());
                    }
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// The next frame, upright, with its camera.
    fn frame(
        &self,
        stream: &mut dyn Stream,
        memory: &mut Memory,
    ) -> Result<Option<Frame>, SourceError> {
        let orientation = self.input.orientation;
        let mut image = memory.pool.take();
        // Nobody else has it.
        let target = Arc::make_mut(&mut image);
        let upright = orientation == Orientation::NoTransforms;
        let stored = if upright {
            &mut *target
        } else {
            &mut memory.stored
        };
        let shot = match stream.next(stored) {
            Ok(Some(shot)) => shot,
            other => {
                memory.pool.keep(image);
                return other.map(|_| None);
            }
        };
        let number = memory.number;
        memory.number += 1;
        let camera = match shot.camera {
            Some(camera) => camera.for_image(stored.width(), stored.height())?,
            None => self
                .input
                .calibration
                .camera(stored.width(), stored.height())?,
        };
        let longest = camera.width.max(camera.height);
        let max_side = self.max_side.load(Ordering::Relaxed);
        if longest > max_side || camera.width.min(camera.height) == 0 {
            return Err(SourceError::Frame(format!(
                "expected an image of 1 to {max_side} pixels on a side, found {} x {}",
                camera.width, camera.height
            )));
        }
        if !upright {
            turn(&memory.stored, orientation, target);
        }
        memory.pool.keep(Arc::clone(&image));
        Ok(Some(Frame {
            camera: self.camera,
            number,
            acquired: shot.acquired,
            acquired_at: shot.acquired_at,
            file: shot.file,
            image,
            view: oriented(camera, orientation),
        }))
    }

    /// Tells what went wrong and waits: whether everything is to stop.
    fn wait(&self, error: &SourceError, patience: &mut Patience) -> bool {
        let retry_in = patience.next();
        self.fail(error, Some(retry_in));
        self.stop.wait(retry_in)
    }

    fn fail(&self, error: &SourceError, retry_in: Option<Duration>) {
        self.tell(Message::Failed {
            camera: self.camera,
            reason: error.to_string(),
            retry_in,
        });
    }

    fn tell(&self, message: Message) {
        // Nobody listens any more when everything stops.
        let _ = self.messages.send(message);
    }
}

impl Drop for Reader {
    /// However it ends: who waits for frames waits for no more of this camera.
    fn drop(&mut self) {
        self.mailboxes.close();
    }
}

/// How long to wait before the next try: twice as long each time, unless frames came for longer in between.
#[derive(Default)]
struct Patience {
    wait: Duration,
    /// The first frame since the last failure.
    first: Option<Instant>,
}

impl Patience {
    const LEAST: Duration = Duration::from_millis(250);
    const MOST: Duration = Duration::from_secs(10);

    fn frame_came(&mut self) {
        self.first.get_or_insert_with(Instant::now);
    }

    fn next(&mut self) -> Duration {
        let first = self.first.take();
        let well = first.is_some_and(|first| first.elapsed() > 2 * self.wait);
        let wait = if well { Duration::ZERO } else { 2 * self.wait };
        self.wait = wait.clamp(Self::LEAST, Self::MOST);
        self.wait
    }
}

/// The camera of upright images.
fn oriented(camera: Camera, orientation: Orientation) -> Camera {
    match orientation {
        Orientation::NoTransforms => camera,
        other => camera.oriented(other),
    }
}

fn turn(stored: &RgbaImage, orientation: Orientation, upright: &mut RgbaImage) {
    let whole = Crop::whole(stored.width(), stored.height());
    let [width, height] = whole.turned(orientation);
    resize(upright, width, height);
    let texels = Texels::new(whole, orientation);
    for (u, v, pixel) in upright.enumerate_pixels_mut() {
        let [x, y] = texels.at([u as i32, v as i32]);
        if let Some(texel) = stored.get_pixel_checked(x as u32, y as u32) {
            *pixel = *texel;
        }
    }
}
