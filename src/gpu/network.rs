use super::back_project::back_project;
use super::choice::{Conv2dKernel, conv2d};
use super::concat::concat;
use super::conv2d::{Conv2d, margin, poolable};
use super::dense::dense;
use super::max_pool2d::max_pool2d;
use super::sigmoid::sigmoid;
use super::soft_argmax2d::soft_argmax2d;
use super::step::Step;
use super::tensor::Tensor;
use super::upsample2d::upsample2d;
use super::{Device, GpuError, Layout};
use crate::network::{Network, NetworkError, Node, Operation, Parameters, Shape, Source};

/// A network planned for a batch: every layer's output allocated, every kernel compiled and bound.
#[derive(Debug)]
pub struct NetworkPlan {
    steps: Vec<Step>,
    /// Of every layer but the last; `None` for a convolution that is made together with the max-pool behind it.
    hidden: Vec<Option<Tensor>>,
    output: Tensor,
}

impl NetworkPlan {
    /// Allocates an input for `network` in `layout`, with the margin that its layers want. `what` names it in errors.
    ///
    /// # Errors
    /// As [`Tensor::new`].
    pub fn input(
        device: &Device,
        layout: Layout,
        what: &str,
        network: &Network,
        batch: usize,
    ) -> Result<Tensor, GpuError> {
        let margin = margin_of(network, &[Source::Input]);
        Tensor::in_layout(device, layout, what, network.input(), batch, margin)
    }

    /// Plans `network` to read `input`, whose shape must be the network's, and whose margin must be
    /// that of [`NetworkPlan::input`] or wider. All tensors get the layout of `input`. `name` goes
    /// before the layers' names in errors and labels. On a [tuned](Device::tuned) device, what `input`
    /// held before is lost.
    ///
    /// # Errors
    /// A layer that exceeds the adapter's limits, or a driver's refusal.
    pub fn new(
        device: &Device,
        name: &str,
        network: &Network,
        input: &Tensor,
    ) -> Result<Self, GpuError> {
        Self::with_kernel(device, name, network, input, None)
    }

    /// As [`NetworkPlan::new`], with all convolutions by one `kernel`, if it is given.
    ///
    /// # Errors
    /// Those, and [`GpuError::Kernel`] where that kernel does not serve a layer.
    pub fn with_kernel(
        device: &Device,
        name: &str,
        network: &Network,
        input: &Tensor,
        kernel: Option<Conv2dKernel>,
    ) -> Result<Self, GpuError> {
        Self::planned(device, name, network, input, kernel, &mut || {})
    }

