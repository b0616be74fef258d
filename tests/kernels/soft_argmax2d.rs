//! The soft-argmax kernel against the reference, and what such layers make together.

use crate::common::{
    cases, check_folded, check_network, difference, network, noise, on_gpu, on_reference,
    with_one_weight_changed,
};
use proptest::prelude::*;
use whereabot::network::{Activation, Layer, Network, Operation, Parameters, Shape};

fn layer(name: &str, inputs: &[&str], operation: Operation) -> Layer {
    Layer {
        name: name.into(),
        inputs: inputs.iter().map(|&input| input.to_owned()).collect(),
        operation,
    }
}

fn pointwise(out_channels: usize) -> Operation {
    Operation::Conv2d {
        out_channels,
        kernel: 1,
        dilation: 1,
        activation: Activation::None,
    }
}

fn dense(out_features: usize, activation: Activation) -> Operation {
    Operation::Dense {
        out_features,
        activation,
    }
}

/// Soft-argmax of an input `[4 * joints, height, width]`: heat maps, then votes.
fn soft_argmax(
    joints: usize,
    (height, width): (usize, usize),
    origin: [f32; 2],
    step: [f32; 2],
) -> Network {
    let layers = vec![
        layer("heat", &["input"], pointwise(joints)),
        layer("votes", &["input"], pointwise(3 * joints)),
        layer(
            "position",
            &["heat", "votes"],
            Operation::SoftArgmax2d { origin, step },
        ),
    ];
    // The convolutions pick channels out.
    let input = Shape::new(4 * joints, height, width);
    Network::new("input", input, layers, |name, weight, bias| {
        let first = if name == "heat" { 0 } else { joints };
        let mut weights = vec![0.0; weight.iter().product()];
        for (channel, row) in weights.chunks_exact_mut(4 * joints).enumerate() {
            row[first + channel] = 1.0;
        }
        Ok(Parameters {
            weight: weights,
            bias: vec![0.0; bias[0]],
        })
    })
    .unwrap()
}

/// Both paths' results for one image, held to `expected`.
fn check_answer(network: &Network, values: &[f32], expected: &[f32], tolerance: f32) {
    for found in [on_reference(network, values), on_gpu(network, 1, values)] {
        let greatest = difference(&found, expected).unwrap();
        assert!(greatest <= tolerance, "{found:?}: differs by {greatest}");
    }
}

proptest! {
    #![proptest_config(cases(16))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        joints in 1_usize..10,
        (height, width) in (1_usize..20, 1_usize..20),
        batch in 1_usize..4,
        origin in prop::array::uniform2(-1.0_f32..1.0),
        step in prop::array::uniform2(0.01_f32..0.1),
        sharpness in prop::sample::select(vec![1.0_f32, 30.0, 1e4]),
        seed in any::<u32>(),
    ) {
        let network = soft_argmax(joints, (height, width), origin, step);
        let plane = height * width;
        let mut values = noise(batch * network.input().len(), seed.into());
        for image in values.chunks_exact_mut(4 * joints * plane) {
            image.iter_mut().take(joints * plane).for_each(|logit| *logit *= sharpness);
        }
        let gpu = on_gpu(&network, batch, &values);
        let found = difference(&gpu, &on_reference(&network, &values)).unwrap();
        prop_assert!(found <= 1e-5, "differs by {found}");
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let layers = vec![
        layer("votes", &["input", "input", "input"], Operation::Concat),
        layer(
            "position",
            &["input", "votes"],
            Operation::SoftArgmax2d {
                origin: [0.5, -0.5],
                step: [0.1, 0.2],
            },
        ),
    ];
    check_folded(&network(layers, Shape::new(45, 1, 2), 1), None, 1e-5);
}

