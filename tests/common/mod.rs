//! Shared by the tests of the layers: one device, random networks of one layer, comparison.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    missing_docs
)]

use std::sync::{Arc, OnceLock};

use whereabot::gpu::{AdapterRequest, Device, NetworkPlan, Tensor};
use whereabot::network::{Layer, Network, Operation, Parameters, Shape};
use whereabot::reference;

/// The adapter that the environment asks for, or the best: Mesa's lavapipe on a machine without a
/// GPU. A machine without any adapter fails the test: the kernels were not tested.
pub fn device() -> Arc<Device> {
    static DEVICE: OnceLock<Arc<Device>> = OnceLock::new();
    Arc::clone(DEVICE.get_or_init(|| {
        let device = Device::open(&AdapterRequest::new(None, None))
            .expect("an adapter is needed: install mesa-vulkan-drivers");
        Arc::new(device)
    }))
}

/// Values in [-1, 1), the same for the same seed.
pub fn noise(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    (0..len)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
        })
        .collect()
}

/// A network of one layer with random parameters, scaled so that sums stay near 1.
pub fn one_layer(operation: Operation, input: Shape, seed: u64) -> Network {
    let layer = Layer {
        name: "layer".into(),
        inputs: vec!["input".into()],
        operation,
    };
    Network::new("input", input, vec![layer], |_, weight, bias| {
        let len: usize = weight.iter().product();
        let scale = (3.0 * weight[0] as f32 / len as f32).sqrt();
        Ok(Parameters {
            weight: noise(len, seed).iter().map(|w| w * scale).collect(),
            bias: noise(bias[0], seed + 1),
        })
    })
    .unwrap()
}

/// What the GPU makes of a batch `[image][channel][row][column]`.
pub fn on_gpu(network: &Network, batch: usize, values: &[f32]) -> Vec<f32> {
    let device = device();
    let input = Tensor::new(&device, "input", network.input(), batch).unwrap();
    input.write(&device, values).unwrap();
    let plan = NetworkPlan::new(&device, "test", network, &input).unwrap();
    plan.run(&device).unwrap();
    plan.output().read(&device).unwrap()
}

/// What the reference makes of the same.
pub fn on_reference(network: &Network, values: &[f32]) -> Vec<f32> {
    values
        .chunks_exact(network.input().len())
        .flat_map(|image| {
            let input = reference::Tensor::new(network.input(), image.to_vec()).unwrap();
            reference::run(network, &input).unwrap().data().to_vec()
        })
        .collect()
}

/// The greatest difference; `Err` for NaN or different lengths. This is the comparator of all tests.
pub fn difference(a: &[f32], b: &[f32]) -> Result<f32, String> {
    if a.len() != b.len() {
        return Err(format!("{} values and {}", a.len(), b.len()));
    }
    let mut greatest = 0.0_f32;
    for (i, (x, y)) in a.iter().zip(b).enumerate() {
        // Infinities of the same sign differ by nothing.
        let d = if x == y { 0.0 } else { (x - y).abs() };
        if !d.is_finite() {
            return Err(format!("{x} and {y} at {i}"));
        }
        greatest = greatest.max(d);
    }
    Ok(greatest)
}

/// The same network with its first weight changed by `change`: for negative controls.
pub fn with_one_weight_changed(network: &Network, change: f32) -> Network {
    let layers = network.nodes().iter().map(|n| n.layer.clone()).collect();
    let mut parameters = network.nodes().iter().filter_map(|n| n.parameters.clone());
    let mut change = Some(change);
    Network::new("input", network.input(), layers, |_, _, _| {
        let mut parameters = parameters.next().unwrap();
        parameters.weight[0] += change.take().unwrap_or(0.0);
        Ok(parameters)
    })
    .unwrap()
}

/// Holds the GPU's layer to the reference.
pub fn check_layer(operation: Operation, input: Shape, batch: usize, seed: u64, tolerance: f32) {
    let network = one_layer(operation, input, seed);
    let values = noise(batch * input.len(), seed + 2);
    let gpu = on_gpu(&network, batch, &values);
    let expected = on_reference(&network, &values);
    let found = difference(&gpu, &expected).unwrap();
    assert!(
        found <= tolerance,
        "{operation:?} {input} x {batch}: differs by {found}, allowed {tolerance}"
    );
}

/// The largest difference that rounding explains in a sum of `terms` values near 1.
pub fn rounding(terms: usize) -> f32 {
    2e-6 * (terms as f32).sqrt().max(1.0)
}
