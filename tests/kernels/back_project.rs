//! The back-projection kernel against the reference.

use crate::common::{
    cases, check_folded, check_layer, difference, noise, on_gpu, on_reference, one_layer,
};
use proptest::prelude::*;
use whereabot::network::{Operation, Shape};

proptest! {
    #![proptest_config(cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        joints in 1_usize..10,
        batch in 1_usize..4,
        seed in any::<u32>(),
    ) {
        check_layer(Operation::BackProject, Shape::new(3 * joints, 1, 1), batch, seed.into(), 2e-6);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let input = Shape::new(3 * 64 * 24, 1, 1);
    check_folded(&one_layer(Operation::BackProject, input, 3), None, 2e-6);
}

#[test]
fn slopes_times_depth_are_metres() {
    let network = one_layer(Operation::BackProject, Shape::new(6, 1, 1), 1);
    let values = [0.5, -0.25, 2_f32.ln(), 1.0, 2.0, 0.0];
    let expected = [1.0, -0.5, 2.0, 1.0, 2.0, 1.0];
    for found in [
        on_reference(&network, &values),
        on_gpu(&network, 1, &values),
    ] {
        assert!(difference(&found, &expected).unwrap() < 1e-6);
        // Negative control: a joint's values are not another's.
        let swapped = [1.0, 2.0, 1.0, 1.0, -0.5, 2.0];
        assert!(difference(&found, &swapped).unwrap() > 0.5);
    }
}

#[test]
fn a_depth_beyond_f32_is_not_finite() {
    let network = one_layer(Operation::BackProject, Shape::new(6, 1, 1), 1);
    let values = [0.5, -0.25, 100.0, 0.5, -0.25, 80.0];
    for found in [
        on_reference(&network, &values),
        on_gpu(&network, 1, &values),
    ] {
        assert!(found.iter().take(3).all(|v| v.is_infinite()), "{found:?}");
        assert!(found.iter().skip(3).all(|v| v.is_finite()), "{found:?}");
    }
}

#[test]
fn a_wrong_value_is_noticed() {
    let input = Shape::new(9, 1, 1);
    let network = one_layer(Operation::BackProject, input, 1);
    let mut values = noise(input.len(), 4);
    let gpu = on_gpu(&network, 1, &values);
    values[5] += 0.5;
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() > 0.1);
}
