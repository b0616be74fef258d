use super::{Tensor, overlay};
use crate::camera::{Gaze, Intrinsics};
use crate::network::{Overlay, Shape, Zoom};

/// Steps of a zoom in an octave, and of a direction in the width of what the camera sees: roundings and noise in a mask, which move
/// its mean by hundredths of a pixel, leave the camera where it is.
const STEPS: [f32; 2] = [8.0, 64.0];

/// Turns a network's camera to the pixels that the overlay's `rule` shows by `mask` `[1, height, width]`, each as
/// heavy as it is shown: to their mean, so close that `spread` of their standard deviations are as wide or as high as the
/// image, both in steps: of an eighth of an octave, and of a 64th of the width of what the camera sees. Where there are
/// none, it is the canonical `camera`.
pub fn zoom(mask: &Tensor, rule: Overlay, camera: &Intrinsics, zoom: Zoom) -> Gaze {
    let Shape { height, width, .. } = mask.shape();
    let size = [width as f32, height as f32];
    let middle = size.map(|side| 0.5 * (side - 1.0));
    let (mut weight, mut sum, mut squares) = (0.0_f64, [0.0_f64; 2], [0.0_f64; 2]);
    for (y, row) in mask.data().chunks_exact(width).enumerate() {
        for (x, &probability) in row.iter().enumerate() {
            let share = f64::from(rule.share(probability));
            let at = [x as f32 - middle[0], y as f32 - middle[1]].map(f64::from);
            weight += share;
            for axis in 0..2 {
                sum[axis] += share * at[axis];
                squares[axis] += share * at[axis] * at[axis];
            }
        }
    }
    if weight < 1e-6 {
        return Gaze::CANONICAL;
    }
    let mean = sum.map(|v| v / weight);
    let share = [0, 1].map(|axis| {
        let variance = squares[axis] / weight - mean[axis] * mean[axis];
        zoom.spread * (variance.max(0.0).sqrt() as f32) / size[axis]
    });
    let within = |value: f32| value.clamp(zoom.least, zoom.most);
    let wanted = within(1.0 / share[0].max(share[1]).max(1e-6));
    let nearer = within(((wanted.log2() * STEPS[0]).round_ties_even() / STEPS[0]).exp2());
    let step = size[0] / (STEPS[1] * nearer);
    let stepped = |at: f32| (at / step).round_ties_even() * step;
    let x = stepped(mean[0] as f32 + middle[0] - camera.cx as f32) / camera.fx as f32;
    let y = stepped(mean[1] as f32 + middle[1] - camera.cy as f32) / camera.fy as f32;
    Gaze::towards([x, y], nearer)
}

/// The joint network's input as `gaze` sees it: `image` `[3, height, width]` of the canonical `camera`, masked by `mask`
/// `[1, height, width]`, both sampled bilinearly, black beyond their borders.
pub fn zoom_overlay(
    image: &Tensor,
    mask: &Tensor,
    rule: Overlay,
    camera: &Intrinsics,
    gaze: &Gaze,
) -> Tensor {
    let [seen, covered] = [image, mask].map(|source| sampled(source, camera, gaze));
    overlay(&seen, &covered, rule)
}

/// The canonical `camera`'s mask: `closer`, what `gaze` sees of it, sampled bilinearly as far as it sees, `coarse` beyond, and
/// both over the pixel between; all `[1, height, width]`.
pub fn zoom_mask(closer: &Tensor, coarse: &Tensor, camera: &Intrinsics, gaze: &Gaze) -> Tensor {
    let Shape { height, width, .. } = coarse.shape();
    let mut mask = coarse.clone();
    let (pinhole, zoomed) = (Pinhole::of(camera, 1.0), Pinhole::of(camera, gaze.zoom));
    for y in 0..height {
        for x in 0..width {
            let Some(at) = zoomed.place(gaze.turned(pinhole.ray(x, y))) else {
                continue;
            };
            let to = y * width + x;
            let beyond = 1.0 - inside(closer.shape(), at);
            mask.data[to] = sample(closer, 0, at) + beyond * coarse.data[to];
        }
    }
    mask
}

/// The canonical camera, or one zoomed in.
struct Pinhole {
    focal: [f32; 2],
    centre: [f32; 2],
}

impl Pinhole {
    fn of(camera: &Intrinsics, zoom: f32) -> Self {
        Self {
            focal: [camera.fx as f32 * zoom, camera.fy as f32 * zoom],
            centre: [camera.cx as f32, camera.cy as f32],
        }
    }

    /// Where pixel `(x, y)` looks.
    fn ray(&self, x: usize, y: usize) -> [f32; 3] {
        let [x, y] =
            [0, 1].map(|axis| ([x, y][axis] as f32 - self.centre[axis]) / self.focal[axis]);
        [x, y, 1.0]
    }

    /// The pixel that sees `ray`. Behind the camera it sees nothing.
    fn place(&self, ray: [f32; 3]) -> Option<[f32; 2]> {
        let place = [0, 1].map(|axis| ray[axis] / ray[2] * self.focal[axis] + self.centre[axis]);
        (ray[2] > 1e-3).then_some(place)
    }
}

/// What `gaze` sees of `source`, which the canonical `camera` took.
fn sampled(source: &Tensor, camera: &Intrinsics, gaze: &Gaze) -> Tensor {
    let Shape {
        channels,
        height,
        width,
    } = source.shape();
    let (canonical, zoomed) = (Pinhole::of(camera, 1.0), Pinhole::of(camera, gaze.zoom));
    let mut seen = source.clone();
    for y in 0..height {
        for x in 0..width {
            let at = canonical.place(gaze.turned_back(zoomed.ray(x, y)));
            for channel in 0..channels {
                let value = at.map_or(0.0, |at| sample(source, channel, at));
                seen.data[(channel * height + y) * width + x] = value;
            }
        }
    }
    seen
}

/// How much of a bilinear sample at `at` lies on a plane of `shape`.
fn inside(shape: Shape, at: [f32; 2]) -> f32 {
    let share = |at: f32, side: usize| (at + 1.0).min(side as f32 - at).clamp(0.0, 1.0);
    share(at[0], shape.width) * share(at[1], shape.height)
}

/// Bilinear, as if zeros lay round the plane.
fn sample(source: &Tensor, channel: usize, [x, y]: [f32; 2]) -> f32 {
    let Shape { height, width, .. } = source.shape();
    if !(x > -1.0 && y > -1.0 && x < width as f32 && y < height as f32) {
        return 0.0;
    }
    let (column, row) = (x.floor() as isize, y.floor() as isize);
    let (part_x, part_y) = (x - x.floor(), y - y.floor());
    let load = |column: isize, row: isize| {
        let inside = (0..width as isize).contains(&column) && (0..height as isize).contains(&row);
        if inside {
            source.row(channel, row as usize)[column as usize]
        } else {
            0.0
        }
    };
    load(column, row) * ((1.0 - part_x) * (1.0 - part_y))
        + load(column + 1, row) * (part_x * (1.0 - part_y))
        + load(column, row + 1) * ((1.0 - part_x) * part_y)
        + load(column + 1, row + 1) * (part_x * part_y)
}

/// From joints `x, y, z` as `gaze` sees them to the canonical camera's frame: farther by the zoom, and turned back.
pub fn zoom_joints(seen: &[f32], gaze: &Gaze) -> Vec<f32> {
    let (joints, _) = seen.as_chunks();
    joints
        .iter()
        .flat_map(|&[x, y, z]| gaze.turned_back([x, y, z * gaze.zoom]))
        .collect()
}
