use std::fmt;

use half::f16;

use super::comparison::Comparison;
use super::kinematic_fit;
use super::random::Random;
use super::stages::{self, Source};
use super::zoom;
use crate::gpu::{Conv2dKernel, Device, GpuError, Layout, NetworkPlan};
use crate::network::{Activation, Layer, Network, NetworkError, Operation, Parameters, Shape};
use crate::reference;

/// A kernel of a network's layer, or of what is between the networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kernel {
    Conv2d(Conv2dKernel),
    MaxPool2d,
    Dense,
    Sigmoid,
    Upsample2d,
    Concat,
    SoftArgmax2d,
    BackProject,
    Rectify(Source),
    Overlay,
    Zoom(zoom::Part),
    KinematicFit,
    Coverage,
    Estimate,
    Unrectify,
}

/// One, odd ones, powers of two and what is next to them.
const SIDES: [usize; 8] = [1, 2, 3, 5, 8, 13, 17, 31];
const CHANNELS: [usize; 8] = [1, 2, 3, 4, 5, 8, 11, 17];
pub(super) const BATCHES: [usize; 3] = [1, 2, 3];

/// A random input of a kernel, the same for the same number.
#[derive(Debug, Clone)]
pub(super) struct Case {
    number: usize,
    pub random: Random,
}

impl Case {
    /// What is compiled for takes turns: few cases then have all of it.
    pub fn turn<T: Copy>(&self, choices: &[T]) -> T {
        choices[self.number % choices.len()]
    }

    pub fn shape(&mut self, channels: usize) -> Shape {
        Shape::new(channels, self.random.of(&SIDES), self.random.of(&SIDES))
    }
}

impl Kernel {
    /// Every kernel.
    pub fn all() -> impl Iterator<Item = Self> {
        Conv2dKernel::ALL.into_iter().map(Self::Conv2d).chain([
            Self::MaxPool2d,
            Self::Dense,
            Self::Sigmoid,
            Self::Upsample2d,
            Self::Concat,
            Self::SoftArgmax2d,
            Self::BackProject,
            Self::Rectify(Source::Storage),
            Self::Rectify(Source::Texture),
            Self::Rectify(Source::Srgb),
            Self::Rectify(Source::Nv12),
            Self::Overlay,
            Self::Zoom(zoom::Part::Camera),
            Self::Zoom(zoom::Part::Mask),
            Self::Zoom(zoom::Part::Overlay),
            Self::Zoom(zoom::Part::Joints),
            Self::KinematicFit,
            Self::Coverage,
            Self::Estimate,
            Self::Unrectify,
        ])
    }

