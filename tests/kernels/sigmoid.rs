//! The sigmoid kernel against the reference.

use crate::common::{check_folded, check_layer, difference, on_gpu, on_reference, one_layer};
use proptest::prelude::*;
use whereabot::network::{Operation, Shape};

proptest! {
    #![proptest_config(crate::common::cases(16))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        channels in 1_usize..10,
        (height, width) in (1_usize..20, 1_usize..20),
        batch in 1_usize..4,
        seed in any::<u32>(),
    ) {
        check_layer(Operation::Sigmoid, Shape::new(channels, height, width), batch, seed.into(), 1e-6);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let network = one_layer(Operation::Sigmoid, Shape::new(1, 45, 70), 1);
    check_folded(&network, None, 1e-6);
}

#[test]
fn large_values_saturate_and_a_wrong_value_is_noticed() {
    let input = Shape::new(1, 1, 4);
    let network = one_layer(Operation::Sigmoid, input, 1);
    let mut values = vec![-1000.0, 1000.0, 0.0, 1.0];
    let gpu = on_gpu(&network, 1, &values);
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() < 1e-6);
    assert!(difference(&gpu[..3], &[0.0, 1.0, 0.5]).unwrap() < 1e-6);
    values[3] = 1.1;
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() > 1e-3);
}
