use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::{HEIGHT, RecorderError, WIDTH};
use crate::recording::Sample;

/// What the camera sees of a scene: `WIDTH` x `HEIGHT` pixels, row by row from the top left.
pub struct Picture {
    /// RGB bytes, sRGB-encoded.
    pub rgb: Vec<u8>,
    /// 255 where the robot covers at least half of the pixel, else 0.
    pub mask: Vec<u8>,
}

impl Picture {
    /// Writes the sample's image (JPEG, quality 92) and mask (PNG).
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, folder: &Path, sample: &Sample) -> Result<(), RecorderError> {
        let mut jpeg = Vec::new();
        let image_path = folder.join(&sample.image);
        let mask_path = folder.join(&sample.mask);
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |cause| RecorderError::Picture { path, cause }
        };
        JpegEncoder::new_with_quality(&mut jpeg, 92)
            .write_image(&self.rgb, WIDTH, HEIGHT, ExtendedColorType::Rgb8)
            .map_err(failed(&image_path))?;
        let mut png = Vec::new();
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::NoFilter)
            .write_image(&self.mask, WIDTH, HEIGHT, ExtendedColorType::L8)
            .map_err(failed(&mask_path))?;
        std::fs::write(&image_path, jpeg).map_err(RecorderError::io(&image_path))?;
        std::fs::write(&mask_path, png).map_err(RecorderError::io(&mask_path))
    }
}