    /// As [`NetworkPlan::with_kernel`], telling `planned` of each layer.
    pub(super) fn planned(
        device: &Device,
        name: &str,
        network: &Network,
        input: &Tensor,
        kernel: Option<Conv2dKernel>,
        planned: &mut dyn FnMut(),
    ) -> Result<Self, GpuError> {
        let size = |what, expected, found| {
            Err(GpuError::Size {
                what,
                expected,
                found,
            })
        };
        if input.shape != network.input() {
            return size("network input", network.input().len(), input.shape.len());
        }
        let wanted = margin_of(network, &[Source::Input]);
        if let Some(found) = input.margin().filter(|&found| found < wanted) {
            return size("margin of the network input", wanted, found);
        }
        device.scoped(|| {
            let places = places(device, name, network, input)?;
            let mut steps = Vec::new();
            let mut outputs: Vec<Option<Tensor>> = Vec::with_capacity(network.nodes().len());
            let mut layers = network.nodes().iter().zip(places).enumerate();
            while let Some((index, (node, place))) = layers.next() {
                let label = format!("{name}.{}", node.layer.name);
                let placed = place.is_some();
                let allocate = |what: &str, shape, readers: &[Source]| {
                    let margin = margin_of(network, readers);
                    Tensor::in_layout(device, input.layout(), what, shape, input.batch, margin)
                };
                let sources: Vec<&Tensor> = node
                    .sources
                    .iter()
                    .map(|source| match source {
                        Source::Layer(index) => outputs
                            .get(*index)
                            .and_then(Option::as_ref)
                            .unwrap_or(input),
                        Source::Input => input,
                    })
                    .collect();
                let source = sources.first().copied().unwrap_or(input);
                let pool = pool_behind(device, network, index, source, kernel);
                // Layers that are made together have the last one's output.
                let (label, last, shape, place) = match pool.and_then(|_| layers.next()) {
                    Some((last, (behind, place))) => {
                        let label = format!("{label}+{}", behind.layer.name);
                        (label, last, behind.output, place)
                    }
                    None => (label, index, node.output, place),
                };
                let output = match place {
                    Some(place) => place,
                    None => allocate(&label, shape, &[Source::Layer(last)])?,
                };
                match node.layer.operation {
                    Operation::Conv2d {
                        kernel: side,
                        dilation,
                        activation,
                        ..
                    } => steps.push(conv2d(
                        device,
                        &Conv2d {
                            label: &label,
                            input: source,
                            output: &output,
                            parameters: parameters(node)?,
                            kernel: side,
                            dilation,
                            activation,
                            pool,
                        },
                        kernel,
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
                    // Its inputs are written to their places by those who make them.
                    Operation::Concat if placed => {}
                    Operation::Concat => {
                        let mut all = source.clone();
                        for (number, next) in sources.iter().enumerate().skip(1) {
                            let joined = if number + 1 == sources.len() {
                                output.clone()
                            } else {
                                let channels = all.shape.channels + next.shape.channels;
                                let shape = Shape {
                                    channels,
                                    ..node.output
                                };
                                allocate(&label, shape, &[])?
                            };
                            steps.push(concat(device, &label, &all, next, &joined)?);
                            all = joined;
                        }
                    }
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
                if pool.is_some() {
                    outputs.push(None);
                    planned();
                }
                outputs.push(Some(output));
                planned();
            }
            let output = outputs.pop().flatten().ok_or(NetworkError::Empty)?;
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

    /// Every layer's output, in order; `None` for a convolution that is made together with the max-pool behind it.
    pub fn outputs(&self) -> impl Iterator<Item = Option<&Tensor>> {
        let hidden = self.hidden.iter().map(Option::as_ref);
        hidden.chain([Some(&self.output)])
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
    #[cfg(not(target_arch = "wasm32"))]
    pub fn run(&self, device: &Device) -> Result<(), GpuError> {
        pollster::block_on(self.run_async(device))
    }

    /// As [`NetworkPlan::run`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// As [`Device::wait`].
    pub async fn run_async(&self, device: &Device) -> Result<(), GpuError> {
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        self.encode(&mut encoder.begin_compute_pass(&Default::default()));
        device.queue().submit([encoder.finish()]);
        device.wait_async().await
    }
}

fn parameters(node: &Node) -> Result<&Parameters, NetworkError> {
    node.parameters.as_ref().ok_or_else(|| NetworkError::Layer {
        layer: node.layer.name.clone(),
        problem: "parameters: expected weight and bias, found none".into(),
    })
}

/// The side of the windows of the max-pool that is made with layer `index`: the next layer's, where the layer is a
/// convolution of what lies in `source`, nothing else reads it, and a kernel there, or `only` that one, pools.
fn pool_behind(
    device: &Device,
    network: &Network,
    index: usize,
    source: &Tensor,
    only: Option<Conv2dKernel>,
) -> Option<usize> {
    let (node, next) = (network.nodes().get(index)?, network.nodes().get(index + 1)?);
    let (
        Operation::Conv2d {
            kernel, dilation, ..
        },
        Operation::MaxPool2d { size },
    ) = (node.layer.operation, next.layer.operation)
    else {
        return None;
    };
    let readers = network.nodes().iter().flat_map(|node| &node.sources);
    let alone = readers.filter(|s| **s == Source::Layer(index)).count() == 1;
    let behind = next.sources.first() == Some(&Source::Layer(index));
    // An invocation makes several rows where all of their taps lie within the margin.
    let shared = source.margin() >= Some(kernel / 2 * dilation);
    let by = only.unwrap_or(Conv2dKernel::Subgroup);
    let pools = source.layout() == Layout::Texture && by.pools() && by.runs_on(device);
    (poolable(size, dilation) && alone && behind && shared && pools).then_some(size)
}

/// How far the layers that read one of `sources` reach beyond its rows and columns.
fn margin_of(network: &Network, sources: &[Source]) -> usize {
    let reads = |node: &&Node| node.sources.iter().any(|source| sources.contains(source));
    let margins = network
        .nodes()
        .iter()
        .filter(reads)
        .map(|node| match node.layer.operation {
            Operation::Conv2d {
                kernel, dilation, ..
            } => margin(node.input, kernel, dilation),
            _ => 0,
        });
    margins.max().unwrap_or(0)
}

/// The outputs that lie in memory of others, by layer: those of concatenations whose inputs can be
/// written to their places by the layers that make them, and of these layers.
fn places(
    device: &Device,
    name: &str,
    network: &Network,
    input: &Tensor,
) -> Result<Vec<Option<Tensor>>, GpuError> {
    let nodes = network.nodes();
    let mut places: Vec<Option<Tensor>> = vec![None; nodes.len()];
    for (index, node) in nodes.iter().enumerate() {
        if node.layer.operation != Operation::Concat {
            continue;
        }
        let mut readers = node.sources.clone();
        readers.push(Source::Layer(index));
        let all = Tensor::in_layout(
            device,
            input.layout(),
            &format!("{name}.{}", node.layer.name),
            node.output,
            input.batch,
            margin_of(network, &readers),
        )?;
        let mut first = 0;
        let mut parts = Vec::with_capacity(node.sources.len());
        for &source in &node.sources {
            let Source::Layer(maker) = source else { break };
            let Some(made) = nodes.get(maker) else { break };
            // Every output is in one place, whole blocks from the others; and what reads a buffer
            // cannot write to it.
            let taken = places.get(maker).is_some_and(Option::is_some)
                || parts.iter().any(|(other, _)| *other == maker)
                || made.layer.operation == Operation::Concat
                || (input.margin().is_none() && made.sources.iter().any(|s| readers.contains(s)));
            if taken || first % 4 != 0 {
                break;
            }
            let Some(part) = all.slice(device, first, made.output.channels) else {
                break;
            };
            parts.push((maker, part));
            first += made.output.channels;
        }
        if parts.len() < node.sources.len() {
            continue;
        }
        for (maker, part) in parts.into_iter().chain([(index, all)]) {
            if let Some(place) = places.get_mut(maker) {
                *place = Some(part);
            }
        }
    }
    Ok(places)
}
