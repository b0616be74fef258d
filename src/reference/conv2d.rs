use rayon::prelude::*;

use super::{Tensor, activate};
use crate::network::{Activation, Parameters, Shape};

/// Cross-correlation with stride 1 and zero padding 'same', a bias and an activation.
///
/// `parameters.weight` is `[out_channels, in_channels, kernel, kernel]`, `bias` `[out_channels]`;
/// `kernel` is odd. The output has the input's height and width.
pub fn conv2d(
    input: &Tensor,
    parameters: &Parameters,
    kernel: usize,
    dilation: usize,
    activation: Activation,
) -> Tensor {
    let Shape {
        channels,
        height,
        width,
    } = input.shape();
    let out_channels = parameters.bias.len();
    let mut output = Tensor::full(Shape::new(out_channels, height, width), 0.0);
    let reach = kernel / 2 * dilation;
    output
        .data_mut()
        .par_chunks_mut(width)
        .enumerate()
        .for_each(|(index, out_row)| {
            let (o, y) = (index / height, index % height);
            out_row.fill(parameters.bias[o]);
            for c in 0..channels {
                for ky in 0..kernel {
                    // Rows and columns outside the image are zero: they add nothing.
                    let Some(in_y) = (y + ky * dilation)
                        .checked_sub(reach)
                        .filter(|&v| v < height)
                    else {
                        continue;
                    };
                    let in_row = input.row(c, in_y);
                    for kx in 0..kernel {
                        let weight =
                            parameters.weight[((o * channels + c) * kernel + ky) * kernel + kx];
                        let shift = kx * dilation;
                        let first = reach.saturating_sub(shift);
                        let last = (width + reach).saturating_sub(shift).min(width);
                        if first >= last {
                            continue;
                        }
                        let taps = &in_row[first + shift - reach..last + shift - reach];
                        for (out, tap) in out_row[first..last].iter_mut().zip(taps) {
                            *out += weight * tap;
                        }
                    }
                }
            }
            activate(out_row, activation);
        });
    output
}
