//! Model files: what is refused, and what the error says.

use crate::common::{cases, coarse, description, model_file};
use proptest::prelude::*;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};
use whereabot::network::{Model, Network, Parameters, Shape};

fn small() -> Value {
    description(24, 16, 4)
}

/// The error for these bytes; a panic where they load.
fn refusal(bytes: &[u8]) -> String {
    match Model::from_bytes(bytes, "robot.safetensors") {
        Ok(_) => panic!("loaded"),
        Err(error) => error.to_string(),
    }
}

/// A good file with its tensors changed before it is written again.
fn with_tensors(change: impl Fn(&mut Vec<(String, Dtype, Vec<usize>, Vec<u8>)>)) -> Vec<u8> {
    let bytes = model_file(&small(), 1);
    let good = SafeTensors::deserialize(&bytes).unwrap();
    let mut tensors: Vec<_> = good
        .iter()
        .map(|(name, view)| {
            let dims = view.shape().to_vec();
            (name.to_owned(), view.dtype(), dims, view.data().to_vec())
        })
        .collect();
    change(&mut tensors);
    let views = tensors.iter().map(|(name, dtype, dims, data)| {
        let view = TensorView::new(*dtype, dims.clone(), data).unwrap();
        (name.as_str(), view)
    });
    let metadata = [("whereabot".to_owned(), small().to_string())].into();
    safetensors::serialize(views, Some(metadata)).unwrap()
}

/// The error for a good file whose description is changed.
fn with_description(change: impl Fn(&mut Value)) -> String {
    let mut description = small();
    let tensors = model_file(&description, 1);
    change(&mut description);
    let good = SafeTensors::deserialize(&tensors).unwrap();
    let metadata = [("whereabot".to_owned(), description.to_string())].into();
    refusal(&safetensors::serialize(good.iter(), Some(metadata)).unwrap())
}

fn assert_says(error: &str, parts: &[&str]) {
    for part in parts.iter().chain(&["robot.safetensors"]) {
        assert!(error.contains(part), "`{part}` is not in: {error}");
    }
}

#[test]
fn a_good_file_loads() {
    let model = Model::from_bytes(&with_tensors(|_| {}), "robot.safetensors").unwrap();
    assert_eq!(model.description.robot, "ur5");
    assert_eq!(model.joint_network.output().len(), 18);
}

#[test]
fn a_missing_tensor_is_named() {
    let bytes = with_tensors(|t| t.retain(|(name, ..)| name != "mask.conv3.bias"));
    assert_says(
        &refusal(&bytes),
        &["mask.conv3.bias", "expected dimensions [4]"],
    );
}

#[test]
fn an_extra_tensor_is_named() {
    let bytes =
        with_tensors(|t| t.push(("mask.conv9.bias".into(), Dtype::F32, vec![1], vec![0; 4])));
    assert_says(&refusal(&bytes), &["mask.conv9.bias", "none uses"]);
}

#[test]
fn a_tensor_of_other_dimensions_is_named() {
    let bytes = with_tensors(|tensors| {
        for (name, _, dims, _) in tensors {
            if name == "mask.conv1.weight" {
                dims.reverse();
            }
        }
    });
    assert_says(
        &refusal(&bytes),
        &["mask.conv1.weight", "[4, 3, 3, 3]", "[3, 3, 3, 4]"],
    );
}

#[test]
fn a_dtype_that_is_no_float_is_named() {
    let bytes = with_tensors(|tensors| {
        for (name, dtype, ..) in tensors {
            if name == "joint.dense.bias" {
                *dtype = Dtype::I32;
            }
        }
    });
    assert_says(&refusal(&bytes), &["joint.dense.bias", "F32 or F16", "I32"]);
}

#[test]
fn nan_and_infinity_are_named() {
    for value in [f32::NAN, f32::INFINITY] {
        let bytes = with_tensors(|tensors| {
            for (name, _, _, data) in tensors {
                if name == "mask.conv2.weight" {
                    data[40..44].copy_from_slice(&value.to_le_bytes());
                }
            }
        });
        assert_says(
            &refusal(&bytes),
            &["mask.conv2.weight", "finite", "index 10"],
        );
    }
}

