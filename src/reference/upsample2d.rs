use rayon::prelude::*;

use super::Tensor;
use crate::network::Shape;

/// Bilinear enlargement by `scale`, pixel centres aligned as areas (PyTorch's
/// `align_corners=False`); beyond the border its pixels go on.
pub fn upsample2d(input: &Tensor, scale: usize) -> Tensor {
    let Shape {
        channels,
        height,
        width,
    } = input.shape();
    let mut output = Tensor::full(Shape::new(channels, height * scale, width * scale), 0.0);
    output
        .data_mut()
        .par_chunks_mut(width * scale)
        .enumerate()
        .for_each(|(index, out_row)| {
            let (c, y) = (index / (height * scale), index % (height * scale));
            let (top, bottom, part_y) = neighbours(y, scale, height);
            let (top, bottom) = (input.row(c, top), input.row(c, bottom));
            for (x, out) in out_row.iter_mut().enumerate() {
                let (left, right, part_x) = neighbours(x, scale, width);
                let across = |row: &[f32]| row[left] * (1.0 - part_x) + row[right] * part_x;
                *out = across(top) * (1.0 - part_y) + across(bottom) * part_y;
            }
        });
    output
}

/// The two input pixels round output pixel `index`, and the share of the second.
fn neighbours(index: usize, scale: usize, side: usize) -> (usize, usize, f32) {
    // In half pixels of the output.
    let at = (2 * index + 1).max(scale) - scale;
    let low = at / (2 * scale);
    let part = (at % (2 * scale)) as f32 / (2 * scale) as f32;
    (low, (low + 1).min(side - 1), part)
}
