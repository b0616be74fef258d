//! The cascade on burn's wgpu backend: `whereabot-peer-burn PICTURES ANSWERS HEIGHT WIDTH THREADS MODEL`, MODEL being a
//! whereabot model file. See `../README.md`.

use std::collections::HashMap;
use std::error::Error;

use burn::tensor::activation::{relu, sigmoid, softmax};
use burn::tensor::module::{conv2d, interpolate, max_pool2d};
use burn::tensor::ops::{ConvOptions, InterpolateMode, InterpolateOptions, MaxPoolOptions};
use burn::tensor::{Device, DeviceKind, Tensor, TensorData};
use half::f16;
use safetensors::{Dtype, SafeTensors};
use serde::Deserialize;

use serve::{argument, serve};

#[path = "../../serve.rs"]
mod serve;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

#[derive(Deserialize)]
struct Description {
    mask_network: Network,
    overlay: Overlay,
    joint_network: Network,
}

#[derive(Deserialize)]
#[serde(tag = "rule", rename_all = "snake_case")]
enum Overlay {
    Multiply,
    Threshold { threshold: f32 },
    Ramp { low: f32, high: f32 },
}

#[derive(Deserialize)]
struct Network {
    layers: Vec<Layer>,
}

#[derive(Deserialize)]
struct Layer {
    name: String,
    inputs: Vec<String>,
    #[serde(default)]
    activation: Activation,
    #[serde(flatten)]
    operation: Operation,
    /// Weight and bias: of `conv2d` as burn has them, of `dense` [inputs, outputs, 1, 1] and [outputs].
    #[serde(skip)]
    parameters: Option<(Tensor<4>, Tensor<1>)>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "snake_case")]
enum Activation {
    #[default]
    None,
    Relu,
    Sigmoid,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(tag = "op")]
enum Operation {
    #[serde(rename = "conv2d")]
    Conv2d { kernel: usize, dilation: usize },
    #[serde(rename = "max_pool2d")]
    MaxPool2d { size: usize },
    #[serde(rename = "dense")]
    Dense,
    #[serde(rename = "sigmoid")]
    Sigmoid,
    #[serde(rename = "upsample2d")]
    Upsample2d { scale: f32 },
    #[serde(rename = "concat")]
    Concat,
    #[serde(rename = "soft_argmax2d")]
    SoftArgmax2d { origin: [f32; 2], step: [f32; 2] },
    #[serde(rename = "back_project")]
    BackProject,
}

impl Network {
    /// Takes the layers' parameters from the file.
    fn load(&mut self, prefix: &str, tensors: &SafeTensors, device: &Device) -> Result<()> {
        for layer in &mut self.layers {
            let dense = matches!(layer.operation, Operation::Dense);
            if !dense && !matches!(layer.operation, Operation::Conv2d { .. }) {
                continue;
            }
            let read = |kind: &str| -> Result<(Vec<f32>, Vec<usize>)> {
                let tensor = tensors.tensor(&format!("{prefix}.{}.{kind}", layer.name))?;
                let bytes = tensor.data();
                let values = match tensor.dtype() {
                    Dtype::F16 => bytes
                        .chunks_exact(2)
                        .map(|two| f16::from_le_bytes([two[0], two[1]]).to_f32())
                        .collect(),
                    Dtype::F32 => bytes
                        .chunks_exact(4)
                        .map(|four| f32::from_le_bytes([four[0], four[1], four[2], four[3]]))
                        .collect(),
                    other => return Err(format!("expected f16 or f32, found {other:?}").into()),
                };
                Ok((values, tensor.shape().to_vec()))
            };
            let (weight, shape) = read("weight")?;
            let weight = if dense {
                Tensor::<2>::from_data(TensorData::new(weight, shape), device)
                    .transpose()
                    .unsqueeze_dims(&[2, 3])
            } else {
                Tensor::from_data(TensorData::new(weight, shape), device)
            };
            let (bias, shape) = read("bias")?;
            let bias = Tensor::from_data(TensorData::new(bias, shape), device);
            layer.parameters = Some((weight, bias));
        }
        Ok(())
    }

    /// The last layer's output. Values without extent are [1, features, 1, 1].
    fn run(&self, input: &str, value: Tensor<4>) -> Result<Tensor<4>> {
        let mut values = HashMap::from([(input, value.clone())]);
        let mut last = value;
        for layer in &self.layers {
            let inputs: Vec<_> = layer
                .inputs
                .iter()
                .map(|name| values[name.as_str()].clone())
                .collect();
            let value = layer.run(inputs)?;
            last = match layer.activation {
                Activation::None => value,
                Activation::Relu => relu(value),
                Activation::Sigmoid => sigmoid(value),
            };
            values.insert(&layer.name, last.clone());
        }
        Ok(last)
    }
}

