use std::path::Path;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use image::RgbaImage;

use crate::camera::Camera;

/// A frame of a camera, ready to be searched.
#[derive(Debug, Clone)]
pub struct Frame {
    /// The camera's place in the configuration.
    pub camera: usize,
    /// The frame's number among all that the source gave, from 0.
    pub number: u64,
    /// When it was taken, by the wall clock.
    pub acquired: SystemTime,
    /// The same by the monotonic clock.
    pub acquired_at: Instant,
    /// The file that it is all of, where its source is a folder of images.
    pub file: Option<Arc<Path>>,
    /// The frame, upright, of `view`'s size.
    pub image: Arc<RgbaImage>,
    /// The camera of that image.
    pub view: Camera,
}

/// Images that are used again once nobody has them any more.
#[derive(Debug, Default)]
pub(super) struct Pool(Vec<Arc<RgbaImage>>);

impl Pool {
    /// Most images that are kept: one that is being read, one in the mailbox, some under way and at sinks.
    const MOST: usize = 8;

    /// An image that nobody else has, of whatever size and content.
    pub fn take(&mut self) -> Arc<RgbaImage> {
        let unused = self.0.iter_mut().position(|i| Arc::get_mut(i).is_some());
        unused.map_or_else(Arc::default, |index| self.0.swap_remove(index))
    }

    /// Keeps an image that others may still have.
    pub fn keep(&mut self, image: Arc<RgbaImage>) {
        if self.0.len() < Self::MOST {
            self.0.push(image);
        }
    }
}

/// Gives `image` another size, in its own memory where that is large enough.
pub(super) fn resize(image: &mut RgbaImage, width: u32, height: u32) {
    if image.dimensions() != (width, height) {
        let mut bytes = std::mem::take(image).into_raw();
        bytes.resize(4 * width as usize * height as usize, 0);
        // Of exactly that many bytes.
        *image = RgbaImage::from_raw(width, height, bytes).unwrap_or_default();
    }
}
