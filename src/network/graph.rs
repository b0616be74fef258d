use std::collections::HashMap;

use super::{Layer, NetworkError, Shape};

/// The trained values of a layer, in PyTorch's order.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// See [`Operation`](super::Operation) for the dimensions.
    pub weight: Vec<f32>,
    /// One value an output channel.
    pub bias: Vec<f32>,
}

/// Where a layer reads from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The network's input.
    Input,
    /// The output of the layer with this index.
    Layer(usize),
}

/// A layer in its place in a network: shapes worked out, parameters checked.
#[derive(Debug, Clone)]
pub struct Node {
    /// Name, inputs and operation, as described.
    pub layer: Layer,
    /// Where it reads from, one for each input; always earlier in the list.
    pub sources: Vec<Source>,
    /// Shape of its first input.
    pub input: Shape,
    /// Shape of its output.
    pub output: Shape,
    /// Weight and bias, for operations that have them.
    pub parameters: Option<Parameters>,
}

/// A network: layers that name their inputs, in an order in which they can run.
/// The last layer is the output.
#[derive(Debug, Clone)]
pub struct Network {
    input: Shape,
    output: Shape,
    nodes: Vec<Node>,
}

/// Kernels rely on it: some run without checks of bounds.
fn check_length(layer: &str, kind: &str, dims: &[usize], found: usize) -> Result<(), NetworkError> {
    let expected: usize = dims.iter().product();
    if found == expected {
        return Ok(());
    }
    Err(NetworkError::Tensor {
        tensor: format!("{layer}.{kind}"),
        expected: format!("{expected} values, of dimensions {dims:?}"),
        found: format!("{found} values"),
    })
}

/// Of all layers together: a gigabyte in f32, for a file of a few bytes may ask for more than a machine has. Geometry is
/// 32-bit in the kernels.
const MOST_VALUES: usize = 1 << 28;

impl Network {
    /// Works out shapes and takes each layer's parameters from `parameters`, which gets the layer's
    /// name and the dimensions of its weight and bias.
    ///
    /// # Errors
    /// A layer that names an unknown or later input, a name used twice, an operation with impossible
    /// numbers, a network without layers, parameters of other lengths than these dimensions have, or what `parameters` answers.
    pub fn new(
        input_name: &str,
        input: Shape,
        layers: Vec<Layer>,
        mut parameters: impl FnMut(&str, &[usize], &[usize]) -> Result<Parameters, NetworkError>,
    ) -> Result<Self, NetworkError> {
        let mut known: HashMap<String, (Source, Shape)> =
            HashMap::from([(input_name.to_owned(), (Source::Input, input))]);
        let mut nodes = Vec::with_capacity(layers.len());
        let (mut output, mut total) = (None, 0);
        for (index, layer) in layers.into_iter().enumerate() {
            let wrong = |problem: String| NetworkError::Layer {
                layer: layer.name.clone(),
                problem,
            };
            let mut sources = Vec::with_capacity(layer.inputs.len());
            let mut shapes = Vec::with_capacity(layer.inputs.len());
            for name in &layer.inputs {
                let &(source, shape) = known.get(name).ok_or_else(|| {
                    wrong(format!(
                        "inputs: expected the network's input `{input_name}` or an earlier layer, found `{name}`"
                    ))
                })?;
                sources.push(source);
                shapes.push(shape);
            }
            let result = layer.operation.output_shape(&shapes).map_err(wrong)?;
            // Every operation has at least one input, or has just been refused.
            let shape = shapes.first().copied().unwrap_or(input);
            let length = result.checked_len().filter(|&length| length < MOST_VALUES);
            total += length.unwrap_or(MOST_VALUES);
            if total >= MOST_VALUES {
                return Err(wrong(format!(
                    "output: expected fewer than 2^28 values in all layers together, found shape {result}"
                )));
            }
            let values = match layer.operation.parameter_dims(shape) {
                Some((weight, bias)) => {
                    let count = weight.iter().try_fold(1_usize, |n, &d| n.checked_mul(d));
                    if count.is_none_or(|n| n > i32::MAX as usize) {
                        return Err(wrong(format!(
                            "weight: expected fewer than 2^31 values, found dimensions {weight:?}"
                        )));
                    }
                    let values = parameters(&layer.name, &weight, &bias)?;
                    check_length(&layer.name, "weight", &weight, values.weight.len())?;
                    check_length(&layer.name, "bias", &bias, values.bias.len())?;
                    Some(values)
                }
                None => None,
            };
            let name = layer.name.clone();
            nodes.push(Node {
                layer,
                sources,
                input: shape,
                output: result,
                parameters: values,
            });
            output = Some(result);
            if known
                .insert(name.clone(), (Source::Layer(index), result))
                .is_some()
            {
                return Err(NetworkError::Layer {
                    layer: name,
                    problem: "name: expected a name used once, found it twice".into(),
                });
            }
        }
        let output = output.ok_or(NetworkError::Empty)?;
        Ok(Self {
            input,
            output,
            nodes,
        })
    }

    /// Shape of the input.
    pub fn input(&self) -> Shape {
        self.input
    }

    /// Shape of the last layer's output.
    pub fn output(&self) -> Shape {
        self.output
    }

    /// The layers in the order in which they run.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Multiply-accumulates for one image.
    pub fn macs(&self) -> u64 {
        self.nodes
            .iter()
            .map(|node| node.layer.operation.macs(node.input))
            .sum()
    }

    /// Number of trained values.
    pub fn parameter_count(&self) -> usize {
        self.nodes
            .iter()
            .filter_map(|node| node.parameters.as_ref())
            .map(|p| p.weight.len() + p.bias.len())
            .sum()
    }
}
