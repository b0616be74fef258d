use std::fmt;

use super::conv2d::{Conv2d, buffer, subgroup_one, texture};
use super::step::Step;
use super::{Device, GpuError, Layout};

/// A kernel for convolutions, named after its file in `shaders/`. None is best everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Conv2dKernel {
    /// Between textures to one channel, weights spread by subgroups: for CPU rasterisers.
    SubgroupOne,
    /// Between textures, weights spread by subgroups: for CPU rasterisers.
    Subgroup,
    /// Between textures, without subgroups.
    Texture,
    /// Between buffers.
    Buffer,
}

impl Conv2dKernel {
    /// Every kernel, the better before the more general.
    pub const ALL: [Self; 4] = [
        Self::SubgroupOne,
        Self::Subgroup,
        Self::Texture,
        Self::Buffer,
    ];

    /// The layout that its tensors must have.
    pub fn layout(self) -> Layout {
        match self {
            Self::SubgroupOne | Self::Subgroup | Self::Texture => Layout::Texture,
            Self::Buffer => Layout::Buffer,
        }
    }

    /// Whether `device` can run it, on the layers that it serves.
    pub fn runs_on(self, device: &Device) -> bool {
        match self {
            Self::SubgroupOne | Self::Subgroup => device.subgroup_size().is_some_and(|n| n >= 8),
            Self::Texture | Self::Buffer => true,
        }
    }

    /// Whether it serves a layer.
    pub(super) fn serves(self, conv: &Conv2d<'_>) -> bool {
        let fits = match self {
            Self::SubgroupOne => {
                conv.output.shape.channels == 1
                    && conv.kernel <= 7
                    && conv.input.margin() >= Some(conv.reach())
            }
            Self::Subgroup | Self::Texture | Self::Buffer => true,
        };
        fits && self.layout() == conv.input.layout()
    }
}

impl fmt::Display for Conv2dKernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::SubgroupOne => "conv2d_subgroup_one",
            Self::Subgroup => "conv2d_subgroup",
            Self::Texture => "conv2d_texture",
            Self::Buffer => "conv2d_buffer",
        })
    }
}

/// Plans a convolution with the first kernel that can make it; `only` that one, if given.
pub(super) fn conv2d(
    device: &Device,
    conv: &Conv2d<'_>,
    only: Option<Conv2dKernel>,
) -> Result<Step, GpuError> {
    let kernel = Conv2dKernel::ALL
        .into_iter()
        .filter(|kernel| only.is_none_or(|only| only == *kernel))
        .find(|kernel| kernel.runs_on(device) && kernel.serves(conv));
    match kernel {
        Some(Conv2dKernel::SubgroupOne) => subgroup_one(device, conv),
        Some(Conv2dKernel::Subgroup) => texture(device, conv, true),
        Some(Conv2dKernel::Texture) => texture(device, conv, false),
        Some(Conv2dKernel::Buffer) => buffer(device, conv),
        None => Err(GpuError::Kernel {
            layer: conv.label.to_owned(),
            wanted: only.map_or("conv2d".into(), |only| only.to_string()),
        }),
    }
}
