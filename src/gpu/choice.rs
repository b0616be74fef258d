use std::fmt;

use super::conv2d::{
    Conv2d, Tiling, buffer, cooperative, cooperative_workgroups, one, subgroup_one, texture, tiled,
};
use super::layout::is_rasteriser;
use super::step::Step;
use super::{Device, GpuError, Layout, Tier};

/// A kernel for convolutions, named after its file in `shaders/`. None is best everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Conv2dKernel {
    /// Between textures to one channel, weights spread by subgroups: for CPU rasterisers.
    SubgroupOne,
    /// Between textures, weights spread by subgroups: for CPU rasterisers.
    Subgroup,
    /// Between textures, without subgroups.
    Texture,
    /// Between buffers of halves, on a GPU's matrix units, so many pixels a workgroup.
    Cooperative(usize),
    /// Between buffers to one channel: for GPUs.
    One,
    /// Between buffers, through workgroup memory, so many pixels an invocation: for GPUs.
    Tiled(usize),
    /// Between buffers, on everything.
    Buffer,
}

impl Conv2dKernel {
    /// Every kernel, the better before the more general.
    pub const ALL: [Self; 12] = [
        Self::SubgroupOne,
        Self::Subgroup,
        Self::Texture,
        Self::One,
        Self::Cooperative(128),
        Self::Cooperative(64),
        Self::Cooperative(32),
        Self::Tiled(8),
        Self::Tiled(4),
        Self::Tiled(2),
        Self::Tiled(1),
        Self::Buffer,
    ];

    /// The layouts that its tensors can have.
    pub fn layouts(self) -> &'static [Layout] {
        match self {
            Self::SubgroupOne | Self::Subgroup | Self::Texture => &[Layout::Texture],
            Self::Cooperative(_) => &[Layout::HalfBuffer],
            Self::One | Self::Tiled(_) | Self::Buffer => &[Layout::Buffer, Layout::HalfBuffer],
        }
    }

    /// Whether `device` can run it, on the layers that it serves.
    pub fn runs_on(self, device: &Device) -> bool {
        self.lacks(device).is_none()
    }

    /// What `device` lacks to run it; `None` where it can.
    pub fn lacks(self, device: &Device) -> Option<String> {
        match self {
            Self::SubgroupOne | Self::Subgroup => match device.subgroup_size() {
                Some(8..) => None,
                Some(size) => Some(format!("subgroups of {size}, 8 needed")),
                None => Some("no subgroups, 8 needed".into()),
            },
            Self::Cooperative(_) if device.tier() < Tier::CooperativeMatrix => {
                Some("no matrix units for 16 x 16 halves".into())
            }
            Self::One | Self::Cooperative(_) | Self::Texture | Self::Tiled(_) | Self::Buffer => {
                None
            }
        }
    }

    /// Whether it makes a max-pool behind a convolution with it.
    pub(crate) fn pools(self) -> bool {
        matches!(self, Self::Subgroup)
    }

    /// Whether it serves a layer.
    pub(super) fn serves(self, conv: &Conv2d<'_>) -> bool {
        let fits = match self {
            Self::SubgroupOne => {
                let reaches = conv.input.margin() >= Some(conv.reach());
                reaches && conv.kernel <= 7 && conv.output.shape.channels == 1
            }
            Self::One => conv.kernel <= 7 && conv.output.shape.channels == 1,
            _ => true,
        };
        let pools = conv.pool.is_none() || self.pools();
        fits && pools && self.layouts().contains(&conv.input.layout())
    }

    /// Whether it is the better choice where nothing was measured. What was found to be wrong on the adapter is not, nor what
    /// is experimental unless it was found to be right, and on CPU rasterisers workgroup memory is slower than any other; for a
    /// large GPU there should be workgroups enough.
    fn suits(self, device: &Device, conv: &Conv2d<'_>) -> bool {
        let right = is_right(device, self);
        if right == Some(false) {
            return false;
        }
        match self {
            Self::Cooperative(pixels) => {
                let enough = pixels == 32 || cooperative_workgroups(device, conv, pixels) >= 256;
                enough && right == Some(true)
            }
            Self::One => !is_rasteriser(device.info()),
            Self::Tiled(pixels) => {
                let enough = pixels == 1 || Tiling::new(conv, pixels).workgroups() >= 256;
                enough && !is_rasteriser(device.info())
            }
            _ => true,
        }
    }
}

impl fmt::Display for Conv2dKernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SubgroupOne => f.write_str("conv2d_subgroup_one"),
            Self::Subgroup => f.write_str("conv2d_subgroup"),
            Self::Texture => f.write_str("conv2d_texture"),
            Self::One => f.write_str("conv2d_one"),
            Self::Cooperative(pixels) => write!(f, "conv2d_cooperative/{pixels}"),
            Self::Tiled(pixels) => write!(f, "conv2d_tiled/{pixels}"),
            Self::Buffer => f.write_str("conv2d_buffer"),
        }
    }
}

