//! A camera's picture for the page.

use std::sync::Arc;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageError, RgbImage, RgbaImage, imageops};

use crate::camera::{Camera, Intrinsics};
use crate::draw::mask_image;
use crate::live::Observation;

/// The longer side of a picture, in pixels.
const LONGEST_SIDE: u32 = 512;
/// That of a mask: the networks see no more.
const LONGEST_MASK_SIDE: u32 = 256;
const QUALITY: u8 = 75;
const TINT: [u8; 3] = [0, 220, 110];
const TINT_STRENGTH: f32 = 0.5;

/// Files for a browser to lay upon each other.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    /// The image as JPEG.
    pub picture: Arc<[u8]>,
    /// The mask's tint as PNG, transparent where no robot is; empty without a mask.
    pub tint: Arc<[u8]>,
}

impl Tile {
    /// Of an observation by a model whose networks' camera is `canonical`.
    pub fn new(observation: &Observation, canonical: &Intrinsics) -> Result<Self, ImageError> {
        let image = observation.image.as_ref();
        let (width, height) = shrunk(image.dimensions(), LONGEST_SIDE);
        let small;
        let image = if (width, height) == image.dimensions() {
            image
        } else {
            small = imageops::thumbnail(image, width, height);
            &small
        };
        let mut picture = Vec::new();
        JpegEncoder::new_with_quality(&mut picture, QUALITY).encode_image(&without_alpha(image))?;
        let mut tint = Vec::new();
        if let Some(mask) = &observation.estimate.mask {
            let (width, height) = shrunk(image.dimensions(), LONGEST_MASK_SIDE);
            let view = resized(&observation.view, width, height);
            let pixels: Vec<u8> = mask_image(mask, canonical, &view, None)
                .pixels()
                .flat_map(|pixel| {
                    let [red, green, blue] = TINT;
                    let alpha = (TINT_STRENGTH * f32::from(pixel.0[0])).round() as u8;
                    [red, green, blue, alpha]
                })
                .collect();
            PngEncoder::new_with_quality(&mut tint, CompressionType::Fast, FilterType::Adaptive)
                .write_image(&pixels, width, height, ExtendedColorType::Rgba8)?;
        }
        Ok(Self {
            picture: picture.into(),
            tint: tint.into(),
        })
    }

    /// How large its files are.
    pub fn bytes(&self) -> usize {
        self.picture.len() + self.tint.len()
    }
}

/// Width and height with sides of at most `longest`.
fn shrunk((width, height): (u32, u32), longest: u32) -> (u32, u32) {
    let scale = f64::from(longest) / f64::from(width.max(height).max(1));
    let side = |side: u32| ((f64::from(side) * scale.min(1.0)).round() as u32).max(1);
    (side(width), side(height))
}

/// The camera, had it taken its images with so many pixels.
fn resized(camera: &Camera, width: u32, height: u32) -> Camera {
    let x = f64::from(width) / f64::from(camera.width);
    let y = f64::from(height) / f64::from(camera.height);
    let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
    Camera {
        width,
        height,
        intrinsics: Intrinsics {
            fx: fx * x,
            fy: fy * y,
            // The pixels' corners stay where they are, not their centres.
            cx: (cx + 0.5) * x - 0.5,
            cy: (cy + 0.5) * y - 0.5,
        },
        distortion: camera.distortion,
    }
}

fn without_alpha(image: &RgbaImage) -> RgbImage {
    let pixels = image.pixels().flat_map(|pixel| {
        let [red, green, blue, _] = pixel.0;
        [red, green, blue]
    });
    // The buffer has the image's size.
    RgbImage::from_raw(image.width(), image.height(), pixels.collect()).unwrap_or_default()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::time::{Instant, SystemTime};

    use image::Rgba;

    use super::*;
    use crate::cascade::{Estimate, Mask, Status};

    #[test]
    fn a_tile_is_small_and_tinted_where_the_mask_is() {
        let camera = Camera::from_hfov(1280, 720, 1.2);
        // The canonical camera sees the same at a tenth of the size, and a robot in the left half.
        let canonical = resized(&camera, 128, 72);
        let probability = (0..128 * 72).map(|i| f32::from(u8::from(i % 128 < 64)));
        let observation = Observation {
            file: None,
            camera: 0,
            frame: 0,
            acquired: SystemTime::now(),
            acquired_at: Instant::now(),
            answered_at: Instant::now(),
            image: Arc::new(RgbaImage::from_pixel(1280, 720, Rgba([200, 100, 50, 255]))),
            view: camera,
            estimate: Estimate {
                status: Status::NotFound,
                coverage: 0.5,
                bbox_px: None,
                field: 1.0,
                joints: Vec::new(),
                mask: Some(Mask {
                    width: 128,
                    height: 72,
                    probability: probability.collect(),
                }),
            },
        };
        let tile = Tile::new(&observation, &canonical.intrinsics).unwrap();
        let picture = image::load_from_memory(&tile.picture).unwrap();
        assert_eq!((picture.width(), picture.height()), (512, 288));
        let pixel = picture.into_rgb8().get_pixel(100, 100).0;
        let off = pixel.iter().zip([200, 100, 50]).map(|(a, b)| a.abs_diff(b));
        assert!(off.max().unwrap() <= 3, "{pixel:?}");
        let tint = image::load_from_memory(&tile.tint).unwrap().into_rgba8();
        assert_eq!(tint.dimensions(), (256, 144));
        assert_eq!(tint.get_pixel(120, 70).0, [0, 220, 110, 128]);
        assert_eq!(tint.get_pixel(136, 70).0[3], 0);

        let without = Estimate {
            mask: None,
            ..observation.estimate.clone()
        };
        let without = Observation {
            estimate: without,
            ..observation
        };
        let tile = Tile::new(&without, &canonical.intrinsics).unwrap();
        assert!(tile.tint.is_empty());
    }

    #[test]
    fn pictures_shrink_and_never_grow() {
        assert_eq!(shrunk((1920, 1080), 512), (512, 288));
        assert_eq!(shrunk((320, 240), 512), (320, 240));
        assert_eq!(shrunk((10_000, 1), 512), (512, 1));
    }
}
