//! Random directions, numbers and colours.

use std::f64::consts::TAU;

use glam::DVec3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// A direction with any yaw and an elevation between two angles, radians.
pub(super) fn direction(rng: &mut ChaCha8Rng, lowest: f64, highest: f64) -> DVec3 {
    let yaw = rng.random_range(0.0..TAU);
    let elevation: f64 = rng.random_range(lowest..highest);
    DVec3::new(
        yaw.cos() * elevation.cos(),
        yaw.sin() * elevation.cos(),
        elevation.sin(),
    )
}

/// A number with mean 0 and deviation 1, within 3 of 0.
pub(super) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    2.0 * ((0..3).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 1.5)
}

/// Linear RGB of a colour whose hue, saturation and value are meant for the screen.
pub(super) fn hsv(hue: f64, saturation: f64, value: f64) -> [f32; 3] {
    [5.0, 3.0, 1.0].map(|n: f64| {
        let k = (n + 6.0 * hue) % 6.0;
        let encoded = value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0));
        encoded.powf(2.2) as f32
    })
}

/// A nearly neutral grey.
pub(super) fn grey(rng: &mut ChaCha8Rng, darkest: f64, lightest: f64) -> [f32; 3] {
    let hue = rng.random_range(0.0..1.0);
    hsv(
        hue,
        rng.random_range(0.0..0.06),
        rng.random_range(darkest..lightest),
    )
}

/// Any plausible colour of a thing, some of them like the robot's.
pub(super) fn any_colour(rng: &mut ChaCha8Rng) -> [f32; 3] {
    match rng.random_range(0.0..1.0) {
        p if p < 0.3 => grey(rng, 0.1, 0.95),
        p if p < 0.4 => grey(rng, 0.02, 0.2),
        p if p < 0.5 => grey(rng, 0.5, 0.85),
        p if p < 0.6 => {
            let (hue, saturation) = (rng.random_range(0.52..0.62), rng.random_range(0.15..0.6));
            hsv(hue, saturation, rng.random_range(0.4..0.9))
        }
        p if p < 0.72 => {
            let (hue, saturation) = (rng.random_range(0.06..0.11), rng.random_range(0.2..0.6));
            hsv(hue, saturation, rng.random_range(0.4..0.9))
        }
        _ => {
            let (hue, saturation) = (rng.random_range(0.0..1.0), rng.random_range(0.3..1.0));
            hsv(hue, saturation, rng.random_range(0.2..1.0))
        }
    }
}
