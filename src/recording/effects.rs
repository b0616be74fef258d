//! What a camera does to a picture: exposure, white balance, blur, vignetting, noise.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{HEIGHT, WIDTH};

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
    seed: u64,
}

impl Effects {
    /// Draws a camera.
    pub fn any(rng: &mut ChaCha8Rng) -> Effects {
        let exposure: f32 = rng.random_range(0.8..1.2);
        Effects {
            gain: [(); 3].map(|()| exposure * rng.random_range(0.92..1.08f32)),
            gamma: rng.random_range(0.8..1.25),
            lift: if rng.random_bool(0.3) {
                rng.random_range(0.0..0.08)
            } else {
                0.0
            },
            blur: if rng.random_bool(0.35) {
                rng.random_range(0.4..1.4)
            } else {
                0.0
            },
            vignette: if rng.random_bool(0.4) {
                rng.random_range(0.0..0.35)
            } else {
                0.0
            },
            noise: if rng.random_bool(0.7) {
                rng.random_range(0.5..9.0)
            } else {
                0.0
            },
            grey: rng.random_bool(0.03),
            seed: rng.next_u64(),
        }
    }

    /// Changes an RGB picture of `WIDTH` x `HEIGHT` in place.
    pub fn apply(&self, rgb: &mut Vec<u8>) {
        if self.blur > 0.0
            && let Some(picture) = image::RgbImage::from_raw(WIDTH, HEIGHT, std::mem::take(rgb))
        {
            *rgb = image::imageops::fast_blur(&picture, self.blur).into_raw();
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
    }
}