#[test]
fn a_file_of_another_network_is_refused() {
    let metadata = [("format".to_owned(), "pt".to_owned())].into();
    let data = [0_u8; 16];
    let view = TensorView::new(Dtype::F32, vec![4], &data).unwrap();
    let bytes = safetensors::serialize([("fc.weight", view)], Some(metadata)).unwrap();
    assert_says(&refusal(&bytes), &["metadata key `whereabot`"]);
}

#[test]
fn a_coarse_mask_of_another_size_is_named() {
    let mut description = small();
    description["coarse"] = coarse(json!({"spread": 5, "least": 1, "most": 2}));
    let model = Model::from_bytes(&model_file(&description, 1), "robot.safetensors").unwrap();
    let names: Vec<_> = model.networks().map(|(name, _)| name).collect();
    assert_eq!(names, ["coarse", "mask", "joint"]);
    description["coarse"]["network"]["layers"][3]["scale"] = json!(2);
    assert_says(
        &refusal(&model_file(&description, 1)),
        &["coarse.network", "[1, 16, 24]", "[1, 8, 12]"],
    );
}

#[test]
fn descriptions_that_mean_something_else_are_refused() {
    type Change = fn(&mut Value);
    let changes: [(Change, &[&str]); 26] = [
        (
            |d| d["version"] = json!(2),
            &["version: expected 1, found 2"],
        ),
        // Whatever else a later version has.
        (
            |d| {
                d["version"] = json!(2);
                d["surprise"] = json!(1);
            },
            &["version: expected 1, found 2"],
        ),
        (|d| d["surprise"] = json!(1), &["surprise"]),
        (
            |d| d["mask_network"]["layers"][1]["stride"] = json!(2),
            &["stride"],
        ),
        (
            |d| d["mask_network"]["layers"][0]["op"] = json!("conv3d"),
            &["conv3d"],
        ),
        (
            |d| d["mask_network"]["layers"][1]["kernel"] = json!(4),
            &["mask.conv2", "odd", "found 4"],
        ),
        (
            |d| d["mask_network"]["layers"][1]["dilation"] = json!(0),
            &["mask.conv2", "dilation"],
        ),
        (
            |d| d["mask_network"]["layers"][1]["inputs"] = json!(["conv4"]),
            &["mask.conv2", "conv4"],
        ),
        (
            |d| d["mask_network"]["layers"][1]["inputs"] = json!([]),
            &["mask.conv2", "expected one"],
        ),
        (
            |d| d["mask_network"]["layers"][1]["name"] = json!("conv1"),
            &["conv1"],
        ),
        (|d| d["mask_network"]["layers"] = json!([]), &["layers"]),
        (
            |d| d["overlay"] = json!({"rule": "ramp", "low": 0.6, "high": 0.6}),
            &["overlay", "low below high", "low 0.6"],
        ),
        (
            |d| d["overlay"] = json!({"rule": "ramp", "low": 0.4, "high": 1.5}),
            &["overlay", "0 to 1", "high 1.5"],
        ),
        (
            |d| d["zoom"] = json!({"spread": 0, "least": 0.5, "most": 4}),
            &["zoom", "0.01", "spread 0"],
        ),
        (
            |d| d["zoom"] = json!({"spread": 5, "least": 5, "most": 4}),
            &["zoom", "least 5", "most 4"],
        ),
        (
            |d| d["coarse"] = coarse(json!({"spread": 5, "least": 1, "most": 200})),
            &["coarse.zoom", "0.01", "most 200"],
        ),
        (
            |d| d["zoom"] = json!({"spread": 5, "least": 0.5}),
            &["most"],
        ),
        (
            |d| {
                d["arm"] = arm();
                d["joints"] = json!(["elbow"]);
            },
            &["arm", "6 joints", "found 1"],
        ),
        (
            |d| d["arm"] = with(arm(), "bodies", json!([])),
            &["arm.bodies", "found none"],
        ),
        (
            |d| {
                d["arm"] = arm();
                d["arm"]["bodies"][0]["forearm"] = json!(0);
            },
            &["arm.bodies", "0.001 to 100 m", "forearm: 0.0"],
        ),
        (
            |d| {
                d["arm"] = arm();
                d["arm"]["along"][5][5] = json!(1e30);
            },
            &["arm.along", "a million"],
        ),
        (|d| d["arm"] = with(arm(), "across", json!([[1.0]])), &["6"]),
        (|d| d["input"]["width"] = json!(0), &["input", "0 x 16"]),
        (
            |d| d["input"]["width"] = json!(4_000_000_000_u32),
            &["input"],
        ),
        (|d| d["camera"]["fx"] = json!(0.0), &["camera", "fx 0"]),
        (
            |d| d["presence"]["mask_threshold"] = json!(1.5),
            &["mask_threshold", "1.5"],
        ),
    ];
    for (change, parts) in changes {
        assert_says(&with_description(change), parts);
    }
}

