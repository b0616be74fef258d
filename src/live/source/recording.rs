use std::path::PathBuf;
use std::sync::Arc;

use image::{Rgb, RgbImage, RgbaImage};

use super::pace::Pace;
use super::{Shot, Source, SourceError, Stream};
use crate::camera::{Camera, Distortion};
use crate::live::Stop;
use crate::live::frame::resize;
use crate::recording::Reader;

/// The samples of a recording, in order, each with its camera.
#[derive(Debug)]
pub(super) struct Recording {
    pub path: PathBuf,
    pub fps: f64,
    pub repeat: bool,
}

struct Samples {
    reader: Reader,
    next: usize,
    repeat: bool,
    pace: Pace,
}

impl Source for Recording {
    fn ends(&self) -> bool {
        !self.repeat
    }

    fn open(&mut self, stop: &Arc<Stop>) -> Result<Box<dyn Stream>, SourceError> {
        Ok(Box::new(Samples {
            reader: Reader::open(&self.path)?,
            next: 0,
            repeat: self.repeat,
            pace: Pace::new(self.fps, stop),
        }))
    }
}

impl Stream for Samples {
    fn next(&mut self, image: &mut RgbaImage) -> Result<Option<Shot>, SourceError> {
        let samples = self.reader.samples();
        if self.next == samples.len() && self.repeat {
            self.next = 0;
        }
        let Some(sample) = samples.get(self.next) else {
            return Ok(None);
        };
        self.next += 1;
        if !self.pace.wait() {
            return Ok(None);
        }
        let shot = Shot::now();
        let picture = self.reader.image(sample);
        let picture = picture.map_err(|cause| SourceError::Frame(cause.to_string()))?;
        opaque(&picture, image);
        Ok(Some(Shot {
            camera: Some(Camera {
                width: picture.width(),
                height: picture.height(),
                intrinsics: sample.intrinsics,
                distortion: Distortion::None,
            }),
            ..shot
        }))
    }
}

fn opaque(picture: &RgbImage, image: &mut RgbaImage) {
    resize(image, picture.width(), picture.height());
    for (to, Rgb([r, g, b])) in image.pixels_mut().zip(picture.pixels()) {
        to.0 = [*r, *g, *b, 255];
    }
}
