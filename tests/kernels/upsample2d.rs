//! The upsampling kernel against the reference.

use crate::common::{
    cases, check_folded, check_layer, difference, noise, on_gpu, on_reference, one_layer,
};
use proptest::prelude::*;
use whereabot::network::{Operation, Shape};

proptest! {
    #![proptest_config(cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        channels in 1_usize..10,
        (height, width) in (1_usize..20, 1_usize..20),
        batch in 1_usize..4,
        scale in 1_usize..5,
        seed in any::<u32>(),
    ) {
        check_layer(Operation::Upsample2d { scale }, Shape::new(channels, height, width), batch, seed.into(), 2e-6);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let network = one_layer(Operation::Upsample2d { scale: 3 }, Shape::new(1, 15, 23), 1);
    check_folded(&network, None, 2e-6);
}

#[test]
fn an_edge_is_spread_over_the_pixels_between() {
    let network = one_layer(Operation::Upsample2d { scale: 2 }, Shape::new(1, 1, 2), 1);
    let expected = [0.0, 0.25, 0.75, 1.0, 0.0, 0.25, 0.75, 1.0];
    assert!(difference(&on_reference(&network, &[0.0, 1.0]), &expected).unwrap() < 1e-6);
    assert!(difference(&on_gpu(&network, 1, &[0.0, 1.0]), &expected).unwrap() < 1e-6);
}

#[test]
fn a_wrong_pixel_is_noticed() {
    let input = Shape::new(3, 5, 7);
    let network = one_layer(Operation::Upsample2d { scale: 2 }, input, 1);
    let mut values = noise(input.len(), 4);
    let gpu = on_gpu(&network, 1, &values);
    values[17] += 0.5;
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() > 0.1);
}