/// Of a UR5, whose joint network errs by a centimetre.
fn arm() -> Value {
    let whitening: Vec<[f32; 6]> = (0..6)
        .map(|i| std::array::from_fn(|j| if i == j { 100.0 } else { 0.0 }))
        .collect();
    json!({
        "bodies": [{"shoulder_offset": 0.1358, "upper_arm": 0.425, "elbow_offset": -0.1197, "forearm": 0.3922,
            "wrist_offset": 0.093, "wrist": 0.0946}],
        "across": whitening, "along": whitening,
    })
}

fn with(mut object: Value, key: &str, value: Value) -> Value {
    object[key] = value;
    object
}

#[test]
fn an_arm_is_read() {
    let description = with(small(), "arm", arm());
    let model = Model::from_bytes(&model_file(&description, 1), "model").unwrap();
    let arm = model.description.arm.unwrap();
    assert_eq!(
        (arm.bodies[0].forearm, arm.across[5][5], arm.along[0][1]),
        (0.3922, 100.0, 0.0)
    );
}

#[test]
fn layers_that_make_joints_from_heat_maps_check_their_inputs() {
    let soft_argmax = |inputs: Value, origin: Value, step: Value| {
        with_description(|d| {
            d["joint_network"]["layers"] = json!([
                {"name": "votes", "op": "concat", "inputs": ["overlay", "overlay", "overlay"]},
                {"name": "small", "op": "max_pool2d", "inputs": ["votes"], "size": 2},
                {"name": "position", "op": "soft_argmax2d", "inputs": inputs, "origin": origin, "step": step},
                {"name": "joints", "op": "back_project", "inputs": ["overlay"]},
            ]);
        })
    };
    let (inputs, origin, step) = (
        json!(["overlay", "votes"]),
        json!([-0.7, 0]),
        json!([1, 0.02]),
    );
    let cases: [(Value, Value, Value, &[&str]); 8] = [
        // A good soft-argmax: the next layer is at fault.
        (
            inputs.clone(),
            origin.clone(),
            step.clone(),
            &["joint.joints", "[3 * joints, 1, 1]", "found [3, 16, 24]"],
        ),
        (
            json!(["overlay"]),
            origin.clone(),
            step.clone(),
            &["joint.position", "expected two for soft_argmax2d, found 1"],
        ),
        (
            json!(["overlay", "votes", "votes"]),
            origin.clone(),
            step.clone(),
            &["joint.position", "found 3"],
        ),
        (
            json!(["overlay", "overlay"]),
            origin.clone(),
            step.clone(),
            &["joint.position", "[9, 16, 24]", "found [3, 16, 24]"],
        ),
        (
            json!(["overlay", "small"]),
            origin.clone(),
            step.clone(),
            &["joint.position", "[9, 16, 24]", "found [9, 8, 12]"],
        ),
        (
            inputs.clone(),
            json!([0, 1e39]),
            step.clone(),
            &["joint.position", "origin", "finite", "inf"],
        ),
        (
            inputs.clone(),
            origin.clone(),
            json!([0.02, 0]),
            &["joint.position", "step", "above 0", "[0.02, 0.0]"],
        ),
        (
            inputs.clone(),
            origin.clone(),
            json!([1]),
            &["invalid length 1"],
        ),
    ];
    for (inputs, origin, step, parts) in cases {
        assert_says(&soft_argmax(inputs, origin, step), parts);
    }
    let error = with_description(|d| {
        d["joint_network"]["layers"] = json!([
            {"name": "colour", "op": "max_pool2d", "inputs": ["overlay"], "size": 16},
            {"name": "joints", "op": "back_project", "inputs": ["colour", "colour"]},
        ]);
    });
    assert_says(
        &error,
        &["joint.joints", "expected one for back_project, found 2"],
    );
}

