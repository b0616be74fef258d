use super::Tensor;
use crate::network::Overlay;

/// The joint network's input (paper, section IV): `image` `[3, height, width]` times `mask`
/// `[1, height, width]`, or times what the rule makes of it.
pub fn overlay(image: &Tensor, mask: &Tensor, rule: Overlay) -> Tensor {
    let mut output = image.clone();
    for plane in output.data_mut().chunks_exact_mut(mask.data().len()) {
        for (value, &probability) in plane.iter_mut().zip(mask.data()) {
            *value *= rule.share(probability);
        }
    }
    output
}
