//! The reference, and the kernels, against PyTorch's outputs (made by `trainer/`).

use std::path::PathBuf;

use crate::common::{difference, with_one_weight_changed};
use image::{Rgba, RgbaImage};
use safetensors::SafeTensors;
use whereabot::camera::{Camera, Distortion, Gaze, Intrinsics, Rectification};
use whereabot::gpu::{NetworkPlan, Precision};
use whereabot::network::{Model, Network, Shape};
use whereabot::reference;

const NAMES: [&str; 8] = [
    "tiny",
    "threshold",
    "tiny_f16",
    "context",
    "heatmap",
    "zoom",
    "coarse",
    "arm",
];

fn file(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/data/golden")
        .join(name)
}

fn model(name: &str) -> Model {
    Model::load(file(&format!("{name}.safetensors"))).unwrap()
}

/// PyTorch's value of one tensor.
fn golden(name: &str, tensor: &str) -> Vec<f32> {
    let bytes = std::fs::read(file(&format!("{name}.activations.safetensors"))).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    bytemuck::pod_collect_to_vec(tensors.tensor(tensor).unwrap().data())
}

fn input(name: &str, tensor: &str, shape: Shape) -> reference::Tensor {
    reference::Tensor::new(shape, golden(name, tensor)).unwrap()
}

/// The greatest difference of any layer from PyTorch.
fn greatest(network: &Network, name: &str, prefix: &str, source: &str) -> f32 {
    let input = input(name, &format!("{prefix}.{source}"), network.input());
    let outputs = reference::run_all(network, &input).unwrap();
    network
        .nodes()
        .iter()
        .zip(outputs)
        .map(|(node, output)| {
            let expected = golden(name, &format!("{prefix}.{}", node.layer.name));
            difference(output.data(), &expected).unwrap()
        })
        .fold(0.0, f32::max)
}

#[test]
fn every_layer_of_the_reference_agrees_with_pytorch() {
    for name in NAMES {
        for (network, prefix, source) in networks(&model(name)) {
            let difference = greatest(network, name, prefix, source);
            assert!(difference <= 1e-5, "{name}: {prefix}: {difference}");
        }
    }
}

/// Each with its tensors' prefix and its input's name.
fn networks(model: &Model) -> Vec<(&Network, &'static str, &'static str)> {
    let coarse = model.coarse_network.iter();
    let mut networks: Vec<_> = coarse.map(|network| (network, "coarse", "image")).collect();
    networks.push((&model.mask_network, "mask", "image"));
    networks.push((&model.joint_network, "joint", "overlay"));
    networks
}

#[test]
fn a_wrong_weight_is_noticed() {
    for (name, prefix, source) in [
        ("tiny", "mask", "image"),
        ("tiny", "joint", "overlay"),
        ("heatmap", "joint", "overlay"),
    ] {
        let model = model(name);
        let network = if prefix == "mask" {
            &model.mask_network
        } else {
            &model.joint_network
        };
        let other = rename_input(network, source);
        assert!(greatest(&other, name, prefix, source) > 1e-4);
    }
}

/// One weight changed, with the input's name kept.
fn rename_input(network: &Network, input: &str) -> Network {
    let mut layers: Vec<_> = network.nodes().iter().map(|n| n.layer.clone()).collect();
    for layer in &mut layers {
        for name in &mut layer.inputs {
            if name == input {
                *name = "input".into();
            }
        }
    }
    let mut values = network.nodes().iter().filter_map(|n| n.parameters.clone());
    let same = Network::new("input", network.input(), layers, |_, _, _| {
        Ok(values.next().unwrap())
    })
    .unwrap();
    with_one_weight_changed(&same, 1e-2)
}

#[test]
fn the_overlay_agrees_with_pytorch() {
    for name in NAMES {
        let model = model(name);
        let shape = model.mask_network.input();
        let (image, mask) = match model.coarse_network {
            Some(_) => ("coarse.image", "merged".to_owned()),
            None => ("mask.image", last("mask", &model.mask_network)),
        };
        let image = input(name, image, shape);
        let mask = input(name, &mask, model.mask_network.output());
        let (overlay, gaze) = reference::joint_input(&image, &mask, &model.description);
        let expected = golden(name, "joint.overlay");
        assert!(difference(overlay.data(), &expected).unwrap() <= 1e-5);
        assert!(difference(image.data(), &expected).unwrap() > 1e-2);
        let Some(gaze) = gaze else { continue };
        let joints = golden(name, "joint.joints");
        let expected = golden(name, "joints");
        assert!(difference(&reference::zoom_joints(&joints, &gaze), &expected).unwrap() <= 1e-5);
        assert!(difference(&joints, &expected).unwrap() > 1e-2);
    }
}

