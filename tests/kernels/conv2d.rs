//! The convolution kernel against the reference.

use crate::common::{
    check_folded, check_layer, check_network_by, device, difference, in_halves, narrow_device,
    network, noise, on_gpu, on_gpu_by, on_reference, one_layer, rounding,
};
use proptest::prelude::*;
use whereabot::gpu::{Conv2dKernel, Layout, NetworkPlan};
use whereabot::network::{Activation, Layer, Network, Operation, Shape};

fn conv2d(
    out_channels: usize,
    kernel: usize,
    dilation: usize,
    activation: Activation,
) -> Operation {
    Operation::Conv2d {
        out_channels,
        kernel,
        dilation,
        activation,
    }
}

fn any_activation() -> impl Strategy<Value = Activation> {
    prop_oneof![
        Just(Activation::None),
        Just(Activation::Relu),
        Just(Activation::Sigmoid)
    ]
}

proptest! {
    #![proptest_config(crate::common::cases(16))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        (channels, out_channels) in (1_usize..14, 1_usize..20),
        (height, width) in (1_usize..24, 1_usize..24),
        batch in 1_usize..4,
        kernel in prop_oneof![Just(1_usize), Just(3), Just(5)],
        dilation in 1_usize..30,
        activation in any_activation(),
        seed in any::<u32>(),
    ) {
        let input = Shape::new(channels, height, width);
        let terms = channels * kernel * kernel;
        check_layer(conv2d(out_channels, kernel, dilation, activation), input, batch, seed.into(), rounding(terms));
    }
}

/// The kernels that this device can run, after saying which it cannot.
fn kernels() -> Vec<Conv2dKernel> {
    let (here, elsewhere): (Vec<_>, Vec<_>) = Conv2dKernel::ALL
        .into_iter()
        .partition(|kernel| kernel.runs_on(&device()));
    for kernel in elsewhere {
        println!("{kernel} cannot run on {}", device().info().name);
    }
    here
}

/// One channel for the kernels that make only one.
fn channels_for(kernel: Conv2dKernel, channels: usize) -> usize {
    if matches!(kernel, Conv2dKernel::SubgroupOne | Conv2dKernel::One) {
        1
    } else {
        channels
    }
}

proptest! {
    #![proptest_config(crate::common::cases(16))]

    #[test]
    fn each_kernel_agrees_with_the_reference(
        (channels, out_channels) in (1_usize..20, 1_usize..20),
        (height, width) in (1_usize..40, 1_usize..40),
        batch in 1_usize..4,
        side in prop_oneof![Just(1_usize), Just(3), Just(5)],
        dilation in 1_usize..17,
        activation in any_activation(),
        seed in any::<u32>(),
    ) {
        // A kernel that shares rows wants a margin as wide as it reaches.
        let dilation = dilation.min(height.max(width).div_ceil(side / 2 + 1));
        let input = Shape::new(channels, height, width);
        for kernel in kernels() {
            let out_channels = channels_for(kernel, out_channels);
            let network = one_layer(conv2d(out_channels, side, dilation, activation), input, seed.into());
            let tolerance = rounding(channels * side * side);
            for &layout in kernel.layouts() {
                check_network_by(&device(), layout, Some(kernel), &network, batch, seed.into(), tolerance);
            }
        }
    }
}

#[test]
fn each_kernel_notices_a_wrong_weight() {
    let input = Shape::new(6, 9, 11);
    let values = in_halves(&noise(2 * input.len(), 2));
    for kernel in kernels() {
        let out_channels = channels_for(kernel, 5);
        let network = one_layer(conv2d(out_channels, 3, 2, Activation::None), input, 1);
        let other = crate::common::with_one_weight_changed(&network, 2e-2);
        for &layout in kernel.layouts() {
            let gpu = on_gpu_by(&device(), layout, Some(kernel), &network, 2, &values);
            let (right, wrong) = match layout {
                Layout::HalfBuffer => (2e-3, 4e-3),
                Layout::Buffer | Layout::Texture => (1e-5, 1e-3),
            };
            assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() < right);
            assert!(difference(&gpu, &on_reference(&other, &values)).unwrap() > wrong);
        }
    }
}

/// A convolution, the max-pool behind it, and perhaps another reader of the convolution.
fn with_pool(
    operation: Operation,
    size: usize,
    input: Shape,
    read_by_others: bool,
    seed: u64,
) -> Network {
    let layer = |name: &str, inputs: &[&str], operation| Layer {
        name: name.into(),
        inputs: inputs.iter().map(|&input| input.to_owned()).collect(),
        operation,
    };
    let mut layers = vec![
        layer("layer", &["input"], operation),
        layer("pool", &["layer"], Operation::MaxPool2d { size }),
    ];
    if read_by_others {
        let again = Operation::MaxPool2d { size };
        layers.push(layer("again", &["layer"], again));
        layers.push(layer("both", &["pool", "again"], Operation::Concat));
    }
    network(layers, input, seed)
}

/// How many dispatches a convolution and its max-pool are in `layout`.
fn dispatches(network: &Network, layout: Layout, kernel: Conv2dKernel) -> usize {
    let device = device();
    let input = NetworkPlan::input(&device, layout, "input", network, 1).unwrap();
    let plan = NetworkPlan::with_kernel(&device, "net", network, &input, Some(kernel)).unwrap();
    plan.steps().len()
}

