//! The layers of a network in plain Rust: what the kernels are compared to, and what runs without a
//! GPU. Written to be read; threaded over rows so that it is usable.
//!
//! Activations are `[channel, row, column]`, as PyTorch has them, for one image.

mod back_project;
mod cascade;
mod concat;
mod conv2d;
mod coverage;
mod dense;
mod kinematic_fit;
mod max_pool2d;
mod network;
mod overlay;
mod rectify;
mod sigmoid;
mod soft_argmax2d;
mod unrectify;
mod upsample2d;
mod zoom;

pub use back_project::back_project;
pub use cascade::{joint_input, joints, mask, mask_gaze};
pub use concat::concat;
pub use conv2d::conv2d;
pub use coverage::coverage;
pub use dense::dense;
pub use kinematic_fit::kinematic_fit;
pub use max_pool2d::max_pool2d;
pub use network::{run, run_all, run_each};
pub use overlay::overlay;
pub use rectify::rectify;
pub use sigmoid::sigmoid;
pub use soft_argmax2d::soft_argmax2d;
pub use unrectify::unrectify;
pub use upsample2d::upsample2d;
pub use zoom::{zoom, zoom_joints, zoom_mask, zoom_overlay};

use crate::network::{Activation, Shape};

/// One image's activations.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    shape: Shape,
    data: Vec<f32>,
}

impl Tensor {
    /// Takes `data` as `[channel, row, column]`; `None` unless it has as many values as `shape`.
    pub fn new(shape: Shape, data: Vec<f32>) -> Option<Self> {
        (shape.checked_len() == Some(data.len())).then_some(Self { shape, data })
    }

    /// All values `value`.
    pub fn full(shape: Shape, value: f32) -> Self {
        Self {
            shape,
            data: vec![value; shape.len()],
        }
    }

    /// Channels, height, width.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The values as `[channel, row, column]`.
    pub fn data(&self) -> &[f32] {
        &self.data
    }

    /// The values, to write to.
    pub fn data_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// One row of one channel.
    fn row(&self, channel: usize, y: usize) -> &[f32] {
        let start = (channel * self.shape.height + y) * self.shape.width;
        &self.data[start..start + self.shape.width]
    }
}

/// Applies `activation` to each value.
fn activate(values: &mut [f32], activation: Activation) {
    match activation {
        Activation::None => {}
        Activation::Relu => values.iter_mut().for_each(|v| *v = v.max(0.0)),
        Activation::Sigmoid => values
            .iter_mut()
            .for_each(|v| *v = 1.0 / (1.0 + (-*v).exp())),
    }
}
