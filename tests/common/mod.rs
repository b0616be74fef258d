//! Shared by the tests of the layers: one device, random networks of one layer, comparison.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    missing_docs
)]

use std::sync::{Arc, OnceLock};

use whereabot::camera::Orientation;
use whereabot::cascade::Estimate;
use whereabot::gpu::{AdapterRequest, Conv2dKernel, Device, Layout, NetworkPlan, Precision};
use whereabot::network::{Layer, Network, Operation, Parameters, Shape};
use whereabot::reference;

/// The joints of an estimate, one number after the other.
pub fn joints(estimate: &Estimate) -> Vec<f32> {
    estimate
        .joints
        .iter()
        .flat_map(|j| j.xyz_m.map(|v| v as f32))
        .collect()
}

/// Every orientation that EXIF has.
pub const ORIENTATIONS: [Orientation; 8] = [
    Orientation::NoTransforms,
    Orientation::Rotate90,
    Orientation::Rotate180,
    Orientation::Rotate270,
    Orientation::FlipHorizontal,
    Orientation::FlipVertical,
    Orientation::Rotate90FlipH,
    Orientation::Rotate270FlipH,
];

/// How often a property is tried, at most as often as `PROPTEST_CASES` says. Failures print their case; they
/// are kept as tests by hand.
pub fn cases(count: u32) -> proptest::test_runner::Config {
    let default = proptest::test_runner::Config::default();
    proptest::test_runner::Config {
        cases: count.min(default.cases),
        failure_persistence: None,
        ..default
    }
}

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

/// A device of the same adapter whose dispatches hold `workgroups` a dimension: what a real one folds only at millions of
/// texels, it folds at hundreds.
pub fn narrow_device(workgroups: u32) -> Device {
    let instance =
        wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let adapter = pollster::block_on(instance.request_adapter(&Default::default()))
        .expect("an adapter is needed: install mesa-vulkan-drivers");
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        required_features: adapter.features() & wgpu::Features::SUBGROUP,
        required_limits: wgpu::Limits {
            max_compute_workgroups_per_dimension: workgroups,
            ..adapter.limits()
        },
        ..Default::default()
    }))
    .unwrap();
    Device::from_host(device, queue).unwrap()
}

/// A driver that `scripts/drivers` runs tests on, each with differences that `tests/engine/drivers.rs` expects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Driver {
    /// Mesa's Vulkan on the CPU.
    Lavapipe,
    /// Google's Vulkan on the CPU, which comes with Chromium.
    SwiftShader,
    /// wgpu's GL backend, on Mesa's GL on the CPU.
    Gl,
}

/// That of [`device`]; `None` for others.
pub fn driver() -> Option<Driver> {
    let device = device();
    let info = device.info();
    let mesa = info.name.starts_with("llvmpipe");
    match info.backend {
        wgpu::Backend::Vulkan if mesa => Some(Driver::Lavapipe),
        wgpu::Backend::Vulkan if info.name.starts_with("SwiftShader") => Some(Driver::SwiftShader),
        wgpu::Backend::Gl if mesa => Some(Driver::Gl),
        _ => None,
    }
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
    network(vec![layer], input, seed)
}

/// A network of these layers with random parameters; its input is named `input`.
pub fn network(layers: Vec<Layer>, input: Shape, seed: u64) -> Network {
    Network::new("input", input, layers, |_, weight, bias| {
        let len: usize = weight.iter().product();
        let scale = (3.0 * weight[0] as f32 / len as f32).sqrt();
        Ok(Parameters {
            weight: noise(len, seed).iter().map(|w| w * scale).collect(),
            bias: noise(bias[0], seed + 1),
        })
    })
    .unwrap()
}

/// The nearest values that 16-bit floats can hold.
pub fn in_halves(values: &[f32]) -> Vec<f32> {
    let halves = values.iter().map(|v| half::f16::from_f32(*v).to_f32());
    halves.collect()
}

/// What the GPU makes of a batch `[image][channel][row][column]`, in the layout that suits it.
pub fn on_gpu(network: &Network, batch: usize, values: &[f32]) -> Vec<f32> {
    let device = device();
    let layout = device.layout(Precision::F32).unwrap();
    on_gpu_by(&device, layout, None, network, batch, values)
}

