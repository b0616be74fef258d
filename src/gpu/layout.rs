/// How the tensors of a plan lie in memory: one way for all of them, so that nothing is converted
/// between layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Layout {
    /// A buffer of `[channel / 4][image][row][column]` of `vec4<f32>`.
    Buffer,
    /// An array of textures: a layer for each `[channel / 4][image]`, four channels a texel, and
    /// round each layer a margin of zeros as wide as its readers reach beyond the image.
    Texture,
}

impl Layout {
    /// Every layout.
    pub const ALL: [Self; 2] = [Self::Buffer, Self::Texture];

    /// What suits an adapter. CPU rasterisers read storage textures several times faster than
    /// buffers; GPUs want buffers.
    pub(super) fn of(info: &wgpu::AdapterInfo) -> Self {
        match info.device_type {
            wgpu::DeviceType::Cpu => Self::Texture,
            _ => Self::Buffer,
        }
    }
}