/// Plans a convolution: by `only`, if it is given, or by what the device's tuner finds to be the fastest,
/// or else by the first kernel that suits and that the driver compiles.
pub(super) fn conv2d(
    device: &Device,
    conv: &Conv2d<'_>,
    only: Option<Conv2dKernel>,
) -> Result<Step, GpuError> {
    let mut candidates = Conv2dKernel::ALL.to_vec();
    candidates.retain(|kernel| kernel.runs_on(device) && kernel.serves(conv));
    match only {
        Some(only) => candidates.retain(|&kernel| kernel == only),
        None => {
            let fastest = tuned(device, conv, &candidates)?;
            candidates.retain(|kernel| kernel.suits(device, conv));
            candidates.splice(..0, fastest);
        }
    }
    first_of(&candidates, device, conv)?.ok_or_else(|| GpuError::Kernel {
        layer: conv.label.to_owned(),
        wanted: only.map_or("conv2d".into(), |only| only.to_string()),
    })
}

/// A convolution by the first of `candidates` that the driver takes; `None` of none. In a browser, whose errors come late, by
/// the first.
fn first_of(
    candidates: &[Conv2dKernel],
    device: &Device,
    conv: &Conv2d<'_>,
) -> Result<Option<Step>, GpuError> {
    let mut candidates = candidates.iter().peekable();
    while let Some(&kernel) = candidates.next() {
        match device.scoped(|| by(kernel, device, conv)) {
            Err(error @ (GpuError::Driver(_) | GpuError::Validation(_)))
                if candidates.peek().is_some() =>
            {
                device.check()?;
                log::warn!("{}: `{kernel}` is not used: {error}", conv.label);
            }
            made => return made.map(Some),
        }
    }
    Ok(None)
}

/// What the device's tuner finds to be the fastest; `None` in a browser, where nothing can be waited for.
fn tuned(
    device: &Device,
    conv: &Conv2d<'_>,
    candidates: &[Conv2dKernel],
) -> Result<Option<Conv2dKernel>, GpuError> {
    #[cfg(not(target_arch = "wasm32"))]
    return device.tuner().choose(device, conv, candidates);
    #[cfg(target_arch = "wasm32")]
    {
        let _ = (device, conv, candidates);
        Ok(None)
    }
}

/// Whether `kernel` answers rightly, as far as the device's tuner found out.
fn is_right(device: &Device, kernel: Conv2dKernel) -> Option<bool> {
    #[cfg(not(target_arch = "wasm32"))]
    return device.tuner().is_right(kernel);
    #[cfg(target_arch = "wasm32")]
    {
        let _ = (device, kernel);
        None
    }
}

/// A convolution by a `kernel` that serves it.
pub(super) fn by(
    kernel: Conv2dKernel,
    device: &Device,
    conv: &Conv2d<'_>,
) -> Result<Step, GpuError> {
    match kernel {
        Conv2dKernel::SubgroupOne => subgroup_one(device, conv),
        Conv2dKernel::Subgroup => texture(device, conv, true),
        Conv2dKernel::Texture => texture(device, conv, false),
        Conv2dKernel::One => one(device, conv),
        Conv2dKernel::Cooperative(pixels) => cooperative(device, conv, pixels),
        Conv2dKernel::Tiled(pixels) => tiled(device, conv, pixels),
        Conv2dKernel::Buffer => buffer(device, conv),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gpu::{AdapterRequest, Tensor};
    use crate::network::{Activation, Parameters, Shape};

    #[test]
    fn what_the_driver_does_not_take_is_passed_over() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let shape = Shape::new(4, 3, 3);
        let tensor = |what| Tensor::in_layout(&device, Layout::Buffer, what, shape, 1, 0).unwrap();
        let conv = Conv2d {
            label: "layer",
            input: &tensor("input"),
            output: &tensor("output"),
            parameters: &Parameters {
                weight: vec![1.0; 16],
                bias: vec![0.0; 4],
            },
            kernel: 1,
            dilation: 1,
            activation: Activation::None,
            pool: None,
        };
        let first = |candidates: &[Conv2dKernel]| {
            let step = first_of(candidates, &device, &conv)?;
            Ok::<_, GpuError>(step.map(|step| step.kernel()))
        };
        // It binds textures, and gets buffers.
        let wrong = Conv2dKernel::Texture;
        let found = first(&[wrong, Conv2dKernel::Tiled(1), Conv2dKernel::Buffer]);
        assert_eq!(found.unwrap(), Some("conv2d_tiled"));
        device.check().unwrap();
        // Negative control: alone it is what the driver says of it.
        assert!(matches!(first(&[wrong]), Err(GpuError::Validation(_))));
        assert_eq!(first(&[]).unwrap(), None);
    }
}
