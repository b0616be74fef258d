use image::GrayImage;
use image::metadata::Orientation;

use crate::camera::{Camera, Crop, Intrinsics, Unrectification};
use crate::cascade::Mask;
use crate::network::Shape;
use crate::reference::{Tensor, unrectify};

/// The mask at the size of the camera's image, `camera.width` x `camera.height`, resampled
/// bilinearly from the network's size and the canonical camera.
///
/// With a `threshold`, a pixel is 255 where the probability reaches it, and 0 elsewhere; without, it
/// is 255 times the probability. What the canonical camera does not see is 0.
pub fn mask_image(
    mask: &Mask,
    canonical: &Intrinsics,
    camera: &Camera,
    threshold: Option<f32>,
) -> GrayImage {
    let (width, height) = (camera.width, camera.height);
    let shape = Shape::new(1, mask.height as usize, mask.width as usize);
    let Some(mask) = Tensor::new(shape, mask.probability.clone()) else {
        return GrayImage::new(width, height);
    };
    let whole = Crop::whole(width, height);
    let params = Unrectification::new(camera, canonical, whole, Orientation::NoTransforms);
    let grey = |probability: f32| match threshold {
        Some(threshold) if probability >= threshold => 255,
        Some(_) => 0,
        None => (255.0 * probability).round() as u8,
    };
    let pixels = unrectify(&mask, &params).into_iter().map(grey).collect();
    // The buffer has the image's size.
    GrayImage::from_raw(width, height, pixels).unwrap_or_default()
}
