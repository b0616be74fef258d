use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::RgbaImage;

use super::pace::Pace;
use super::{Shot, Source, SourceError, Stream};
use crate::image_file;
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
    fn ends(&self) -> bool {
        !self.repeat
    }

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
        let shot = Shot {
            file: Some(path.as_path().into()),
            ..Shot::now()
        };
        let read = image_file::read_upright(path).map_err(|cause| {
            let text = format!("{}: {cause}", path.display());
            SourceError::Frame(text)
        })?;
        *image = read.into_rgba8();
        Ok(Some(shot))
    }
}

/// The images in a folder (not below it).
pub(super) fn images(folder: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let fault = |what: &str| SourceError::Folder(format!("{}: {what}", folder.display()));
    let paths = image_file::in_folder(folder).map_err(|cause| fault(&cause.to_string()))?;
    if paths.is_empty() {
        return Err(fault("no images in this folder"));
    }
    Ok(paths)
}
