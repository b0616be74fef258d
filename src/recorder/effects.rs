//! What a camera does to a picture: exposure, white balance, blur, vignetting, noise.

use image::codecs::jpeg::JpegEncoder;
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::picture::Picture;
use super::{HEIGHT, WIDTH};

/// The part of the picture that the camera's image fills, black outside: images of other shapes are
/// fitted into the recording's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// Width and height of the part, pixels; it is in the middle.
    size: [u32; 2],
}

impl Window {
    /// The whole picture.
    pub const WHOLE: Window = Window {
        size: [WIDTH, HEIGHT],
    };

    /// Draws a camera's shape: mostly the recording's own.
    pub fn any(rng: &mut ChaCha8Rng) -> Window {
        if rng.random_bool(0.75) {
            return Window::WHOLE;
        }
        const SHAPES: [f64; 8] = [
            4.0 / 3.0,
            4.0 / 3.0,
            1.5,
            16.0 / 9.0,
            16.0 / 9.0,
            0.75,
            0.75,
            9.0 / 16.0,
        ];
        let shape = SHAPES.choose(rng).copied().unwrap_or(1.0);
        let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
        let size = [width.min(height * shape), height.min(width / shape)];
        Window {
            size: size.map(|edge| edge.round() as u32),
        }
    }

    /// Left, top, right and bottom edge, pixels.
    pub fn edges(&self) -> [f64; 4] {
        let [width, height] = self.size;
        let (left, top) = ((WIDTH - width) / 2, (HEIGHT - height) / 2);
        [left, top, left + width, top + height].map(f64::from)
    }

    /// Whether a pixel (column, row) is inside.
    pub fn contains(&self, pixel: [u32; 2]) -> bool {
        let [left, top, right, bottom] = self.edges();
        let [x, y] = pixel.map(f64::from);
        (left..right).contains(&x) && (top..bottom).contains(&y)
    }
}

/// One camera's faults.
#[derive(Debug, Clone)]
pub struct Effects {
    /// Gain of red, green and blue.
    gain: [f32; 3],
    /// Exponent on values in [0, 1].
    gamma: f32,
    /// Added to values in [0, 1] before the gain.
    lift: f32,
    /// Standard deviation of the blur, pixels; 0 for none.
    blur: f32,
    /// Loss of light in the corners, 0 to 1.
    vignette: f32,
    /// Standard deviation of the noise, 8-bit steps.
    noise: f32,
    /// Whether the picture loses its colours.
    grey: bool,
    /// Quality of a JPEG file that the picture went through, 1 to 100.
    jpeg: Option<u8>,
    window: Window,
    seed: u64,
}

impl Effects {
    /// Draws a camera whose image fills `window`.
    pub fn any(rng: &mut ChaCha8Rng, window: Window) -> Effects {
        let exposure: f32 = rng.random_range(0.75..1.25);
        let flat = rng.random_bool(0.3);
        let often = |rng: &mut ChaCha8Rng, chance: f64, low: f32, high: f32| {
            if rng.random_bool(chance) {
                rng.random_range(low..high)
            } else {
                0.0
            }
        };
        Effects {
            gain: [(); 3].map(|()| exposure * rng.random_range(0.92..1.08f32)),
            gamma: rng.random_range(0.75..1.3),
            lift: if flat {
                rng.random_range(0.0..0.18)
            } else {
                0.0
            },
            blur: often(rng, 0.4, 0.4, 1.5),
            vignette: often(rng, 0.4, 0.0, 0.4),
            noise: often(rng, 0.7, 0.7, 2.9).powi(2),
            grey: rng.random_bool(0.08),
            jpeg: rng.random_bool(0.25).then(|| rng.random_range(30..85)),
            window,
            seed: rng.next_u64(),
        }
    }

    /// Changes a picture in place; the mask is only cut to the window.
    pub fn apply(&self, picture: &mut Picture) {
        let rgb = &mut picture.rgb;
        if self.blur > 0.0
            && let Some(sharp) = image::RgbImage::from_raw(WIDTH, HEIGHT, std::mem::take(rgb))
        {
            *rgb = image::imageops::fast_blur(&sharp, self.blur).into_raw();
        }
        let curves: [Vec<f32>; 3] = self.gain.map(|gain| {
            (0..256)
                .map(|c| {
                    let value = (c as f32 / 255.0).powf(self.gamma) * (1.0 - self.lift) + self.lift;
                    255.0 * gain * value
                })
                .collect()
        });
        let mut noise = ChaCha8Rng::seed_from_u64(self.seed);
        // The sum of four bytes has a deviation of 148.
        let strength = self.noise / 148.0;
        let (half_width, half_height) = (0.5 * WIDTH as f32, 0.5 * HEIGHT as f32);
        for (i, pixel) in rgb.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let i = i as u32;
            let (x, y) = (
                (i % WIDTH) as f32 / half_width - 1.0,
                (i / WIDTH) as f32 / half_height - 1.0,
            );
            let light = 1.0 - 0.5 * self.vignette * (x * x + y * y);
            let mut values = [0.0; 3];
            for ((value, curve), &channel) in values.iter_mut().zip(&curves).zip(pixel.iter()) {
                *value = curve.get(usize::from(channel)).copied().unwrap_or(0.0) * light;
            }
            if self.grey {
                values = [0.3 * values[0] + 0.59 * values[1] + 0.11 * values[2]; 3];
            }
            if self.noise > 0.0 {
                for value in &mut values {
                    let sum: u32 = noise
                        .next_u32()
                        .to_le_bytes()
                        .iter()
                        .map(|&b| u32::from(b))
                        .sum();
                    *value += strength * (sum as f32 - 510.0);
                }
            }
            *pixel = values.map(|v| (v + 0.5).clamp(0.0, 255.0) as u8);
        }
        if let Some(coded) = self.jpeg.and_then(|quality| through_jpeg(rgb, quality)) {
            *rgb = coded;
        }
        if self.window == Window::WHOLE {
            return;
        }
        let pixels = rgb.as_chunks_mut::<3>().0.iter_mut();
        for (i, (pixel, mask)) in (0..).zip(pixels.zip(&mut picture.mask)) {
            if !self.window.contains([i % WIDTH, i / WIDTH]) {
                *pixel = [0; 3];
                *mask = 0;
            }
        }
    }
}

/// The picture after it was kept as a JPEG file.
fn through_jpeg(rgb: &[u8], quality: u8) -> Option<Vec<u8>> {
    let mut file = Vec::new();
    JpegEncoder::new_with_quality(&mut file, quality)
        .encode(rgb, WIDTH, HEIGHT, image::ExtendedColorType::Rgb8)
        .ok()?;
    let coded = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg).ok()?;
    Some(coded.into_rgb8().into_raw())
}
