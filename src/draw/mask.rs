use image::GrayImage;
use rayon::prelude::*;

use crate::camera::{Camera, Intrinsics};
use crate::cascade::Mask;

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
    let (width, height) = (camera.width as usize, camera.height as usize);
    let grey = |probability: f32| match threshold {
        Some(threshold) if probability >= threshold => 255,
        Some(_) => 0,
        None => (255.0 * probability).round() as u8,
    };
    let map = Map::new(camera, canonical);
    let mut pixels = vec![0_u8; width * height];
    if width > 0 {
        pixels
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, pixel) in row.iter_mut().enumerate() {
                    if let Some(probability) = map.at(x, y).and_then(|at| sample(mask, at)) {
                        *pixel = grey(probability);
                    }
                }
            });
    }
    // The buffer has the image's size.
    GrayImage::from_raw(camera.width, camera.height, pixels).unwrap_or_default()
}

/// The probability at a canonical pixel; `None` outside the mask, whose pixels reach half a pixel
/// beyond their centres.
fn sample(mask: &Mask, [u, v]: [f64; 2]) -> Option<f32> {
    let (x0, x1, fx) = neighbours(u, mask.width)?;
    let (y0, y1, fy) = neighbours(v, mask.height)?;
    let at = |x: usize, y: usize| mask.probability.get(y * mask.width as usize + x).copied();
    let top = at(x0, y0)? * (1.0 - fx) + at(x1, y0)? * fx;
    let bottom = at(x0, y1)? * (1.0 - fx) + at(x1, y1)? * fx;
    Some(top * (1.0 - fy) + bottom * fy)
}

/// The two pixels that a coordinate lies between, and its place between them.
fn neighbours(coordinate: f64, size: u32) -> Option<(usize, usize, f32)> {
    if !(-0.5..=f64::from(size) - 0.5).contains(&coordinate) || size == 0 {
        return None;
    }
    let last = f64::from(size - 1);
    let inside = coordinate.clamp(0.0, last);
    let low = inside.floor();
    Some((
        low as usize,
        (low + 1.0).min(last) as usize,
        (inside - low) as f32,
    ))
}

/// Where each pixel of the camera's image lies in the canonical image: the inverse of the lens at the
/// nodes of a coarse grid, linear in between. For a pinhole that is exact.
struct Map {
    columns: usize,
    nodes: Vec<Option<[f64; 2]>>,
}

impl Map {
    /// Pixels between two nodes. A lens bends a line by far less than a pixel over so short a way.
    const STEP: usize = 8;

    fn new(camera: &Camera, canonical: &Intrinsics) -> Self {
        let count = |size: u32| (size as usize).div_ceil(Self::STEP) + 1;
        let (columns, rows) = (count(camera.width), count(camera.height));
        let lens = camera.lens();
        let nodes = (0..columns * rows)
            .into_par_iter()
            .map(|index| {
                let at = |node: usize| (node * Self::STEP) as f64;
                let ray = lens.unproject([at(index % columns), at(index / columns)])?;
                Some(canonical.pixel(ray))
            })
            .collect();
        Self { columns, nodes }
    }

    /// `None` where the lens leads no ray to one of the nodes round the pixel.
    fn at(&self, x: usize, y: usize) -> Option<[f64; 2]> {
        let corner = y / Self::STEP * self.columns + x / Self::STEP;
        let node = |index: usize| self.nodes.get(index).copied().flatten();
        let place = |coordinate: usize| (coordinate % Self::STEP) as f64 / Self::STEP as f64;
        let (fx, fy) = (place(x), place(y));
        let [a, b] = [node(corner)?, node(corner + 1)?];
        let [c, d] = [
            node(corner + self.columns)?,
            node(corner + self.columns + 1)?,
        ];
        let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
        Some(std::array::from_fn(|i| {
            mix(mix(a[i], b[i], fx), mix(c[i], d[i], fx), fy)
        }))
    }
}
