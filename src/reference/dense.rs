use rayon::prelude::*;

use super::{Tensor, activate};
use crate::network::{Activation, Parameters, Shape};

/// A fully connected layer over the input flattened in `[channel, row, column]` order.
///
/// `parameters.weight` is `[out_features, inputs]`, `bias` `[out_features]`; the output has shape
/// `[out_features, 1, 1]`.
pub fn dense(input: &Tensor, parameters: &Parameters, activation: Activation) -> Tensor {
    let mut output = Tensor::full(Shape::new(parameters.bias.len(), 1, 1), 0.0);
    output
        .data_mut()
        .par_iter_mut()
        .zip(parameters.weight.par_chunks_exact(input.data().len()))
        .zip(&parameters.bias)
        .for_each(|((out, weights), bias)| {
            // Some hundred thousand terms: in f64 their rounding stays out of the comparison.
            let sum: f64 = weights
                .iter()
                .zip(input.data())
                .map(|(w, x)| f64::from(w * x))
                .sum();
            *out = (sum + f64::from(*bias)) as f32;
        });
    activate(output.data_mut(), activation);
    output
}