proptest! {
    #![proptest_config(crate::common::cases(16))]

    #[test]
    fn a_max_pool_made_with_it_agrees_with_the_reference(
        (channels, out_channels) in (1_usize..10, 1_usize..20),
        (height, width) in (1_usize..60, 1_usize..60),
        batch in 1_usize..4,
        side in prop_oneof![Just(1_usize), Just(3), Just(5)],
        (dilation, size) in (1_usize..3, 1_usize..6),
        activation in any_activation(),
        read_by_others in any::<bool>(),
        seed in any::<u32>(),
    ) {
        let input = Shape::new(channels, height, width);
        let size = size.min(height).min(width);
        let dilation = dilation.min(height.max(width).div_ceil(side / 2 + 1));
        let operation = conv2d(out_channels, side, dilation, activation);
        let network = with_pool(operation, size, input, read_by_others, seed.into());
        let tolerance = rounding(channels * side * side);
        for kernel in kernels().into_iter().filter(|kernel| channels_for(*kernel, 2) > 1) {
            for &layout in kernel.layouts() {
                check_network_by(&device(), layout, Some(kernel), &network, batch, seed.into(), tolerance);
            }
        }
    }
}

#[test]
fn a_max_pool_is_made_with_the_convolution_that_nothing_else_reads() {
    let kernel = Conv2dKernel::Subgroup;
    if !kernel.runs_on(&device()) {
        println!("{kernel} cannot run on {}", device().info().name);
        return;
    }
    let input = Shape::new(3, 21, 30);
    let made = |dilation, size, others| {
        let operation = conv2d(8, 3, dilation, Activation::Relu);
        let network = with_pool(operation, size, input, others, 1);
        dispatches(&network, Layout::Texture, kernel)
    };
    assert_eq!([made(1, 2, false), made(1, 4, false)], [1, 1]);
    // Other windows, lattices of the dilation, and what others read are not.
    assert_eq!([made(1, 3, false), made(2, 4, false)], [2, 2]);
    assert!(made(1, 2, true) > 2);

    // Negative control: its values are the convolution's.
    let network = with_pool(conv2d(5, 3, 1, Activation::None), 2, input, false, 1);
    let other = crate::common::with_one_weight_changed(&network, 1e-2);
    let values = noise(input.len(), 2);
    let gpu = on_gpu_by(
        &device(),
        Layout::Texture,
        Some(kernel),
        &network,
        1,
        &values,
    );
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() < 1e-5);
    assert!(difference(&gpu, &on_reference(&other, &values)).unwrap() > 1e-3);
}

#[test]
fn a_kernel_that_does_not_serve_a_layer_says_so() {
    let network = one_layer(conv2d(2, 3, 1, Activation::None), Shape::new(3, 4, 5), 1);
    let device = device();
    let input = NetworkPlan::input(&device, Layout::Buffer, "input", &network, 1).unwrap();
    let plan = |kernel| NetworkPlan::with_kernel(&device, "net", &network, &input, Some(kernel));
    let error = plan(Conv2dKernel::Texture).unwrap_err().to_string();
    assert!(
        error.contains("net.layer") && error.contains("conv2d_texture"),
        "{error}"
    );
    plan(Conv2dKernel::Buffer).unwrap();
}

#[test]
fn layers_of_the_paper_agree() {
    for (channels, out_channels, dilation) in [(3, 32, 1), (32, 32, 8), (32, 1, 1)] {
        let operation = conv2d(out_channels, 3, dilation, Activation::Relu);
        check_layer(operation, Shape::new(channels, 53, 64), 1, 7, 1e-5);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let here = narrow_device(16);
    for kernel in kernels().into_iter().filter(|kernel| kernel.runs_on(&here)) {
        let operation = conv2d(channels_for(kernel, 8), 3, 1, Activation::None);
        let network = one_layer(operation, Shape::new(3, 83, 107), 11);
        check_folded(&network, Some(kernel), rounding(27));
    }
}

#[test]
fn a_dilation_beyond_the_image_reaches_only_zeros() {
    let input = Shape::new(5, 6, 7);
    let wide = one_layer(conv2d(3, 3, 50, Activation::None), input, 3);
    let values = noise(input.len(), 5);
    // Then only the kernel's centre counts: the reference agrees with a 1 x 1 convolution.
    let mut centre = one_layer(conv2d(3, 1, 1, Activation::None), input, 3);
    let taps = wide.nodes()[0].parameters.clone().unwrap();
    centre = whereabot::network::Network::new(
        "input",
        input,
        vec![centre.nodes()[0].layer.clone()],
        |_, _, _| {
            Ok(whereabot::network::Parameters {
                weight: taps.weight.iter().skip(4).step_by(9).copied().collect(),
                bias: taps.bias.clone(),
            })
        },
    )
    .unwrap();
    let expected = on_reference(&centre, &values);
    assert!(difference(&on_reference(&wide, &values), &expected).unwrap() < 1e-6);
    assert!(difference(&on_gpu(&wide, 1, &values), &expected).unwrap() < 1e-6);
}

#[test]
fn a_wrong_weight_is_noticed() {
    let input = Shape::new(6, 9, 11);
    let network = one_layer(conv2d(5, 3, 2, Activation::Relu), input, 1);
    let other = crate::common::with_one_weight_changed(&network, 1e-2);
    let values = noise(input.len(), 2);
    let gpu = on_gpu(&network, 1, &values);
    assert!(difference(&gpu, &on_reference(&network, &values)).unwrap() < 1e-5);
    assert!(difference(&gpu, &on_reference(&other, &values)).unwrap() > 1e-3);
}
