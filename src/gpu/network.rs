use super::back_project::back_project;
use super::concat::concat;
use super::conv2d::conv2d;
use super::dense::dense;
use super::max_pool2d::max_pool2d;
use super::sigmoid::sigmoid;
use super::soft_argmax2d::soft_argmax2d;
use super::step::Step;
use super::tensor::Tensor;
use super::upsample2d::upsample2d;
use super::{Device, GpuError};
use crate::network::{Network, NetworkError, Node, Operation, Parameters, Source};

/// A network planned for a batch: every layer's output allocated, every kernel compiled and bound.
#[derive(Debug)]
pub struct NetworkPlan {
    steps: Vec<Step>,
    /// Of every layer but the last.
    hidden: Vec<Tensor>,
    output: Tensor,
}

impl NetworkPlan {
    /// Plans `network` to read `input`, whose shape must be the network's. `name` goes before the
    /// layers' names in errors and labels.
    ///
    /// # Errors
    /// A layer that exceeds the adapter's limits, or a driver's refusal.
    pub fn new(
        device: &Device,
        name: &str,
        network: &Network,
        input: &Tensor,
    ) -> Result<Self, GpuError> {
        if input.shape != network.input() {
            return Err(GpuError::Size {
                what: "network input",
                expected: network.input().len(),
                found: input.shape.len(),
            });
        }
        device.scoped(|| {
            let mut steps = Vec::new();
            let mut outputs: Vec<Tensor> = Vec::with_capacity(network.nodes().len());
            for node in network.nodes() {
                let label = format!("{name}.{}", node.layer.name);
                let output = Tensor::new(device, &label, node.output, input.batch)?;
                let sources: Vec<&Tensor> = node
                    .sources
                    .iter()
                    .map(|source| match source {
                        Source::Layer(index) => outputs.get(*index).unwrap_or(input),
                        Source::Input => input,
                    })
                    .collect();
                let source = sources.first().copied().unwrap_or(input);
                match node.layer.operation {
                    Operation::Conv2d {
                        kernel,
                        dilation,
                        activation,
                        ..
                    } => steps.push(conv2d(
                        device,
                        &label,
                        source,
                        &output,
                        parameters(node)?,
                        (kernel, dilation, activation),
                    )?),
                    Operation::MaxPool2d { size } => {
                        steps.push(max_pool2d(device, &label, source, &output, size)?);
                    }
                    Operation::Dense { activation, .. } => steps.extend(dense(
                        device,
                        &label,
                        source,
                        &output,
                        parameters(node)?,
                        activation,
                    )?),
                    Operation::Sigmoid => steps.push(sigmoid(device, &label, source, &output)?),
                    Operation::Upsample2d { scale } => {
                        steps.push(upsample2d(device, &label, source, &output, scale)?);
                    }
                    Operation::Concat => steps.extend(concat(device, &label, &sources, &output)?),
                    Operation::SoftArgmax2d { origin, step } => {
                        let votes = sources.get(1).copied().unwrap_or(input);
                        steps.push(soft_argmax2d(
                            device,
                            &label,
                            (source, votes),
                            &output,
                            origin,
                            step,
                        )?);
                    }
                    Operation::BackProject => {
                        steps.push(back_project(device, &label, source, &output)?);
                    }
                }
                outputs.push(output);
            }
            let output = outputs.pop().ok_or(NetworkError::Empty)?;
            Ok(Self {
                steps,
                hidden: outputs,
                output,
            })
        })
    }

    /// The last layer's output.
    pub fn output(&self) -> &Tensor {
        &self.output
    }

    /// Every layer's output, in order.
    pub fn outputs(&self) -> impl Iterator<Item = &Tensor> {
        self.hidden.iter().chain([&self.output])
    }

    /// The dispatches of all layers, in order.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }

    /// Records all layers.
    pub fn encode(&self, pass: &mut wgpu::ComputePass<'_>) {
        for step in &self.steps {
            step.encode(pass);
        }
    }

    /// Runs the network once on what its input holds, and waits.
    ///
    /// # Errors
    /// As [`Device::wait`].
    pub fn run(&self, device: &Device) -> Result<(), GpuError> {
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        self.encode(&mut encoder.begin_compute_pass(&Default::default()));
        device.queue().submit([encoder.finish()]);
        device.wait()
    }
}

fn parameters(node: &Node) -> Result<&Parameters, NetworkError> {
    node.parameters.as_ref().ok_or_else(|| NetworkError::Layer {
        layer: node.layer.name.clone(),
        problem: "parameters: expected weight and bias, found none".into(),
    })
}
