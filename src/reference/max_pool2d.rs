use rayon::prelude::*;

use super::Tensor;
use crate::network::Shape;

/// Maximum over windows of `size` x `size`, side by side; rows and columns left over at the bottom
/// and right are dropped.
pub fn max_pool2d(input: &Tensor, size: usize) -> Tensor {
    let shape = input.shape();
    let (height, width) = (shape.height / size, shape.width / size);
    let mut output = Tensor::full(Shape::new(shape.channels, height, width), f32::NEG_INFINITY);
    output
        .data_mut()
        .par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(index, out_row)| {
            let (c, y) = (index / height, index % height);
            for in_y in y * size..(y + 1) * size {
                for (out, window) in out_row
                    .iter_mut()
                    .zip(input.row(c, in_y).chunks_exact(size))
                {
                    *out = window.iter().copied().fold(*out, f32::max);
                }
            }
        });
    output
}