    /// The layouts in which it is compared.
    pub fn layouts(self) -> &'static [Layout] {
        match self {
            Self::Conv2d(kernel) => kernel.layouts(),
            // How they write is not how they read: one is enough.
            Self::Rectify(Source::Texture | Source::Srgb | Source::Nv12) => &[Layout::Buffer],
            _ => &Layout::ALL,
        }
    }

    /// What `device` lacks to run it between tensors in `layout`.
    pub fn lacks(self, device: &Device, layout: Layout) -> Option<String> {
        let kernel = match self {
            Self::Conv2d(kernel) => kernel.lacks(device),
            _ => None,
        };
        let layout = device.layout(layout.precision()).err();
        kernel.or_else(|| layout.map(|error| error.to_string()))
    }

    /// Runs it on random numbers of a random shape, the same for the same `number`.
    ///
    /// # Errors
    /// Whatever keeps the device from running it.
    pub async fn compare(
        self,
        device: &Device,
        layout: Layout,
        number: usize,
    ) -> Result<Comparison, GpuError> {
        let case = Case {
            number,
            random: Random::new(number as u64),
        };
        match self {
            Self::Rectify(source) => stages::rectify(device, layout, source, case).await,
            Self::Overlay => stages::overlay(device, layout, case).await,
            Self::Zoom(part) => zoom::compare(device, layout, part, case).await,
            Self::KinematicFit => kinematic_fit::compare(device, layout, case).await,
            Self::Coverage => stages::coverage(device, layout, case).await,
            Self::Estimate => stages::estimate(device, layout, case).await,
            Self::Unrectify => stages::unrectify(device, layout, case).await,
            _ => self.compare_layer(device, layout, case).await,
        }
    }

    async fn compare_layer(
        self,
        device: &Device,
        layout: Layout,
        mut case: Case,
    ) -> Result<Comparison, GpuError> {
        let (network, rounding) = self.network(&mut case)?;
        let batch = case.random.of(&BATCHES);
        let values = case.random.values(batch * network.input().len());
        let values = storable(values, layout);
        let only = match self {
            Self::Conv2d(kernel) => Some(kernel),
            _ => None,
        };
        let input = NetworkPlan::input(device, layout, "input", &network, batch)?;
        let plan = NetworkPlan::with_kernel(device, "verify", &network, &input, only)?;
        let run = async |values: &[f32]| {
            input.write(device, values)?;
            submit(device, |encoder| {
                plan.encode(&mut encoder.begin_compute_pass(&Default::default()));
            })?;
            plan.output().read_async(device).await
        };
        let expected: Vec<f32> = values
            .chunks_exact(network.input().len())
            .filter_map(|image| {
                let image = reference::Tensor::new(network.input(), image.to_vec())?;
                reference::run(&network, &image)
            })
            .flat_map(|output| output.data().to_vec())
            .collect();
        Ok(Comparison {
            found: run(&values).await?,
            control: run(&with_first(&values, |value| value + 2.0)).await?,
            allowed: rounding + rounding_of(&expected, layout),
            expected,
        })
    }

    /// A network of random shape and parameters that runs it, and how far rounding in 32 bits may bring its
    /// values apart.
    fn network(self, case: &mut Case) -> Result<(Network, f32), NetworkError> {
        let channels = case.random.of(&CHANNELS);
        let mut input = case.shape(channels);
        let activation = case.turn(&[Activation::None, Activation::Relu, Activation::Sigmoid]);
        let (mut before, mut behind) = (Vec::new(), Vec::new());
        let mut inputs = vec!["input"];
        let (operation, rounding) = match self {
            Self::Conv2d(kernel) => {
                let side = case.turn(&[3, 5, 1]);
                // A kernel that shares rows wants a margin as wide as it reaches.
                let most = input.height.max(input.width).div_ceil(side / 2 + 1);
                let out_channels = match kernel {
                    Conv2dKernel::SubgroupOne | Conv2dKernel::One => 1,
                    _ => case.random.of(&CHANNELS),
                };
                let dilation = match case.turn(&[None, Some(2), Some(4), None]) {
                    Some(size) if kernel.pools() => {
                        let size = input.height.min(input.width).min(size);
                        behind.push(layer("pool", &["layer"], Operation::MaxPool2d { size }));
                        1
                    }
                    _ => case.random.of(&[1, 2, 4, 7, 16]).min(most),
                };
                let operation = Operation::Conv2d {
                    out_channels,
                    kernel: side,
                    dilation,
                    activation,
                };
                let halves = match kernel {
                    // Its weights are halves too.
                    Conv2dKernel::Cooperative(_) => 2e-3,
                    _ => 0.0,
                };
                (operation, rounding_of_sum(channels * side * side) + halves)
            }
            Self::Dense => {
                let operation = Operation::Dense {
                    out_features: case.random.of(&[1, 5, 18, 35]),
                    activation,
                };
                (operation, rounding_of_sum(input.len()))
            }
            Self::MaxPool2d => {
                let size = case.turn(&[2, 3, 5]);
                let size = size.min(input.height).min(input.width);
                (Operation::MaxPool2d { size }, 0.0)
            }
            Self::Upsample2d => {
                let scale = case.turn(&[2, 3, 4]);
                (Operation::Upsample2d { scale }, 2e-6)
            }
            Self::Concat if case.turn(&[true, false]) => {
                inputs = vec!["input"; case.random.of(&[2, 3])];
                (Operation::Concat, 0.0)
            }
            Self::Concat => {
                // Layers write to their places in a concatenation where these begin with a whole texel.
                input.channels = case.random.of(&[4, 8]);
                inputs = vec!["first", "second"];
                before.extend(
                    inputs
                        .iter()
                        .map(|name| layer(name, &["input"], Operation::Sigmoid)),
                );
                (Operation::Concat, 1e-6)
            }
            Self::SoftArgmax2d => {
                before.push(layer("votes", &["input"; 3], Operation::Concat));
                inputs.push("votes");
                let operation = Operation::SoftArgmax2d {
                    origin: [case.random.value(), case.random.value()],
                    step: [0.07, 0.03],
                };
                (operation, 1e-5)
            }
            Self::BackProject => {
                input = Shape::new(3 * channels, 1, 1);
                (Operation::BackProject, 2e-6)
            }
            Self::Sigmoid => (Operation::Sigmoid, 1e-6),
            // They are between the networks, in no layer.
            Self::Rectify(_)
            | Self::Overlay
            | Self::Zoom(_)
            | Self::KinematicFit
            | Self::Coverage
            | Self::Estimate
            | Self::Unrectify => return Err(NetworkError::Empty),
        };
        let mut layers = before;
        layers.push(layer("layer", &inputs, operation));
        layers.extend(behind);
        let random = &mut case.random;
        // Most sums are positive there: what a ReLU clears shows no wrong value.
        let lift = match activation {
            Activation::Relu => 1.5,
            Activation::None | Activation::Sigmoid => 0.0,
        };
        let network = Network::new("input", input, layers, |_, weight, bias| {
            let count: usize = weight.iter().product();
            // Sums stay near 1.
            let scale = (3.0 * bias[0] as f32 / count as f32).sqrt();
            Ok(Parameters {
                weight: random.values(count).iter().map(|w| w * scale).collect(),
                bias: random.values(bias[0]).iter().map(|b| b + lift).collect(),
            })
        })?;
        Ok((network, rounding))
    }
}

