//! The pooling kernel against the reference.

use crate::common::{
    check_folded, check_layer, difference, noise, on_gpu, on_reference, one_layer,
};
use proptest::prelude::*;
use whereabot::network::{Operation, Shape};

proptest! {
    #![proptest_config(crate::common::cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        channels in 1_usize..10,
        (height, width) in (1_usize..40, 1_usize..40),
        batch in 1_usize..4,
        size in 1_usize..6,
        seed in any::<u32>(),
    ) {
        let size = size.min(height).min(width);
        check_layer(Operation::MaxPool2d { size }, Shape::new(channels, height, width), batch, seed.into(), 0.0);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let network = one_layer(Operation::MaxPool2d { size: 1 }, Shape::new(1, 45, 70), 1);
    check_folded(&network, None, 0.0);
}

#[test]
fn a_wrong_pixel_is_noticed() {
    let input = Shape::new(3, 10, 13);
    let network = one_layer(Operation::MaxPool2d { size: 2 }, input, 1);
    let mut values = noise(input.len(), 4);
    let gpu = on_gpu(&network, 1, &values);
    assert_eq!(difference(&gpu, &on_reference(&network, &values)), Ok(0.0));
    values[0] = 2.0;
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() > 0.5);
}