/// What the GPU makes of it in `layout`, all convolutions by one `kernel`, if it is given.
pub fn on_gpu_by(
    device: &Device,
    layout: Layout,
    kernel: Option<Conv2dKernel>,
    network: &Network,
    batch: usize,
    values: &[f32],
) -> Vec<f32> {
    let input = NetworkPlan::input(device, layout, "input", network, batch).unwrap();
    input.write(device, values).unwrap();
    let plan = NetworkPlan::with_kernel(device, "test", network, &input, kernel).unwrap();
    plan.run(device).unwrap();
    plan.output().read(device).unwrap()
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
    check_network(&one_layer(operation, input, seed), batch, seed, tolerance);
}

/// Holds the GPU's network to the reference, in every layout.
pub fn check_network(network: &Network, batch: usize, seed: u64, tolerance: f32) {
    for layout in Layout::ALL {
        check_network_by(&device(), layout, None, network, batch, seed, tolerance);
    }
}

/// Holds the GPU's network to the reference where it takes more than 16 workgroups and a dimension holds 16: in every
/// layout, all convolutions by one `kernel`, if it is given.
pub fn check_folded(network: &Network, kernel: Option<Conv2dKernel>, tolerance: f32) {
    let (device, narrower) = (narrow_device(16), narrow_device(4));
    let layouts = kernel.map_or(&Layout::ALL[..], Conv2dKernel::layouts);
    for &layout in layouts {
        // Negative control: four rows of four do not hold them.
        let input = NetworkPlan::input(&narrower, layout, "input", network, 1).unwrap();
        let plan = NetworkPlan::with_kernel(&narrower, "test", network, &input, kernel);
        let refused = plan.unwrap_err().to_string();
        assert!(refused.contains("workgroups"), "{layout:?}: {refused}");

        check_network_by(&device, layout, kernel, network, 1, 3, tolerance);
    }
}

/// Holds the GPU's network to the reference, in `layout`, all convolutions by one `kernel`, if it is
/// given. In halves, the input can be held, and the output is rounded.
pub fn check_network_by(
    device: &Device,
    layout: Layout,
    kernel: Option<Conv2dKernel>,
    network: &Network,
    batch: usize,
    seed: u64,
    tolerance: f32,
) {
    let input = network.input();
    let mut values = noise(batch * input.len(), seed + 2);
    if layout == Layout::HalfBuffer {
        values = in_halves(&values);
    }
    let gpu = on_gpu_by(device, layout, kernel, network, batch, &values);
    let expected = on_reference(network, &values);
    let greatest = expected.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    let rounding = if layout == Layout::HalfBuffer {
        greatest / 512.0
    } else {
        0.0
    };
    let tolerance = tolerance + rounding;
    let found = difference(&gpu, &expected).unwrap();
    let last = &network.nodes().last().unwrap().layer;
    assert!(
        found <= tolerance,
        "{last:?} on {input} x {batch} in {layout:?} by {kernel:?}: differs by {found}, allowed {tolerance}"
    );
}

/// Runs one step on its own.
pub fn run_step(device: &Device, step: &whereabot::gpu::Step) {
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    step.encode(&mut encoder.begin_compute_pass(&Default::default()));
    device.queue().submit([encoder.finish()]);
    device.wait().unwrap();
}

/// The description of a model of the paper's shape with few filters, for images of `width` x `height`.
pub fn description(width: u32, height: u32, filters: usize) -> serde_json::Value {
    let conv = |name: &str, input: &str, out: usize, dilation: usize, activation: &str| {
        serde_json::json!({"name": name, "op": "conv2d", "inputs": [input], "out_channels": out,
            "kernel": 3, "dilation": dilation, "activation": activation})
    };
    let pool = |name: &str, input: &str| serde_json::json!({"name": name, "op": "max_pool2d", "inputs": [input], "size": 2});
    let focal = f64::from(width) * 182.5 / 256.0;
    serde_json::json!({
        "version": 1, "family": "paper", "robot": "ur5",
        "joints": ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"],
        "input": {"width": width, "height": height},
        "camera": {"fx": focal, "fy": focal,
            "cx": 0.5 * f64::from(width - 1), "cy": 0.5 * f64::from(height - 1)},
        "mask_network": {"layers": [
            conv("conv1", "image", filters, 1, "relu"), conv("conv2", "conv1", filters, 2, "relu"),
            conv("conv3", "conv2", filters, 4, "relu"), conv("conv4", "conv3", filters, 8, "relu"),
            conv("conv5", "conv4", 1, 1, "sigmoid")]},
        "overlay": {"rule": "multiply"},
        "joint_network": {"layers": [
            conv("conv1", "overlay", filters, 1, "relu"), pool("pool1", "conv1"),
            conv("conv2", "pool1", 2 * filters, 1, "relu"), pool("pool2", "conv2"),
            conv("conv3", "pool2", 4 * filters, 1, "relu"),
            {"name": "dense", "op": "dense", "inputs": ["conv3"], "out_features": 18, "activation": "none"}]},
        "presence": {"mask_threshold": 0.5, "sure_threshold": 0.7, "min_sure": 0.01}
    })
}

