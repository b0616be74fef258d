use super::{Tensor, activate};
use crate::network::Activation;

/// `1 / (1 + exp(-x))` of each value.
pub fn sigmoid(input: &Tensor) -> Tensor {
    let mut output = input.clone();
    activate(output.data_mut(), Activation::Sigmoid);
    output
}
