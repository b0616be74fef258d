//! The concatenation kernel against the reference.

use crate::common::{
    cases, check_folded, check_network, difference, network, noise, on_gpu, on_reference,
};
use proptest::prelude::*;
use whereabot::network::{Activation, Layer, Network, Operation, Shape};

/// The input, and convolutions of it with these numbers of filters, side by side.
fn side_by_side(filters: &[usize], input: Shape, seed: u64) -> Network {
    let mut inputs = vec!["input".to_owned()];
    let mut layers: Vec<Layer> = filters
        .iter()
        .enumerate()
        .map(|(index, &out_channels)| Layer {
            name: format!("conv{index}"),
            inputs: vec!["input".into()],
            operation: Operation::Conv2d {
                out_channels,
                kernel: 1,
                dilation: 1,
                activation: Activation::None,
            },
        })
        .collect();
    inputs.extend(layers.iter().map(|layer| layer.name.clone()));
    layers.push(Layer {
        name: "concat".into(),
        inputs,
        operation: Operation::Concat,
    });
    network(layers, input, seed)
}

proptest! {
    #![proptest_config(cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        channels in 1_usize..10,
        filters in prop::collection::vec(1_usize..10, 1..4),
        (height, width) in (1_usize..20, 1_usize..20),
        batch in 1_usize..4,
        seed in any::<u32>(),
    ) {
        let network = side_by_side(&filters, Shape::new(channels, height, width), seed.into());
        prop_assert_eq!(network.output().channels, channels + filters.iter().sum::<usize>());
        check_network(&network, batch, seed.into(), 1e-5);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    check_folded(&side_by_side(&[2], Shape::new(1, 45, 70), 1), None, 1e-5);
}

#[test]
fn layers_write_to_their_places() {
    let conv = |name: &str, out_channels| Layer {
        name: name.into(),
        inputs: vec!["input".into()],
        operation: Operation::Conv2d {
            out_channels,
            kernel: 3,
            dilation: 1,
            activation: Activation::None,
        },
    };
    for first in [3, 4, 8] {
        let concat = Layer {
            name: "concat".into(),
            inputs: vec!["first".into(), "second".into()],
            operation: Operation::Concat,
        };
        let layers = vec![conv("first", first), conv("second", 5), concat];
        let network = network(layers, Shape::new(3, 6, 7), 1);
        check_network(&network, 2, 2, 1e-5);
    }
}

#[test]
fn channels_keep_their_order() {
    let input = Shape::new(3, 2, 2);
    let network = network(
        vec![Layer {
            name: "twice".into(),
            inputs: vec!["input".into(), "input".into()],
            operation: Operation::Concat,
        }],
        input,
        1,
    );
    let values = noise(12, 1);
    let twice = [values.clone(), values.clone()].concat();
    assert_eq!(on_reference(&network, &values), twice);
    assert_eq!(on_gpu(&network, 1, &values), twice);
    // Negative control: another order is another result.
    let mut swapped = twice;
    swapped.swap(0, 4);
    assert!(difference(&on_gpu(&network, 1, &values), &swapped).unwrap() > 0.0);
}