#[test]
fn weights_of_three_to_one_meet_a_quarter_of_the_way() {
    let network = soft_argmax(1, (2, 2), [-1.0, 5.0], [2.0, 4.0]);
    let ln3 = 3_f32.ln();
    let below = -1e4;
    let heat = [ln3, 0.0, below, below];
    let votes = [
        [0.0, 0.4, 9.0, 9.0],
        [1.0, 1.0, 9.0, 9.0],
        [-2.0, 2.0, 9.0, 9.0],
    ];
    let values = [&heat[..], &votes.concat()].concat();
    // x = -1 + 2 / 4 + 0.4 / 4, y = 5 + 1, d = -2 * 3 / 4 + 2 / 4
    check_answer(&network, &values, &[-0.4, 6.0, -1.0], 1e-5);
    // Adding the same to all logits changes nothing but their rounding.
    let shifted: Vec<f32> = heat.iter().map(|logit| logit + 1e4).collect();
    let values = [&shifted[..], &votes.concat()].concat();
    check_answer(&network, &values, &[-0.4, 6.0, -1.0], 1e-3);
    // Negative control: rows and columns are not exchanged.
    let found = on_gpu(&network, 1, &values);
    assert!(difference(&found, &[6.0, -0.4, -1.0]).unwrap() > 1.0);
}

#[test]
fn great_logits_pick_their_cell() {
    let (height, width) = (9, 13);
    for (row, column) in [(0, 0), (4, 7), (8, 12)] {
        for (greatest, others) in [(1e4, -1e4), (1e4, 9e3), (-9e3, -1e4), (3e38, -3e38)] {
            let network = soft_argmax(1, (height, width), [10.0, 20.0], [1.0, 2.0]);
            let mut values = vec![others; 4 * height * width];
            values[row * width + column] = greatest;
            values[height * width..].fill(0.25);
            let (x, y) = (10.25 + column as f32, 20.25 + 2.0 * row as f32);
            check_answer(&network, &values, &[x, y, 0.25], 1e-5);
        }
    }
}

#[test]
fn one_cell_is_where_it_is() {
    let network = soft_argmax(2, (1, 1), [1.0, 2.0], [9.0, 9.0]);
    let values = [-1e4, 1e4, 0.1, 0.2, 0.3, -0.1, -0.2, -0.3];
    check_answer(&network, &values, &[1.1, 2.2, 0.3, 0.9, 1.8, -0.3], 1e-6);
}

#[test]
fn a_wrong_logit_and_a_wrong_vote_are_noticed() {
    let network = soft_argmax(3, (5, 7), [0.0, 0.0], [1.0, 1.0]);
    let values = noise(network.input().len(), 4);
    let gpu = on_gpu(&network, 1, &values);
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() <= 1e-5);
    for wrong in [40, 3 * 35 + 40, 11 * 35 + 20] {
        let mut values = values.clone();
        values[wrong] += 0.5;
        assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() > 1e-3);
    }
}

/// Heat maps and votes of convolutions, corrected by dense layers, and joints in space.
fn joint_network(joints: usize, input: Shape, seed: u64) -> Network {
    let layers = vec![
        layer("trunk", &["input"], pointwise(10)),
        layer("heat", &["trunk"], pointwise(joints)),
        layer("votes", &["trunk"], pointwise(3 * joints)),
        layer(
            "position",
            &["heat", "votes"],
            Operation::SoftArgmax2d {
                origin: [-0.7, -0.6],
                step: [0.1, 0.15],
            },
        ),
        layer("hidden", &["position"], dense(7, Activation::Relu)),
        layer("both", &["position", "hidden"], Operation::Concat),
        layer("corrected", &["both"], dense(3 * joints, Activation::None)),
        layer("joints", &["corrected"], Operation::BackProject),
    ];
    network(layers, input, seed)
}

#[test]
fn a_network_of_heat_maps_agrees() {
    for (joints, batch, seed) in [(1, 1, 1), (6, 2, 2), (7, 3, 3)] {
        let network = joint_network(joints, Shape::new(3, 9, 14), seed);
        assert_eq!(network.output(), Shape::new(3 * joints, 1, 1));
        check_network(&network, batch, seed, 1e-5);
    }
}

#[test]
fn a_wrong_weight_before_the_heat_maps_is_noticed() {
    let network = joint_network(6, Shape::new(3, 9, 14), 1);
    let values = noise(network.input().len(), 5);
    let other = with_one_weight_changed(&network, 0.1);
    let gpu = on_gpu(&network, 1, &values);
    assert!(difference(&gpu, &on_reference(&other, &values)).unwrap() > 1e-4);
}
