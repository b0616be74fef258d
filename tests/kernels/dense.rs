//! The dense kernel against the reference.

use crate::common::{
    check_folded, check_layer, difference, noise, on_gpu, on_reference, one_layer, rounding,
};
use proptest::prelude::*;
use whereabot::network::{Activation, Operation, Shape};

fn dense(out_features: usize, activation: Activation) -> Operation {
    Operation::Dense {
        out_features,
        activation,
    }
}

proptest! {
    #![proptest_config(crate::common::cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        channels in 1_usize..14,
        (height, width) in (1_usize..30, 1_usize..30),
        out_features in 1_usize..40,
        batch in 1_usize..4,
        activation in prop_oneof![Just(Activation::None), Just(Activation::Relu), Just(Activation::Sigmoid)],
        seed in any::<u32>(),
    ) {
        let input = Shape::new(channels, height, width);
        check_layer(dense(out_features, activation), input, batch, seed.into(), rounding(input.len()));
    }
}

#[test]
fn the_length_of_the_joint_network_agrees() {
    let input = Shape::new(128, 53, 64);
    check_layer(dense(18, Activation::None), input, 1, 5, 1e-4);
}

#[test]
fn dense_after_dense_reads_all_its_channels() {
    check_layer(dense(7, Activation::Relu), Shape::new(18, 1, 1), 3, 9, 1e-5);
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let input = Shape::new(1, 1, 5);
    let network = one_layer(dense(200, Activation::None), input, 13);
    check_folded(&network, None, 1e-5);
}

#[test]
fn a_wrong_weight_is_noticed() {
    let input = Shape::new(6, 9, 11);
    let network = one_layer(dense(18, Activation::None), input, 1);
    let other = crate::common::with_one_weight_changed(&network, 1e-2);
    let values = noise(input.len(), 2);
    let gpu = on_gpu(&network, 1, &values);
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() < 1e-5);
    assert!(difference(&gpu, &on_reference(&other, &values)).unwrap() > 1e-3);
}
