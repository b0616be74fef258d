use serde::{Deserialize, Serialize};

use super::Shape;

/// What a layer applies to each value after its sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// The value itself.
    #[default]
    None,
    /// `max(x, 0)`.
    Relu,
    /// `1 / (1 + exp(-x))`.
    Sigmoid,
}

/// What a layer computes. Weights are laid out as PyTorch has them.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Operation {
    /// Cross-correlation with stride 1 and zero padding 'same'; weight `[out, in, kernel, kernel]`,
    /// bias `[out]`.
    Conv2d {
        /// Number of filters.
        out_channels: usize,
        /// Side of the square kernel, odd.
        kernel: usize,
        /// Distance between the kernel's taps, in pixels.
        dilation: usize,
        /// Applied to each output.
        activation: Activation,
    },
    /// Maximum over windows of `size` x `size`, side by side; what is left over at the right and
    /// bottom is dropped.
    MaxPool2d {
        /// Side of the window, and its stride.
        size: usize,
    },
    /// A fully connected layer over the input flattened in `[channel, row, column]` order;
    /// weight `[out, in]`, bias `[out]`. Its output has shape `[out, 1, 1]`.
    Dense {
        /// Number of outputs.
        out_features: usize,
        /// Applied to each output.
        activation: Activation,
    },
    /// `1 / (1 + exp(-x))` of each value.
    Sigmoid,
    /// Bilinear enlargement, pixel centres aligned as areas (PyTorch's `align_corners=False`).
    Upsample2d {
        /// Factor of height and width.
        scale: usize,
    },
    /// The channels of two or more inputs of one height and width, one after the other.
    Concat,
    /// Where the cells of heat maps vote for, on average (Sun et al. 2018, "Integral Human Pose
    /// Regression"). Inputs: logits `[joints, height, width]` and votes
    /// `[3 * joints, height, width]`; output `[3 * joints, 1, 1]`. With the softmax of a joint's
    /// logits over its cells as weights, its three values are the means of
    /// `origin + step * (column, row)` plus its first two votes, and of its third vote.
    SoftArgmax2d {
        /// Place of cell (0, 0), as x, y.
        origin: [f32; 2],
        /// Distance from column to column and from row to row, positive.
        step: [f32; 2],
    },
    /// From `(x / z, y / z, ln z)` to the point `(x, y, z)`, joint by joint, over
    /// `[3 * joints, 1, 1]`.
    BackProject,
}

impl Operation {
    /// The name that this operation has in a model file, in `shaders/` and in `tests/`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Conv2d { .. } => "conv2d",
            Self::MaxPool2d { .. } => "max_pool2d",
            Self::Dense { .. } => "dense",
            Self::Sigmoid => "sigmoid",
            Self::Upsample2d { .. } => "upsample2d",
            Self::Concat => "concat",
            Self::SoftArgmax2d { .. } => "soft_argmax2d",
            Self::BackProject => "back_project",
        }
    }

    /// The output's shape for inputs of these shapes, or what is wrong with the operation.
    pub(super) fn output_shape(&self, inputs: &[Shape]) -> Result<Shape, String> {
        let (enough, count) = match self {
            Self::Concat => (inputs.len() >= 2, "two or more"),
            Self::SoftArgmax2d { .. } => (inputs.len() == 2, "two"),
            _ => (inputs.len() == 1, "one"),
        };
        let (&input, others) = inputs.split_first().filter(|_| enough).ok_or_else(|| {
            format!(
                "inputs: expected {count} for {}, found {}",
                self.name(),
                inputs.len()
            )
        })?;
        let positive = |what: &str, value: usize| {
            if value == 0 {
                Err(format!("{what}: expected at least 1, found 0"))
            } else {
                Ok(())
            }
        };
        match *self {
            Self::Conv2d {
                out_channels,
                kernel,
                dilation,
                ..
            } => {
                positive("out_channels", out_channels)?;
                positive("dilation", dilation)?;
                if kernel % 2 == 0 {
                    return Err(format!("kernel: expected an odd side, found {kernel}"));
                }
                // Coordinates are 32-bit in the kernels.
                if (kernel - 1)
                    .checked_mul(dilation)
                    .is_none_or(|reach| reach > 1 << 20)
                {
                    return Err(format!(
                        "kernel and dilation: expected a reach of at most {} pixels, found {kernel} with dilation {dilation}",
                        1 << 20
                    ));
                }
                Ok(Shape::new(out_channels, input.height, input.width))
            }
            Self::MaxPool2d { size } => {
                positive("size", size)?;
                if size > input.height || size > input.width {
                    return Err(format!(
                        "size: expected at most the input's height and width {} x {}, found {size}",
                        input.height, input.width
                    ));
                }
                Ok(Shape::new(
                    input.channels,
                    input.height / size,
                    input.width / size,
                ))
            }
            Self::Dense { out_features, .. } => {
                positive("out_features", out_features)?;
                Ok(Shape::new(out_features, 1, 1))
            }
            Self::Sigmoid => Ok(input),
            Self::Upsample2d { scale } => {
                positive("scale", scale)?;
                let enlarged = |side: usize| {
                    side.checked_mul(scale)
                        .ok_or_else(|| format!("scale: expected a smaller one, found {scale}"))
                };
                Ok(Shape::new(
                    input.channels,
                    enlarged(input.height)?,
                    enlarged(input.width)?,
                ))
            }
            Self::Concat => {
                let mut channels = input.channels;
                for other in others {
                    if (other.height, other.width) != (input.height, input.width) {
                        return Err(format!(
                            "inputs: expected one height and width, found {input} and {other}"
                        ));
                    }
                    channels += other.channels;
                }
                Ok(Shape::new(channels, input.height, input.width))
            }
            Self::SoftArgmax2d { origin, step } => {
                if origin.iter().any(|v| !v.is_finite()) {
                    return Err(format!("origin: expected finite numbers, found {origin:?}"));
                }
                if step.iter().any(|v| !(v.is_finite() && *v > 0.0)) {
                    return Err(format!(
                        "step: expected finite numbers above 0, found {step:?}"
                    ));
                }
                let wanted = Shape {
                    channels: input.channels.saturating_mul(3),
                    ..input
                };
                if let Some(votes) = others.iter().find(|votes| **votes != wanted) {
                    return Err(format!(
                        "inputs: expected votes of shape {wanted} for heat maps of shape {input}, found {votes}"
                    ));
                }
                Ok(Shape::new(wanted.channels, 1, 1))
            }
            Self::BackProject => {
                if !input.channels.is_multiple_of(3) || (input.height, input.width) != (1, 1) {
                    return Err(format!(
                        "inputs: expected a shape [3 * joints, 1, 1], found {input}"
                    ));
                }
                Ok(input)
            }
        }
    }

    /// The dimensions of the weight and of the bias for an input of shape `input`;
    /// `None` for an operation without parameters.
    pub fn parameter_dims(&self, input: Shape) -> Option<(Vec<usize>, Vec<usize>)> {
        match *self {
            Self::Conv2d {
                out_channels,
                kernel,
                ..
            } => Some((
                vec![out_channels, input.channels, kernel, kernel],
                vec![out_channels],
            )),
            Self::Dense { out_features, .. } => {
                Some((vec![out_features, input.len()], vec![out_features]))
            }
            Self::MaxPool2d { .. }
            | Self::Sigmoid
            | Self::Upsample2d { .. }
            | Self::Concat
            | Self::SoftArgmax2d { .. }
            | Self::BackProject => None,
        }
    }

    /// Multiply-accumulates for one image with an input of shape `input`.
    pub fn macs(&self, input: Shape) -> u64 {
        let factors = match *self {
            Self::Conv2d {
                out_channels,
                kernel,
                ..
            } => [input.len(), out_channels, kernel, kernel],
            Self::Dense { out_features, .. } => [input.len(), out_features, 1, 1],
            Self::MaxPool2d { .. }
            | Self::Sigmoid
            | Self::Upsample2d { .. }
            | Self::Concat
            | Self::SoftArgmax2d { .. }
            | Self::BackProject => [0; 4],
        };
        // In a browser more than a usize.
        factors.iter().map(|&factor| factor as u64).product()
    }
}

