use std::fmt;

use half::f16;
use image::{Rgba, RgbaImage};

use super::comparison::Comparison;
use super::random::Random;
use crate::camera::{Camera, Distortion, Intrinsics, Rectification};
use crate::gpu::{
    self, Conv2dKernel, Device, GpuError, Layout, NetworkPlan, Rectify, Tensor, Totals,
};
use crate::network::{
    Activation, Coverage, Layer, Network, NetworkError, Operation, Overlay, Parameters, Shape,
};
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
    Rectify,
    Overlay,
    Coverage,
}

/// One, odd ones, powers of two and what is next to them.
const SIDES: [usize; 8] = [1, 2, 3, 5, 8, 13, 17, 31];
const CHANNELS: [usize; 8] = [1, 2, 3, 4, 5, 8, 11, 17];
const BATCHES: [usize; 3] = [1, 2, 3];

/// A random input of a kernel, the same for the same number.
#[derive(Debug, Clone)]
struct Case {
    number: usize,
    random: Random,
}

impl Case {
    /// What is compiled for takes turns: few cases then have all of it.
    fn turn<T: Copy>(&self, choices: &[T]) -> T {
        choices[self.number % choices.len()]
    }

    fn shape(&mut self, channels: usize) -> Shape {
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
            Self::Rectify,
            Self::Overlay,
            Self::Coverage,
        ])
    }

    /// The layouts that its tensors can have.
    pub fn layouts(self) -> &'static [Layout] {
        match self {
            Self::Conv2d(kernel) => kernel.layouts(),
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
            Self::Rectify => rectify(device, layout, case).await,
            Self::Overlay => overlay(device, layout, case).await,
            Self::Coverage => coverage(device, layout, case).await,
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
        let mut before = Vec::new();
        let mut inputs = vec!["input"];
        let (operation, rounding) = match self {
            Self::Conv2d(kernel) => {
                let side = case.turn(&[3, 5, 1]);
                // A kernel that shares rows wants a margin as wide as it reaches.
                let most = input.height.max(input.width).div_ceil(side / 2 + 1);
                let out_channels = match kernel {
                    Conv2dKernel::SubgroupOne => 1,
                    _ => case.random.of(&CHANNELS),
                };
                let operation = Operation::Conv2d {
                    out_channels,
                    kernel: side,
                    dilation: case.random.of(&[1, 2, 4, 7, 16]).min(most),
                    activation,
                };
                let halves = match kernel {
                    // Its weights are halves too.
                    Conv2dKernel::Cooperative => 2e-3,
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
                let size = case.turn(&[2, 3, 1, 5]);
                let size = size.min(input.height).min(input.width);
                (Operation::MaxPool2d { size }, 0.0)
            }
            Self::Upsample2d => {
                let scale = case.turn(&[2, 3, 1, 4]);
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
            Self::Rectify | Self::Overlay | Self::Coverage => return Err(NetworkError::Empty),
        };
        let mut layers = before;
        layers.push(layer("layer", &inputs, operation));
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
            Self::Rectify => "rectify",
            Self::Overlay => "overlay",
            Self::Coverage => "coverage",
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
fn rounding_of(values: &[f32], layout: Layout) -> f32 {
    let greatest = values.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    match layout {
        Layout::HalfBuffer => greatest / 1024.0,
        Layout::Buffer | Layout::Texture => 0.0,
    }
}

/// The nearest values that `layout` can hold.
fn storable(mut values: Vec<f32>, layout: Layout) -> Vec<f32> {
    if layout == Layout::HalfBuffer {
        values
            .iter_mut()
            .for_each(|v| *v = f16::from_f32(*v).to_f32());
    }
    values
}

fn with_first(values: &[f32], change: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut values = values.to_vec();
    if let Some(first) = values.first_mut() {
        *first = change(*first);
    }
    values
}

/// Submits what `record` records. What the driver has to say about it is an error of this call, and does not
/// condemn the device.
fn submit(device: &Device, record: impl FnOnce(&mut wgpu::CommandEncoder)) -> Result<(), GpuError> {
    device.scoped(|| {
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        record(&mut encoder);
        device.queue().submit([encoder.finish()]);
        Ok(())
    })
}

async fn rectify(device: &Device, layout: Layout, mut case: Case) -> Result<Comparison, GpuError> {
    let rational = Distortion::Rational {
        k: [-0.2, 0.03, 0.0, 0.01, 0.0, 0.0],
        p: [0.002, -0.001],
    };
    let fisheye = Distortion::Equidistant {
        k: [-0.03, 0.01, 0.0, 0.0],
    };
    let distortion = case.turn(&[Distortion::None, rational, fisheye]);
    let random = &mut case.random;
    let [width, height] = [0; 2].map(|_| random.of(&[31_u32, 64, 101, 150]));
    let mut image = RgbaImage::from_fn(width, height, |x, y| {
        // Grain on waves: steep enough that a wrong position shows.
        let mut colour = |f: f32| {
            let wave = (x as f32 * f).sin() + (y as f32 * f * 0.7).cos();
            (120.0 + 50.0 * wave + 10.0 * random.value()) as u8
        };
        Rgba([colour(0.1), colour(0.05), colour(0.02), 255])
    });
    let camera = Camera {
        distortion,
        ..Camera::from_hfov(width, height, random.of(&[0.9, 1.2, 1.6]))
    };
    let [columns, rows] = [0; 2].map(|_| random.of(&[33_usize, 40, 61]));
    let canonical = Intrinsics {
        fx: 0.7 * columns as f64,
        fy: 0.7 * columns as f64,
        cx: 0.5 * (columns - 1) as f64,
        cy: 0.5 * (rows - 1) as f64,
    };
    let params = Rectification::new(&camera, &canonical, columns as u32, rows as u32);
    let expected = reference::rectify(&image, &params, rows, columns);

    let output = Tensor::in_layout(device, layout, "output", expected.shape(), 1, 0)?;
    let mut rectify = device.scoped(|| Rectify::new(device, &output))?;
    let mut run = async |image: &RgbaImage| {
        rectify.write(device, &output, image, &params)?;
        submit(device, |encoder| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            rectify.step().encode(&mut pass);
        })?;
        output.read_async(device).await
    };
    let found = run(&image).await?;
    for channel in &mut image.get_pixel_mut(width / 2, height / 2).0 {
        *channel ^= 0x80;
    }
    Ok(Comparison {
        found,
        control: run(&image).await?,
        // A quarter of a step of eight bits: a GPU's arc tangent and division place samples less exactly.
        allowed: 1e-3 + rounding_of(expected.data(), layout),
        expected: expected.data().to_vec(),
    })
}

async fn overlay(device: &Device, layout: Layout, mut case: Case) -> Result<Comparison, GpuError> {
    let shape = case.shape(3);
    let mask_shape = Shape {
        channels: 1,
        ..shape
    };
    let batch = case.random.of(&BATCHES);
    let rule = case.turn(&[Overlay::Multiply {}, Overlay::Threshold { threshold: 0.25 }]);
    let random = &mut case.random;
    let image = storable(random.values(batch * shape.len()), layout);
    // The first pixel is robot, so that it is seen.
    let mask = storable(random.values(batch * mask_shape.len()), layout);
    let mask = with_first(&mask, |_| 0.5);

    let tensor = |what, shape| Tensor::in_layout(device, layout, what, shape, batch, 0);
    let (input, second) = (tensor("image", shape)?, tensor("mask", mask_shape)?);
    let output = tensor("output", shape)?;
    let step = device.scoped(|| gpu::overlay(device, &input, &second, &output, rule))?;
    second.write(device, &mask)?;
    let run = async |image: &[f32]| {
        input.write(device, image)?;
        submit(device, |encoder| {
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
        })?;
        output.read_async(device).await
    };
    let expected: Vec<f32> = image
        .chunks_exact(shape.len())
        .zip(mask.chunks_exact(mask_shape.len()))
        .filter_map(|(image, mask)| {
            let image = reference::Tensor::new(shape, image.to_vec())?;
            let mask = reference::Tensor::new(mask_shape, mask.to_vec())?;
            Some(reference::overlay(&image, &mask, rule))
        })
        .flat_map(|output| output.data().to_vec())
        .collect();
    Ok(Comparison {
        found: run(&image).await?,
        control: run(&with_first(&image, |value| value + 2.0)).await?,
        allowed: 1e-6 + rounding_of(&expected, layout),
        expected,
    })
}

async fn coverage(device: &Device, layout: Layout, mut case: Case) -> Result<Comparison, GpuError> {
    const THRESHOLDS: (f32, f32) = (0.25, 0.75);
    let shape = case.shape(1);
    let batch = case.random.of(&BATCHES);
    let mut mask = storable(case.random.values(batch * shape.len()), layout);
    for (place, value) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY]
        .into_iter()
        .enumerate()
    {
        if let Some(pixel) = mask.get_mut(5 * place + 1) {
            *pixel = value;
        }
    }
    let mask = with_first(&mask, |_| 0.0);

    let tensor = Tensor::in_layout(device, layout, "mask", shape, batch, 0)?;
    let buffer = |usage| wgpu::BufferDescriptor {
        label: Some("coverage: totals"),
        size: (batch * size_of::<Totals>()) as u64,
        usage,
        mapped_at_creation: false,
    };
    use wgpu::BufferUsages as Usage;
    let (totals, readback, step) = device.scoped(|| {
        let usage = Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST;
        let totals = device.wgpu().create_buffer(&buffer(usage));
        let usage = Usage::MAP_READ | Usage::COPY_DST;
        let readback = device.wgpu().create_buffer(&buffer(usage));
        let step = gpu::coverage(device, &tensor, &totals, THRESHOLDS)?;
        Ok((totals, readback, step))
    })?;
    let (width, height) = (shape.width as u32, shape.height as u32);
    let run = async |mask: &[f32]| -> Result<Vec<f32>, GpuError> {
        tensor.write(device, mask)?;
        submit(device, |encoder| {
            encoder.clear_buffer(&totals, 0, None);
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            encoder.copy_buffer_to_buffer(&totals, 0, &readback, 0, totals.size());
        })?;
        let totals = device.read_async(&readback, bytemuck::pod_collect_to_vec::<u8, Totals>);
        let totals = totals.await?;
        Ok(totals
            .iter()
            .flat_map(|totals| numbers(totals.coverage(width, height)))
            .collect())
    };
    let (threshold, sure) = THRESHOLDS;
    Ok(Comparison {
        found: run(&mask).await?,
        control: run(&with_first(&mask, |_| 1.0)).await?,
        expected: mask
            .chunks_exact(shape.len())
            .filter_map(|mask| reference::Tensor::new(shape, mask.to_vec()))
            .flat_map(|mask| numbers(reference::coverage(&mask, threshold, sure)))
            .collect(),
        allowed: 0.0,
    })
}

/// Counts, and the box's sides; -1 for those of none.
pub(super) fn numbers(coverage: Coverage) -> [f32; 7] {
    let [left, top, right, bottom] = coverage
        .bbox
        .map_or([-1.0; 4], |bbox| bbox.map(|v| v as f32));
    let counts = [coverage.pixels, coverage.sure, coverage.not_finite].map(|v| v as f32);
    [counts[0], counts[1], counts[2], left, top, right, bottom]
}
