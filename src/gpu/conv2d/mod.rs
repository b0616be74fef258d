//! Convolution with stride 1, dilation and zero padding 'same': one file a kernel, which packs the
//! weights for it. [`super::choice`] says which one serves a layer.

mod buffer;
mod cooperative;
mod one;
mod subgroup_one;
mod texture;
mod tiled;

pub(super) use buffer::buffer;
pub(super) use cooperative::{cooperative, workgroups as cooperative_workgroups};
pub(super) use one::one;
pub(super) use subgroup_one::subgroup_one;
pub(super) use texture::texture;
pub(super) use tiled::{Tiling, tiled};

use super::step::{Step, StepDescriptor, Tensors, Work, activation_number};
use super::tensor::{Tensor, blocks, constant_buffer, uniform_buffer};
use super::{Device, GpuError};
use crate::network::{Activation, Parameters, Shape};

/// A convolution to plan: from `input` to `output`, of the same height, width and layout, or with the max-pool
/// behind it to that one's output.
pub(super) struct Conv2d<'a> {
    pub label: &'a str,
    pub input: &'a Tensor,
    pub output: &'a Tensor,
    /// In PyTorch's order.
    pub parameters: &'a Parameters,
    pub kernel: usize,
    pub dilation: usize,
    pub activation: Activation,
    /// The side of the windows of the max-pool that is made with it: [`poolable`].
    pub pool: Option<usize>,
}

impl Conv2d<'_> {
    /// Pixels that the kernel reaches beyond its centre.
    pub fn reach(&self) -> usize {
        self.kernel / 2 * self.dilation
    }

    /// What the layer has to do, by whatever kernel.
    fn work(&self) -> Work {
        let weights = self.parameters.weight.len();
        let Shape { height, width, .. } = self.input.shape;
        Work::new(
            Tensors::from_to(self.input, self.output),
            weights + self.parameters.bias.len(),
            // In a browser more than a usize.
            (self.output.batch * height * width) as u64 * weights as u64,
        )
    }

    /// `packed` weights in f32.
    fn weights(&self, device: &Device, packed: &[f32]) -> Result<wgpu::Buffer, GpuError> {
        constant_buffer(device, &format!("{}: weight", self.label), packed)
    }

    /// The weights that `place` gives a place among `len` values of zero, by output channel, input
    /// channel, kernel row and kernel column.
    fn packed(&self, len: usize, place: impl Fn([usize; 4]) -> usize) -> Vec<f32> {
        let mut packed = vec![0.0; len];
        let (kernel, channels) = (self.kernel, self.input.shape.channels);
        for (index, weight) in self.parameters.weight.iter().enumerate() {
            let (tap, row) = (index % (kernel * kernel), index / (kernel * kernel));
            let at = place([row / channels, row % channels, tap / kernel, tap % kernel]);
            if let Some(value) = packed.get_mut(at) {
                *value = *weight;
            }
        }
        packed
    }

    /// The weights as `[row][column][in block][out block]` of 4 x 4 matrices, a column of four outputs for
    /// each input, filled up with zeros to so many blocks.
    fn packed_matrices(&self, in_blocks: usize, out_blocks: usize) -> Vec<f32> {
        let taps = self.kernel * self.kernel;
        self.packed(taps * in_blocks * out_blocks * 16, |[o, i, row, column]| {
            let tap = row * self.kernel + column;
            let matrix = (tap * in_blocks + i / 4) * out_blocks + o / 4;
            matrix * 16 + i % 4 * 4 + o % 4
        })
    }

    /// The biases, filled up with zeros to so many blocks.
    fn padded_bias(&self, blocks: usize) -> Vec<f32> {
        let mut padded = self.parameters.bias.clone();
        padded.resize(4 * blocks, 0.0);
        padded
    }
}

/// Whether `conv2d_subgroup` makes a max-pool with windows of `size` x `size` with the convolution of `dilation` in front
/// of it: a window's rows are one invocation's, its columns those of neighbours in a subgroup.
pub(super) fn poolable(size: usize, dilation: usize) -> bool {
    dilation == 1 && matches!(size, 2 | 4)
}