#[test]
fn what_a_coarse_mask_turns_agrees_with_pytorch() {
    let name = "coarse";
    let model = model(name);
    let (network, camera) = (&model.mask_network, &model.description.camera);
    let coarse = model.coarse_network.as_ref().unwrap();
    let zoom = model.description.coarse.as_ref().unwrap().zoom;
    let shape = coarse.input();
    let image = input(name, "coarse.image", shape);
    let coarse = input(name, &last("coarse", coarse), coarse.output());
    let gaze = reference::mask_gaze(&coarse, camera, zoom);
    let (source, params) = source(name, &model);
    let rectified =
        |gaze: &Gaze| reference::rectify(&source, &params, gaze, shape.height, shape.width);
    let seen = rectified(&gaze);
    let apart = |found: &reference::Tensor, tensor: &str| {
        difference(found.data(), &golden(name, tensor)).unwrap()
    };
    assert!(apart(&rectified(&Gaze::CANONICAL), "coarse.image") <= 1e-5);
    assert!(apart(&seen, "mask.image") <= 1e-5);
    assert!(apart(&image, "mask.image") > 1e-2);
    let closer = reference::run(network, &seen).unwrap();
    assert!(apart(&closer, &last("mask", network)) <= 1e-5);
    // Negative controls: neither alone is the mask.
    for mask in [&coarse, &closer] {
        assert!(apart(mask, "merged") > 1e-2);
    }
    let merged = reference::zoom_mask(&closer, &coarse, camera, &gaze);
    assert!(apart(&merged, "merged") <= 1e-5);
    let found = reference::mask(&model, &image, rectified).unwrap();
    assert!(apart(&found, "merged") <= 1e-5);
}

/// The picture that the cascade's input was made from, of twice the networks' size.
fn source(name: &str, model: &Model) -> (RgbaImage, Rectification) {
    let input = model.description.input;
    let (width, height) = (2 * input.width, 2 * input.height);
    let values = golden(name, "source");
    let plane = (width * height) as usize;
    let image = RgbaImage::from_fn(width, height, |x, y| {
        let at = (y * width + x) as usize;
        let [r, g, b] = [0, 1, 2].map(|c| (255.0 * values[c * plane + at]).round() as u8);
        Rgba([r, g, b, 255])
    });
    let canonical = model.description.camera;
    let camera = Camera {
        width,
        height,
        intrinsics: Intrinsics {
            fx: 2.0 * canonical.fx,
            fy: 2.0 * canonical.fy,
            cx: 2.0 * canonical.cx + 0.5,
            cy: 2.0 * canonical.cy + 0.5,
        },
        distortion: Distortion::None,
    };
    let params = Rectification::new(&camera, &canonical, input.width, input.height);
    (image, params)
}

/// The tensor of the network's last layer.
fn last(prefix: &str, network: &Network) -> String {
    format!("{prefix}.{}", network.nodes().last().unwrap().layer.name)
}

#[test]
fn the_kinematic_fit_agrees_with_pytorch() {
    let arm = model("arm").description.arm.unwrap();
    let (seen, expected) = (golden("arm", "joint.dense"), golden("arm", "joints"));
    let found = reference::kinematic_fit(&seen, &arm);
    let difference_of = |joints: &[f32]| difference(joints, &expected).unwrap();
    assert!(difference_of(&found) <= 1e-5, "{}", difference_of(&found));
    // Negative controls: joints are moved, and by what they err along the line of sight.
    assert!(difference_of(&seen) > 1e-2);
    let mut other = arm.clone();
    other.along = other.across;
    assert!(difference_of(&reference::kinematic_fit(&seen, &other)) > 1e-3);
}

#[test]
fn every_layer_of_the_gpu_agrees_with_pytorch() {
    let device = crate::common::device();
    for name in NAMES {
        let model = model(name);
        for (network, prefix, source) in networks(&model) {
            let input = NetworkPlan::input(
                &device,
                device.layout(Precision::F32).unwrap(),
                "input",
                network,
                1,
            )
            .unwrap();
            input
                .write(&device, &golden(name, &format!("{prefix}.{source}")))
                .unwrap();
            let plan = NetworkPlan::new(&device, prefix, network, &input).unwrap();
            plan.run(&device).unwrap();
            for (node, output) in network.nodes().iter().zip(plan.outputs()) {
                let Some(output) = output else { continue };
                let tensor = format!("{prefix}.{}", node.layer.name);
                let found = output.read(&device).unwrap();
                let difference = difference(&found, &golden(name, &tensor)).unwrap();
                assert!(difference <= 1e-5, "{name} {tensor}: {difference}");
            }
        }
    }
}