/// What turns the mask network's camera, as `zoom` says.
pub fn coarse(zoom: serde_json::Value) -> serde_json::Value {
    serde_json::json!({"zoom": zoom, "network": {"layers": [
        {"name": "conv1", "op": "conv2d", "inputs": ["image"], "out_channels": 8, "kernel": 3, "dilation": 2,
            "activation": "relu"},
        {"name": "pool1", "op": "max_pool2d", "inputs": ["conv1"], "size": 4},
        {"name": "conv2", "op": "conv2d", "inputs": ["pool1"], "out_channels": 1, "kernel": 3, "dilation": 1,
            "activation": "none"},
        {"name": "up1", "op": "upsample2d", "inputs": ["conv2"], "scale": 4},
        {"name": "mask", "op": "sigmoid", "inputs": ["up1"]}]}})
}

/// Dimensions of each tensor that the networks of `description` need.
pub fn tensor_dims(description: &serde_json::Value) -> Vec<(String, Vec<usize>)> {
    let side = |name: &str| description["input"][name].as_u64().unwrap() as usize;
    let image = Shape::new(3, side("height"), side("width"));
    let mut dims = Vec::new();
    for (network, input, described) in [
        ("coarse", "image", &description["coarse"]["network"]),
        ("mask", "image", &description["mask_network"]),
        ("joint", "overlay", &description["joint_network"]),
    ] {
        let Ok(layers) = serde_json::from_value::<Vec<Layer>>(described["layers"].clone()) else {
            continue;
        };
        Network::new(input, image, layers, |layer, weight, bias| {
            dims.push((format!("{network}.{layer}.weight"), weight.to_vec()));
            dims.push((format!("{network}.{layer}.bias"), bias.to_vec()));
            Ok(Parameters {
                weight: vec![0.0; weight.iter().product()],
                bias: vec![0.0; bias[0]],
            })
        })
        .unwrap();
    }
    dims
}

/// The bytes of a model file with random weights for `description`. The joints' biases put the robot
/// in front of the camera.
pub fn model_file(description: &serde_json::Value, seed: u64) -> Vec<u8> {
    let tensors: Vec<(String, Vec<usize>, Vec<f32>)> = tensor_dims(description)
        .into_iter()
        .enumerate()
        .map(|(index, (name, dims))| {
            let len: usize = dims.iter().product();
            let mut values = noise(len, seed + index as u64);
            if dims.len() > 1 {
                let scale = (3.0 * dims[0] as f32 / len as f32).sqrt();
                values.iter_mut().for_each(|v| *v *= scale);
            }
            if name == "joint.dense.bias" {
                values.iter_mut().skip(2).step_by(3).for_each(|z| *z = 3.0);
            }
            (name, dims, values)
        })
        .collect();
    let views = tensors.iter().map(|(name, dims, values)| {
        let view = safetensors::tensor::TensorView::new(
            safetensors::Dtype::F32,
            dims.clone(),
            bytemuck::cast_slice(values),
        );
        (name.as_str(), view.unwrap())
    });
    let metadata = [("whereabot".to_owned(), description.to_string())].into();
    safetensors::serialize(views, Some(metadata)).unwrap()
}

/// The largest difference that rounding explains in a sum of `terms` values near 1.
pub fn rounding(terms: usize) -> f32 {
    2e-6 * (terms as f32).sqrt().max(1.0)
}
