//! Shared by the tests of commands: the program, and a model whose answers are known.

use std::collections::HashMap;
use std::path::Path;

use assert_cmd::Command;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};

pub const JOINTS: [&str; 6] = [
    "shoulder_pan",
    "shoulder_lift",
    "elbow",
    "wrist_1",
    "wrist_2",
    "wrist_3",
];

/// Where the model says that the joints are, whatever the image.
pub const XYZ: [[f64; 3]; 6] = [
    [-0.25, 0.25, 2.0],
    [-0.2, 0.1, 2.0],
    [0.0, -0.2, 1.9],
    [0.1, -0.1, 1.8],
    [0.2, 0.0, 1.7],
    [0.25, 0.05, 1.6],
];

/// The program in `folder`, with nothing of the environment that it reads.
pub fn command(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_whereabot"));
    command.current_dir(folder);
    for variable in [
        "WGPU_BACKEND",
        "WGPU_ADAPTER_NAME",
        "WHEREABOT_WEIGHTS",
        "RUST_LOG",
    ] {
        command.env_remove(variable);
    }
    command
}

/// 16 x 12 pixels with a right angle of view. The mask is what is red at least by half:
/// `sigmoid(20 red - 10)`. The joints are `xyz` plus `gain` times what is behind the mask.
pub fn model(robot: &str, xyz: [[f64; 3]; 6], gain: f32, card: &Value) -> Vec<u8> {
    let description = json!({
        "version": 1,
        "family": "paper",
        "robot": robot,
        "joints": JOINTS,
        "input": {"width": 16, "height": 12},
        "camera": {"fx": 8.0, "fy": 8.0, "cx": 7.5, "cy": 5.5},
        "mask_network": {"layers": [
            {"name": "conv1", "op": "conv2d", "inputs": ["image"], "out_channels": 1, "kernel": 1,
             "dilation": 1, "activation": "sigmoid"}]},
        "overlay": {"rule": "multiply"},
        "joint_network": {"layers": [
            {"name": "pool1", "op": "max_pool2d", "inputs": ["overlay"], "size": 4},
            {"name": "dense", "op": "dense", "inputs": ["pool1"], "out_features": 18,
             "activation": "none"}]},
        "presence": {"mask_threshold": 0.5, "sure_threshold": 0.7, "min_sure": 0.01},
        "card": card,
    });
    let bytes =
        |values: &[f32]| -> Vec<u8> { values.iter().flat_map(|v| v.to_le_bytes()).collect() };
    let bias: Vec<f32> = xyz.iter().flatten().map(|&v| v as f32).collect();
    let tensors = [
        (
            "mask.conv1.weight",
            vec![1, 3, 1, 1],
            bytes(&[20.0, 0.0, 0.0]),
        ),
        ("mask.conv1.bias", vec![1], bytes(&[-10.0])),
        ("joint.dense.weight", vec![18, 36], bytes(&[gain; 18 * 36])),
        ("joint.dense.bias", vec![18], bytes(&bias)),
    ];
    let views = tensors.iter().map(|(name, shape, data)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), data).unwrap();
        (*name, view)
    });
    let metadata = HashMap::from([("whereabot".to_owned(), description.to_string())]);
    safetensors::serialize(views, Some(metadata)).unwrap()
}
