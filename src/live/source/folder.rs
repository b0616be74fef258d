use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits, RgbaImage};

use super::pace::Pace;
use super::{Shot, Source, SourceError, Stream};
use crate::live::Stop;

/// The images in a folder, in the order of their names.
#[derive(Debug)]
pub(super) struct Folder {
    pub path: PathBuf,
    pub fps: f64,
    pub repeat: bool,
}

struct Pictures {
    paths: Vec<PathBuf>,
    next: usize,
    repeat: bool,
    pace: Pace,
}

impl Source for Folder {
    fn open(&mut self, stop: &Arc<Stop>) -> Result<Box<dyn Stream>, SourceError> {
        Ok(Box::new(Pictures {
            paths: images(&self.path)?,
            next: 0,
            repeat: self.repeat,
            pace: Pace::new(self.fps, stop),
        }))
    }
}

impl Stream for Pictures {
    fn next(&mut self, image: &mut RgbaImage) -> Result<Option<Shot>, SourceError> {
        if self.next == self.paths.len() && self.repeat {
            self.next = 0;
        }
        let Some(path) = self.paths.get(self.next) else {
            return Ok(None);
        };
        self.next += 1;
        if !self.pace.wait() {
            return Ok(None);
        }
        let shot = Shot::now();
        *image = read(path).map_err(|cause| {
            let text = format!("{}: {cause}", path.display());
            SourceError::Frame(text)
        })?;
        Ok(Some(shot))
    }
}

/// The images in a folder (not below it).
pub(super) fn images(folder: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let fault = |what: &str| SourceError::Folder(format!("{}: {what}", folder.display()));
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| fault(&e.to_string()))? {
        let path = entry.map_err(|e| fault(&e.to_string()))?.path();
        let known = ImageFormat::from_path(&path).is_ok_and(|format| format.reading_enabled());
        if known && !path.is_dir() {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        return Err(fault("no images in this folder"));
    }
    paths.sort();
    Ok(paths)
}

/// Upright: EXIF's orientation is applied.
fn read(path: &Path) -> Result<RgbaImage, image::ImageError> {
    let mut reader = ImageReader::open(path)?.with_guessed_format()?;
    reader.limits(Limits::default());
    let mut decoder = reader.into_decoder()?;
    let orientation = decoder.orientation().ok();
    let mut image = DynamicImage::from_decoder(decoder)?;
    if let Some(orientation) = orientation {
        image.apply_orientation(orientation);
    }
    Ok(image.into_rgba8())
}