impl Layer {
    fn run(&self, mut inputs: Vec<Tensor<4>>) -> Result<Tensor<4>> {
        if let Operation::Concat = self.operation {
            return Ok(Tensor::cat(inputs, 1));
        }
        let input = inputs.remove(0);
        let [_, channels, height, width] = input.dims();
        let parameters = || self.parameters.clone().ok_or("no parameters");
        Ok(match self.operation {
            Operation::Conv2d { kernel, dilation } => {
                let (weight, bias) = parameters()?;
                let padding = dilation * (kernel - 1) / 2;
                conv2d(
                    input,
                    weight,
                    Some(bias),
                    ConvOptions::new([1, 1], [padding; 2], [dilation; 2], 1),
                )
            }
            Operation::MaxPool2d { size } => max_pool2d(input, MaxPoolOptions::new([size; 2])),
            Operation::Dense => {
                let (weight, bias) = parameters()?;
                let [rows, columns, ..] = weight.dims();
                let product = input
                    .reshape([1, rows])
                    .matmul(weight.reshape([rows, columns]));
                (product + bias.unsqueeze()).reshape([1, columns, 1, 1])
            }
            Operation::Sigmoid => sigmoid(input),
            Operation::Upsample2d { scale } => interpolate(
                input,
                InterpolateOptions::new(InterpolateMode::Bilinear)
                    .with_align_corners(false)
                    .with_scale_factor([scale; 2]),
            ),
            Operation::SoftArgmax2d { origin, step } => {
                let cells = height * width;
                let device = input.device();
                let share = softmax(input.reshape([channels, 1, cells]), 2);
                let place = |axis: usize, at: fn(usize, usize) -> usize| {
                    (0..cells).map(move |cell| origin[axis] + step[axis] * at(cell, width) as f32)
                };
                let places: Vec<f32> = place(0, |cell, width| cell % width)
                    .chain(place(1, |cell, width| cell / width))
                    .chain(std::iter::repeat_n(0.0, cells))
                    .collect();
                let places =
                    Tensor::<3>::from_data(TensorData::new(places, [1, 3, cells]), &device);
                let votes = inputs.remove(0).reshape([channels, 3, cells]);
                ((votes + places) * share)
                    .sum_dim(2)
                    .reshape([1, 3 * channels, 1, 1])
            }
            Operation::BackProject => {
                let places: Tensor<2> = input.reshape([channels / 3, 3]);
                let z = places.clone().narrow(1, 2, 1).exp();
                Tensor::cat(vec![places.narrow(1, 0, 2) * z.clone(), z], 1)
                    .reshape([1, channels, 1, 1])
            }
            other => return Err(format!("{other:?} is not written for burn").into()),
        })
    }
}

fn main() -> Result<()> {
    let [height, width] = [
        argument(3, "HEIGHT")?.parse()?,
        argument(4, "WIDTH")?.parse()?,
    ];
    let bytes = std::fs::read(argument(6, "MODEL")?)?;
    let (_, header) = SafeTensors::read_metadata(&bytes)?;
    let json = header
        .metadata()
        .as_ref()
        .and_then(|data| data.get("whereabot"));
    let mut model: Description = serde_json::from_str(json.ok_or("no description")?)?;
    let tensors = SafeTensors::deserialize(&bytes)?;
    let device = Device::wgpu(DeviceKind::DefaultDevice);
    model.mask_network.load("mask", &tensors, &device)?;
    model.joint_network.load("joint", &tensors, &device)?;
    serve(
        &argument(1, "PICTURES")?,
        &argument(2, "ANSWERS")?,
        [height, width],
        "wgpu's choice",
        |picture| {
            let picture = TensorData::new(picture.to_vec(), [1, 3, height, width]);
            let picture = Tensor::<4>::from_data(picture, &device);
            let mask = model.mask_network.run("image", picture.clone())?;
            // Read before the overlay is asked for: fused with it, burn 0.22 takes the sigmoid in place, of its own
            // results too.
            let found = mask.clone().into_data();
            let seen = match model.overlay {
                Overlay::Multiply => mask,
                Overlay::Threshold { threshold } => mask.greater_equal_elem(threshold).float(),
                Overlay::Ramp { low, high } => {
                    mask.sub_scalar(low).div_scalar(high - low).clamp(0.0, 1.0)
                }
            };
            let joints = model.joint_network.run("overlay", picture * seen)?;
            Ok((
                found.as_slice::<f32>()?.to_vec(),
                joints.into_data().as_slice::<f32>()?.to_vec(),
            ))
        },
    )
}