/// A layer: a name, the names of what it reads, and its operation.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(from = "LayerRecord")]
pub struct Layer {
    /// Unique within the network; part of its tensors' names.
    pub name: String,
    /// Names of earlier layers, or of the network's input.
    pub inputs: Vec<String>,
    /// What it computes.
    pub operation: Operation,
}

/// A layer as a model file has it. A field that an operation does not know is an error: to ignore
/// it would be to compute something else than the file means.
#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
enum LayerRecord {
    #[serde(rename = "conv2d")]
    Conv2d {
        name: String,
        inputs: Vec<String>,
        out_channels: usize,
        kernel: usize,
        dilation: usize,
        activation: Activation,
    },
    #[serde(rename = "max_pool2d")]
    MaxPool2d {
        name: String,
        inputs: Vec<String>,
        size: usize,
    },
    Dense {
        name: String,
        inputs: Vec<String>,
        out_features: usize,
        activation: Activation,
    },
    Sigmoid {
        name: String,
        inputs: Vec<String>,
    },
    #[serde(rename = "upsample2d")]
    Upsample2d {
        name: String,
        inputs: Vec<String>,
        scale: usize,
    },
    Concat {
        name: String,
        inputs: Vec<String>,
    },
    #[serde(rename = "soft_argmax2d")]
    SoftArgmax2d {
        name: String,
        inputs: Vec<String>,
        origin: [f32; 2],
        step: [f32; 2],
    },
    BackProject {
        name: String,
        inputs: Vec<String>,
    },
}

impl From<LayerRecord> for Layer {
    fn from(record: LayerRecord) -> Self {
        let (name, inputs, operation) = match record {
            LayerRecord::Conv2d {
                name,
                inputs,
                out_channels,
                kernel,
                dilation,
                activation,
            } => (
                name,
                inputs,
                Operation::Conv2d {
                    out_channels,
                    kernel,
                    dilation,
                    activation,
                },
            ),
            LayerRecord::MaxPool2d { name, inputs, size } => {
                (name, inputs, Operation::MaxPool2d { size })
            }
            LayerRecord::Dense {
                name,
                inputs,
                out_features,
                activation,
            } => (
                name,
                inputs,
                Operation::Dense {
                    out_features,
                    activation,
                },
            ),
            LayerRecord::Sigmoid { name, inputs } => (name, inputs, Operation::Sigmoid),
            LayerRecord::Upsample2d {
                name,
                inputs,
                scale,
            } => (name, inputs, Operation::Upsample2d { scale }),
            LayerRecord::Concat { name, inputs } => (name, inputs, Operation::Concat),
            LayerRecord::SoftArgmax2d {
                name,
                inputs,
                origin,
                step,
            } => (name, inputs, Operation::SoftArgmax2d { origin, step }),
            LayerRecord::BackProject { name, inputs } => (name, inputs, Operation::BackProject),
        };
        Self {
            name,
            inputs,
            operation,
        }
    }
}