/// The name of its file in `shaders/`.
impl fmt::Display for Kernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Conv2d(kernel) => return kernel.fmt(f),
            Self::MaxPool2d => "max_pool2d",
            Self::Dense => "dense",
            Self::Sigmoid => "sigmoid",
            Self::Upsample2d => "upsample2d",
            Self::Concat => "concat",
            Self::SoftArgmax2d => "soft_argmax2d",
            Self::BackProject => "back_project",
            Self::Rectify(Source::Storage) => "rectify_storage",
            Self::Rectify(Source::Texture) => "rectify_texture",
            Self::Rectify(Source::Srgb) => "rectify_srgb",
            Self::Rectify(Source::Nv12) => "rectify_nv12",
            Self::Overlay => "overlay",
            Self::Zoom(zoom::Part::Camera) => "zoom",
            Self::Zoom(zoom::Part::Mask) => "zoom_mask",
            Self::Zoom(zoom::Part::Overlay) => "zoom_overlay",
            Self::Zoom(zoom::Part::Joints) => "zoom_joints",
            Self::KinematicFit => "kinematic_fit",
            Self::Coverage => "coverage",
            Self::Estimate => "estimate",
            Self::Unrectify => "unrectify",
        })
    }
}

fn layer(name: &str, inputs: &[&str], operation: Operation) -> Layer {
    Layer {
        name: name.into(),
        inputs: inputs.iter().map(|&input| input.to_owned()).collect(),
        operation,
    }
}

/// The largest difference that rounding explains in a sum of `terms` products near 1.
fn rounding_of_sum(terms: usize) -> f32 {
    2e-6 * (terms as f32).sqrt()
}

/// What `layout` adds to that: a unit in the last place of its greatest value. WGSL leaves open which way halves
/// are rounded.
pub(super) fn rounding_of(values: &[f32], layout: Layout) -> f32 {
    let greatest = values.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    match layout {
        Layout::HalfBuffer => greatest / 1024.0,
        Layout::Buffer | Layout::Texture => 0.0,
    }
}

/// The nearest values that `layout` can hold.
pub(super) fn storable(mut values: Vec<f32>, layout: Layout) -> Vec<f32> {
    if layout == Layout::HalfBuffer {
        values
            .iter_mut()
            .for_each(|v| *v = f16::from_f32(*v).to_f32());
    }
    values
}

pub(super) fn with_first(values: &[f32], change: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut values = values.to_vec();
    if let Some(first) = values.first_mut() {
        *first = change(*first);
    }
    values
}

/// Submits what `record` records. What the driver has to say about it is an error of this call, and does not
/// condemn the device.
pub(super) fn submit(
    device: &Device,
    record: impl FnOnce(&mut wgpu::CommandEncoder),
) -> Result<(), GpuError> {
    device.scoped(|| {
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        record(&mut encoder);
        device.queue().submit([encoder.finish()]);
        Ok(())
    })
}