#[test]
fn huge_numbers_in_a_description_are_refused_before_anything_is_allocated() {
    let error = with_description(|d| {
        d["joint_network"]["layers"][0]["out_channels"] = json!(u64::MAX / 2);
    });
    assert_says(&error, &["joint.conv1"]);
    let error = with_description(|d| {
        d["mask_network"]["layers"][0]["dilation"] = json!(u64::MAX / 2);
    });
    assert_says(&error, &["mask.conv1", "reach"]);
    // A file of a few bytes that asks for gigabytes: enlarged by as much as it is made smaller again.
    let error = with_description(|d| {
        let layers = d["mask_network"]["layers"].as_array_mut().unwrap();
        let first = layers[0]["inputs"].clone();
        layers[0]["inputs"] = json!(["down"]);
        let up = json!({"name": "up", "op": "upsample2d", "inputs": first, "scale": 600});
        let down = json!({"name": "down", "op": "max_pool2d", "inputs": ["up"], "size": 600});
        layers.splice(0..0, [up, down]);
    });
    assert_says(&error, &["mask.up", "2^28 values in all layers"]);
}

#[test]
fn every_truncation_is_refused() {
    let bytes = model_file(&small(), 1);
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    for end in (0..=header).chain([bytes.len() - 1]) {
        assert_says(&refusal(&bytes[..end]), &["safetensors"]);
    }
}

#[test]
fn overlapping_data_is_refused() {
    let bytes = model_file(&small(), 1);
    let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut text: Value = serde_json::from_slice(&bytes[8..8 + header]).unwrap();
    let first = text["mask.conv1.bias"]["data_offsets"].clone();
    text["mask.conv2.bias"]["data_offsets"] = first;
    let mut text = text.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(8), b' ');
    let mut changed = (text.len() as u64).to_le_bytes().to_vec();
    changed.extend(text);
    changed.extend(&bytes[8 + header..]);
    assert_says(&refusal(&changed), &["safetensors"]);
}

proptest! {
    #![proptest_config(cases(256))]

    /// Whatever is done to a byte of the header, the answer is a model or an error.
    #[test]
    fn a_changed_header_never_panics(position in 0_usize..4000, value in any::<u8>()) {
        let mut bytes = model_file(&small(), 1);
        let position = position % bytes.len();
        bytes[position] = value;
        let _ = Model::from_bytes(&bytes, "robot.safetensors");
    }
}

#[test]
fn a_missing_file_is_named() {
    let error = Model::load("no/such/robot.safetensors").unwrap_err();
    assert_says(&error.to_string(), &["no/such/robot.safetensors"]);
}

#[test]
fn parameters_of_other_lengths_than_the_layer_s_are_refused() {
    let build = |weight: usize, bias: usize| {
        let layer =
            serde_json::from_value(json!({"name": "layer", "op": "dense", "inputs": ["input"],
            "out_features": 3, "activation": "none"}));
        Network::new(
            "input",
            Shape::new(2, 1, 2),
            vec![layer.unwrap()],
            |_, _, _| {
                Ok(Parameters {
                    weight: vec![0.0; weight],
                    bias: vec![0.0; bias],
                })
            },
        )
        .map_err(|error| error.to_string())
    };
    for (weight, bias, part) in [
        (0, 3, "`layer.weight`: expected 12 values"),
        (11, 3, "found 11 values"),
        (13, 3, "found 13 values"),
        (12, 0, "`layer.bias`: expected 3 values"),
        (12, 4, "found 4 values"),
    ] {
        let error = build(weight, bias).unwrap_err();
        assert!(error.contains(part), "`{part}` is not in: {error}");
    }
    // Negative control: what it asked for.
    build(12, 3).unwrap();
}
