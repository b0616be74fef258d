use super::{Tensor, overlay};
use crate::camera::Intrinsics;
use crate::network::{Overlay, Shape, Zoom};

/// The camera that the joint network looks through: where the canonical camera is, turned to the robot, zoomed in on
/// it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// Rows of the rotation from the canonical camera's frame to this one's.
    pub rotation: [[f32; 3]; 3],
    /// Its focal length, as a multiple of the canonical camera's.
    pub zoom: f32,
}

impl Gaze {
    /// The canonical camera itself.
    pub const CANONICAL: Self = Self {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        zoom: 1.0,
    };

    /// What lies in the direction `seen`, in the canonical camera's frame.
    fn turned_back(&self, seen: [f32; 3]) -> [f32; 3] {
        let [right, down, ahead] = self.rotation;
        [0, 1, 2].map(|axis| right[axis] * seen[0] + down[axis] * seen[1] + ahead[axis] * seen[2])
    }
}

/// Turns the joint network's camera to the pixels that the overlay's `rule` shows by `mask` `[1, height, width]`, each as
/// heavy as it is shown: to their mean, so close that `spread` of their standard deviations are as wide or as high as the
/// image. Where there are none, it is the canonical `camera`.
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
    let wanted: f32 = 1.0 / share[0].max(share[1]).max(1e-6);
    let x = (mean[0] as f32 + middle[0] - camera.cx as f32) / camera.fx as f32;
    let y = (mean[1] as f32 + middle[1] - camera.cy as f32) / camera.fy as f32;
    let length = (x * x + y * y + 1.0).sqrt();
    let [x, y, z] = [x / length, y / length, 1.0 / length];
    // The shortest turn that brings the axis to the ray.
    let [bent_x, bent_y] = [x / (1.0 + z), y / (1.0 + z)];
    Gaze {
        rotation: [
            [1.0 - x * bent_x, -x * bent_y, -x],
            [-y * bent_x, 1.0 - y * bent_y, -y],
            [x, y, z],
        ],
        zoom: wanted.clamp(zoom.least, zoom.most),
    }
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
    let Shape { height, width, .. } = image.shape();
    let focal = [camera.fx as f32, camera.fy as f32];
    let centre = [camera.cx as f32, camera.cy as f32];
    let (mut seen, mut covered) = (image.clone(), mask.clone());
    for y in 0..height {
        for x in 0..width {
            let ray = gaze.turned_back([
                (x as f32 - centre[0]) / (focal[0] * gaze.zoom),
                (y as f32 - centre[1]) / (focal[1] * gaze.zoom),
                1.0,
            ]);
            // Behind the canonical camera it sees nothing.
            let at = (ray[2] > 1e-3)
                .then(|| [0, 1].map(|axis| ray[axis] / ray[2] * focal[axis] + centre[axis]));
            let from = |source: &Tensor, channel| at.map_or(0.0, |at| sample(source, channel, at));
            let to = y * width + x;
            covered.data[to] = from(mask, 0);
            for channel in 0..image.shape().channels {
                seen.data[channel * height * width + to] = from(image, channel);
            }
        }
    }
    overlay(&seen, &covered, rule)
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
