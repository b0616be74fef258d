use std::fmt;

use serde::{Deserialize, Serialize};

/// What a plan's activations are stored in. Sums are f32 in either.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32-bit floats.
    #[default]
    F32,
    /// 16-bit floats, but for the joints: half the memory's work, on any adapter.
    F16,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        })
    }
}

/// How the tensors of a plan lie in memory: one way for all of them, so that nothing is converted
/// between layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// A buffer of `[channel / 4][image][row][column]` of `vec4<f32>`.
    Buffer,
    /// The same of four 16-bit floats. Tensors of one row and column stay `vec4<f32>`: the
    /// joints are among them.
    HalfBuffer,
    /// An array of textures: a layer for each `[channel / 4][image]`, four channels a texel, and
    /// round each layer a margin of zeros as wide as its readers reach.
    Texture,
}

impl Layout {
    /// Every layout.
    pub const ALL: [Self; 3] = [Self::Buffer, Self::HalfBuffer, Self::Texture];

    /// What it stores.
    pub fn precision(self) -> Precision {
        match self {
            Self::HalfBuffer => Precision::F16,
            Self::Buffer | Self::Texture => Precision::F32,
        }
    }

    /// What suits an adapter for 32-bit floats. CPU rasterisers read storage textures several times faster than
    /// buffers; GPUs want buffers.
    pub(super) fn of(info: &wgpu::AdapterInfo) -> Self {
        if is_rasteriser(info) {
            Self::Texture
        } else {
            Self::Buffer
        }
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Buffer => "buffer",
            Self::HalfBuffer => "half_buffer",
            Self::Texture => "texture",
        })
    }
}

/// Whether kernels for CPU rasterisers are for this adapter. A browser's is a GPU to us even where it is software:
/// there plain Rust is faster than any kernel, and tests run what browsers run on GPUs.
pub(super) fn is_rasteriser(info: &wgpu::AdapterInfo) -> bool {
    info.device_type == wgpu::DeviceType::Cpu && info.backend != wgpu::Backend::BrowserWebGpu
}