/// A step of a `kernel` between buffers, `source` with `shaders/conv2d_planes.wgsl` in front, which makes
/// `out_blocks` blocks of output channels, those beyond the last of zeros. `bindings` are its weights (3) and
/// what else it binds.
fn planes(
    device: &Device,
    conv: &Conv2d<'_>,
    (kernel, source): (&'static str, &str),
    sizes: &[(&str, usize)],
    bindings: &[(u32, wgpu::BindingResource<'_>)],
    out_blocks: usize,
    workgroups: usize,
) -> Result<Step, GpuError> {
    let label = conv.label;
    let bias = conv.padded_bias(out_blocks);
    let bias = constant_buffer(device, &format!("{label}: bias"), &bias)?;
    let mut bindings = bindings.to_vec();
    bindings.push((4, bias.as_entire_binding()));
    Step::trusted(
        device,
        &StepDescriptor {
            label,
            kernel,
            source,
            entry_point: "main",
            tensors: Tensors::from_to(conv.input, conv.output),
            constants: &[
                ("KERNEL", conv.kernel as f64),
                ("DILATION", conv.dilation as f64),
                ("ACTIVATION", activation_number(conv.activation).into()),
            ],
            sizes,
            bindings: &bindings,
            workgroups,
            work: conv.work(),
        },
    )
}

/// The margin that a convolution's input wants in textures. Taps farther away than the image is long
/// find zeros wherever they look: the margin need not go on to them.
pub(super) fn margin(input: Shape, kernel: usize, dilation: usize) -> usize {
    (kernel / 2 * dilation).min(input.height.max(input.width))
}

/// How many rows an invocation of the kernels for textures makes: of a max-pool's, whole windows. They are `dilation`
/// apart: of the image's rows, few lie on one lattice. A tap's weights cost as much as three rows' arithmetic;
/// beyond four rows, there is less to gain than the driver's compiler takes.
fn rows(conv: &Conv2d<'_>) -> usize {
    let window = conv.pool.unwrap_or(1);
    let on_lattice = conv.output.shape.height.div_ceil(conv.dilation);
    let cost = |rows: &usize| on_lattice.div_ceil(rows / window) * (3 + rows);
    let whole = (1..=4).filter(|rows| rows % window == 0);
    whole.min_by_key(cost).unwrap_or(window)
}

/// A step of a `kernel` for textures, `source` with `shaders/conv2d_lattice.wgsl` in front: its
/// invocations make `rows` rows, and workgroups make each pixel for `parts` sets of channels.
fn lattice(
    device: &Device,
    conv: &Conv2d<'_>,
    (kernel, source): (&'static str, &str),
    weights: &wgpu::TextureView,
    rows: usize,
    parts: usize,
) -> Result<Step, GpuError> {
    let Conv2d {
        label,
        input,
        output,
        ..
    } = *conv;
    let Shape { height, width, .. } = output.shape;
    let lattice = conv.dilation.min(height);
    let subgroup = device.subgroup_size().unwrap_or(0) as usize;
    let mut sizes = vec![
        ("ROWS", rows),
        ("KERNEL", conv.kernel),
        ("SUBGROUP", subgroup),
    ];
    let (columns, row_groups) = match conv.pool {
        Some(size) => {
            let windows = rows / size;
            sizes.extend([("SIZE", size), ("WINDOWS", windows)]);
            (width * size, height.div_ceil(windows))
        }
        None => (width, height.div_ceil(lattice * rows) * lattice),
    };
    let margin = |tensor: &Tensor| tensor.margin().unwrap_or(0) as u32;
    let layer = [
        output.batch as u32,
        blocks(input.shape.channels) as u32,
        blocks(output.shape.channels) as u32,
        height as u32,
        width as u32,
        margin(input),
        margin(output),
        conv.dilation as u32,
        lattice as u32,
        row_groups as u32,
        activation_number(conv.activation),
        0,
    ];
    let layer = uniform_buffer(device, &format!("{label}: layer"), &layer);
    let pairs = blocks(output.shape.channels).next_multiple_of(2);
    let bias = constant_buffer(device, &format!("{label}: bias"), &conv.padded_bias(pairs))?;
    Step::new(
        device,
        &StepDescriptor {
            label,
            kernel,
            source,
            entry_point: "main",
            tensors: Tensors::default(),
            constants: &[],
            sizes: &sizes,
            bindings: &[
                (0, input.resource()),
                (2, output.resource()),
                (3, wgpu::BindingResource::TextureView(weights)),
                (4, bias.as_entire_binding()),
                (5, layer.as_entire_binding()),
            ],
            workgroups: (row_groups * columns).div_ceil(64) * output.batch * parts,
            work: conv.work(),
        },
    )
}
