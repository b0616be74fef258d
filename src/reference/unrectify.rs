use rayon::prelude::*;

use super::Tensor;
use crate::camera::Unrectification;

/// The mask `[1, height, width]` in the camera's image as it is stored, row by row: bilinear, 0 where the
/// canonical camera sees nothing and where a value is not finite. In f32 as the kernel.
pub fn unrectify(mask: &Tensor, params: &Unrectification) -> Vec<f32> {
    let [width, height] = params.size;
    (0..height)
        .into_par_iter()
        .flat_map_iter(|y| (0..width).map(move |x| sample(mask, canonical(params, [x, y]))))
        .collect()
}

/// The canonical pixel of a texel.
fn canonical(params: &Unrectification, texel: [u32; 2]) -> [f32; 2] {
    const STEP: u32 = Unrectification::STEP;
    let [column, row] = texel.map(|v| v / STEP);
    let [x, y] = texel.map(|v| (v % STEP) as f32 / STEP as f32);
    let node = |column: u32, row: u32| params.nodes[(row * params.columns + column) as usize];
    let top = mix(node(column, row), node(column + 1, row), x);
    let bottom = mix(node(column, row + 1), node(column + 1, row + 1), x);
    mix(top, bottom, y)
}

fn mix(a: [f32; 2], b: [f32; 2], t: f32) -> [f32; 2] {
    [0, 1].map(|i| a[i] * (1.0 - t) + b[i] * t)
}

/// Pixels reach half a pixel beyond their centres.
fn sample(mask: &Tensor, [x, y]: [f32; 2]) -> f32 {
    let (width, height) = (mask.shape().width, mask.shape().height);
    let last = [width - 1, height - 1].map(|v| v as f32);
    if !(x >= -0.5 && y >= -0.5 && x <= last[0] + 0.5 && y <= last[1] + 0.5) {
        return 0.0;
    }
    let (x, y) = (x.clamp(0.0, last[0]), y.clamp(0.0, last[1]));
    let (column, row) = (x as usize, y as usize);
    let (right, below) = ((column + 1).min(width - 1), (row + 1).min(height - 1));
    let [part_x, part_y] = [x - x.floor(), y - y.floor()];
    let at = |x: usize, y: usize| mask.data()[y * width + x];
    let top = at(column, row) * (1.0 - part_x) + at(right, row) * part_x;
    let bottom = at(column, below) * (1.0 - part_x) + at(right, below) * part_x;
    let value = top * (1.0 - part_y) + bottom * part_y;
    if value.is_finite() { value } else { 0.0 }
}
