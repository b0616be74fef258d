use half::f16;

use super::{Device, GpuError, Layout};
use crate::network::Shape;

/// A batch of activations on the GPU, four channels a texel, in the plan's [`Layout`]. It may be some
/// of the channels of a larger one: both then share their memory. Lanes beyond the last channel are
/// finite and mean nothing.
#[derive(Debug, Clone)]
pub struct Tensor {
    /// Shape of one image.
    pub shape: Shape,
    /// Number of images.
    pub batch: usize,
    memory: Memory,
}

#[derive(Debug, Clone)]
enum Memory {
    Buffer {
        buffer: wgpu::Buffer,
        /// Where it begins, in bytes.
        offset: u64,
        layout: Layout,
        /// Of 32-bit floats, whatever the layout.
        full: bool,
    },
    Texture {
        texture: wgpu::Texture,
        /// Its layers only.
        view: wgpu::TextureView,
        first_layer: u32,
        margin: u32,
    },
}

/// Blocks of four channels that hold `channels`.
pub fn blocks(channels: usize) -> usize {
    channels.div_ceil(4)
}

/// Bytes of a texel of 32-bit floats.
const TEXEL: usize = 16;

/// Bytes of a texel.
fn texel_size(full: bool) -> usize {
    if full { TEXEL } else { TEXEL / 2 }
}

impl Tensor {
    /// Allocates a tensor, zeroed, in the device's layout for `f32` and without a margin. `what` names it in
    /// errors. What a network reads wants a margin: [`NetworkPlan::input`](super::NetworkPlan::input).
    ///
    /// # Errors
    /// [`GpuError::Limit`] where the adapter's buffers or textures are too small.
    pub fn new(device: &Device, what: &str, shape: Shape, batch: usize) -> Result<Self, GpuError> {
        Self::in_layout(device, Layout::of(device.info()), what, shape, batch, 0)
    }

    /// Allocates a tensor, zeroed, in `layout`. Its readers may reach `margin` texels beyond its
    /// rows and columns; buffers have no margin, and their kernels look for themselves.
    ///
    /// # Errors
    /// As [`Tensor::new`].
    pub fn in_layout(
        device: &Device,
        layout: Layout,
        what: &str,
        shape: Shape,
        batch: usize,
        margin: usize,
    ) -> Result<Self, GpuError> {
        let planes = blocks(shape.channels) * batch;
        let memory = match layout {
            Layout::Buffer | Layout::HalfBuffer => {
                let texels = planes as u64 * (shape.height * shape.width) as u64;
                let full = layout == Layout::Buffer || shape.height * shape.width == 1;
                let bytes = texels * texel_size(full) as u64;
                Memory::Buffer {
                    buffer: storage_buffer(device, what, bytes)?,
                    offset: 0,
                    layout,
                    full,
                }
            }
            Layout::Texture => {
                let [width, height] = [shape.width, shape.height].map(|side| side + 2 * margin);
                let texture = storage_texture(device, what, [width, height, planes])?;
                Memory::Texture {
                    view: layers(&texture, 0, planes as u32),
                    texture,
                    first_layer: 0,
                    margin: margin as u32,
                }
            }
        };
        Ok(Self {
            shape,
            batch,
            memory,
        })
    }

    /// `channels` channels from channel `first` on, a multiple of four; `None` where memory cannot be
    /// bound from there on.
    pub(super) fn slice(&self, device: &Device, first: usize, channels: usize) -> Option<Self> {
        let shape = Shape {
            channels,
            ..self.shape
        };
        let first_plane = first / 4 * self.batch;
        let planes = blocks(channels) * self.batch;
        let memory = match &self.memory {
            Memory::Buffer {
                buffer,
                offset,
                layout,
                full,
            } => {
                let alignment = device.wgpu().limits().min_storage_buffer_offset_alignment;
                let before = first_plane * shape.height * shape.width;
                let offset = offset + (self.texel_size() * before) as u64;
                if !offset.is_multiple_of(alignment.into()) {
                    return None;
                }
                Memory::Buffer {
                    buffer: buffer.clone(),
                    offset,
                    layout: *layout,
                    full: *full,
                }
            }
            Memory::Texture {
                texture,
                first_layer,
                margin,
                ..
            } => {
                let first_layer = first_layer + first_plane as u32;
                // wgpu's GL backend binds a texture from its first layer on, whatever its view says.
                if first_layer > 0 && device.info().backend == wgpu::Backend::Gl {
                    return None;
                }
                Memory::Texture {
                    view: layers(texture, first_layer, planes as u32),
                    texture: texture.clone(),
                    first_layer,
                    margin: *margin,
                }
            }
        };
        Some(Self {
            shape,
            batch: self.batch,
            memory,
        })
    }

    /// How it lies in memory.
    pub fn layout(&self) -> Layout {
        match self.memory {
            Memory::Buffer { layout, .. } => layout,
            Memory::Texture { .. } => Layout::Texture,
        }
    }

    /// How far its readers may reach beyond its rows and columns; `None` for buffers, whose kernels
    /// look for themselves.
    pub(super) fn margin(&self) -> Option<usize> {
        match self.memory {
            Memory::Buffer { .. } => None,
            Memory::Texture { margin, .. } => Some(margin as usize),
        }
    }

    /// Planes (layers) of the whole batch.
    pub(super) fn planes(&self) -> usize {
        self.batch * blocks(self.shape.channels)
    }

    /// Texels of the whole batch. Fits 32 bits: the kernels count in them.
    pub fn texels(&self) -> usize {
        self.planes() * self.shape.height * self.shape.width
    }

    /// What a kernel binds.
    pub(super) fn resource(&self) -> wgpu::BindingResource<'_> {
        match &self.memory {
            Memory::Buffer { buffer, offset, .. } => {
                wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer,
                    offset: *offset,
                    size: wgpu::BufferSize::new((self.texel_size() * self.texels()) as u64),
                })
            }
            Memory::Texture { view, .. } => wgpu::BindingResource::TextureView(view),
        }
    }

    /// Bytes of the values of the whole batch, without unused lanes.
    pub fn bytes(&self) -> u64 {
        (self.texel_size() / 4 * self.batch * self.shape.len()) as u64
    }

    /// Whether it is of 32-bit floats.
    pub(super) fn is_full(&self) -> bool {
        match self.memory {
            Memory::Buffer { full, .. } => full,
            Memory::Texture { .. } => true,
        }
    }

    fn texel_size(&self) -> usize {
        texel_size(self.is_full())
    }

    /// Writes `[image][channel][row][column]` values at the queue's next submission.
    ///
    /// # Errors
    /// [`GpuError::Size`] for another number of values.
    pub fn write(&self, device: &Device, values: &[f32]) -> Result<(), GpuError> {
        let expected = self.batch * self.shape.len();
        if values.len() != expected {
            return Err(GpuError::Size {
                what: "input",
                expected,
                found: values.len(),
            });
        }
        let packed = pack(values, self.shape, self.batch);
        let halves: Vec<f16>;
        let bytes: &[u8] = if self.is_full() {
            bytemuck::cast_slice(&packed)
        } else {
            halves = packed.into_iter().map(f16::from_f32).collect();
            bytemuck::cast_slice(&halves)
        };
        match &self.memory {
            Memory::Buffer { buffer, offset, .. } => {
                device.queue().write_buffer(buffer, *offset, bytes);
            }
            Memory::Texture { texture, .. } => device.queue().write_texture(
                self.place(texture),
                bytes,
                wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some((TEXEL * self.shape.width) as u32),
                    rows_per_image: Some(self.shape.height as u32),
                },
                self.extent(),
            ),
        }
        Ok(())
    }

    /// Writes numbers in [-1, 1), some of which repeat. For buffers.
    #[cfg(not(target_arch = "wasm32"))]
    pub(super) fn fill(&self, device: &Device) {
        // A prime number of texels: not every row or plane begins with the same.
        let numbers = (0..4 * 16_381_u32).map(|i| i.wrapping_mul(2_654_435_761) as i32 as f32);
        let numbers = numbers.map(|number| number / (1_u32 << 31) as f32);
        let bytes: Vec<u8> = if self.is_full() {
            numbers.flat_map(f32::to_le_bytes).collect()
        } else {
            numbers
                .flat_map(|v| f16::from_f32(v).to_le_bytes())
                .collect()
        };
        self.repeat(device, &bytes);
    }

    /// Writes what is no number. For buffers.
    #[cfg(not(target_arch = "wasm32"))]
    pub(super) fn spoil(&self, device: &Device) {
        self.repeat(device, &[0xff; 1 << 16]);
    }

    /// Writes `bytes` again and again.
    #[cfg(not(target_arch = "wasm32"))]
    fn repeat(&self, device: &Device, bytes: &[u8]) {
        let Memory::Buffer { buffer, offset, .. } = &self.memory else {
            return;
        };
        // A batch's input is hundreds of megabytes: one piece goes to the device, and copies of it stay there.
        let piece = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: Some("numbers"),
            size: bytes.len() as u64,
            usage: wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        device.queue().write_buffer(&piece, 0, bytes);
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        let end = offset + (self.texel_size() * self.texels()) as u64;
        for at in (*offset..end).step_by(bytes.len()) {
            let rest = (end - at).min(piece.size());
            encoder.copy_buffer_to_buffer(&piece, 0, buffer, at, rest);
        }
        device.queue().submit([encoder.finish()]);
    }

    /// Numbers from all over it, as they lie in memory. For buffers. Waits for what was submitted before.
    #[cfg(not(target_arch = "wasm32"))]
    pub(super) fn sample(&self, device: &Device) -> Result<Vec<f32>, GpuError> {
        const PIECES: u64 = 64;
        const PIECE: u64 = 1 << 14;
        let Memory::Buffer { buffer, offset, .. } = &self.memory else {
            return Ok(Vec::new());
        };
        let size = (self.texel_size() * self.texels()) as u64;
        let (pieces, piece) = if size <= PIECES * PIECE {
            (1, size)
        } else {
            (PIECES, PIECE)
        };
        let staging = staging_buffer(device, pieces * piece);
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        for number in 0..pieces {
            let at = (size - piece) * number / pieces.max(2) / 16 * 16;
            encoder.copy_buffer_to_buffer(buffer, offset + at, &staging, number * piece, piece);
        }
        device.queue().submit([encoder.finish()]);
        device.read(&staging, |bytes| {
            if self.is_full() {
                bytemuck::pod_collect_to_vec(bytes)
            } else {
                let halves: Vec<f16> = bytemuck::pod_collect_to_vec(bytes);
                halves.into_iter().map(f16::to_f32).collect()
            }
        })
    }

    /// Reads `[image][channel][row][column]` values back. Waits for what was submitted before.
    ///
    /// # Errors
    /// As [`Device::read`].
    #[cfg(not(target_arch = "wasm32"))]
    pub fn read(&self, device: &Device) -> Result<Vec<f32>, GpuError> {
        pollster::block_on(self.read_async(device))
    }

    /// As [`Tensor::read`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// As [`Device::read`].
    pub async fn read_async(&self, device: &Device) -> Result<Vec<f32>, GpuError> {
        let staging = device.scoped(|| Ok(staging_buffer(device, self.staging_size())))?;
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        self.copy_to(&mut encoder, &staging, 0);
        device.queue().submit([encoder.finish()]);
        let values = device.read_async(&staging, |bytes| self.values(bytes));
        values.await
    }

    /// Bytes that [`Self::copy_to`] writes.
    pub(super) fn staging_size(&self) -> u64 {
        (self.staging_row() * self.planes() * self.shape.height) as u64
    }

    /// Records a copy to `staging`, from byte `offset` on, a multiple of 256.
    pub(super) fn copy_to(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        staging: &wgpu::Buffer,
        offset: u64,
    ) {
        match &self.memory {
            Memory::Buffer {
                buffer,
                offset: from,
                ..
            } => {
                let size = self.staging_size();
                encoder.copy_buffer_to_buffer(buffer, *from, staging, offset, size);
            }
            Memory::Texture { texture, .. } => encoder.copy_texture_to_buffer(
                self.place(texture),
                wgpu::TexelCopyBufferInfo {
                    buffer: staging,
                    layout: wgpu::TexelCopyBufferLayout {
                        offset,
                        bytes_per_row: Some(self.staging_row() as u32),
                        rows_per_image: Some(self.shape.height as u32),
                    },
                },
                self.extent(),
            ),
        }
    }

    /// `[image][channel][row][column]` values of what [`Self::copy_to`] wrote.
    pub(super) fn values(&self, bytes: &[u8]) -> Vec<f32> {
        let row = self.texel_size() * self.shape.width;
        let rows = bytes
            .chunks_exact(self.staging_row())
            .take(self.planes() * self.shape.height)
            .filter_map(|padded| padded.get(..row));
        let packed: Vec<f32> = if self.is_full() {
            rows.flat_map(bytemuck::pod_collect_to_vec::<u8, f32>)
                .collect()
        } else {
            rows.flat_map(bytemuck::pod_collect_to_vec::<u8, f16>)
                .map(f16::to_f32)
                .collect()
        };
        unpack(&packed, self.shape, self.batch)
    }

    /// Bytes of a row in a staging buffer.
    fn staging_row(&self) -> usize {
        let row = self.texel_size() * self.shape.width;
        match self.memory {
            Memory::Buffer { .. } => row,
            Memory::Texture { .. } => {
                row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT as usize)
            }
        }
    }

    fn place<'a>(&self, texture: &'a wgpu::Texture) -> wgpu::TexelCopyTextureInfo<'a> {
        let (z, margin) = match self.memory {
            Memory::Buffer { .. } => (0, 0),
            Memory::Texture {
                first_layer,
                margin,
                ..
            } => (first_layer, margin),
        };
        wgpu::TexelCopyTextureInfo {
            origin: wgpu::Origin3d {
                x: margin,
                y: margin,
                z,
            },
            ..texture.as_image_copy()
        }
    }

    fn extent(&self) -> wgpu::Extent3d {
        wgpu::Extent3d {
            width: self.shape.width as u32,
            height: self.shape.height as u32,
            depth_or_array_layers: self.planes() as u32,
        }
    }
}

/// From `[image][channel][row][column]` to the texels of a [`Tensor`]: `[block][image][row][column]`,
/// zeros in unused lanes.
pub fn pack(values: &[f32], shape: Shape, batch: usize) -> Vec<f32> {
    let plane = shape.height * shape.width;
    let mut packed = vec![0.0; batch * blocks(shape.channels) * plane * 4];
    for (image, values) in values.chunks_exact(shape.len()).enumerate() {
        for (channel, values) in values.chunks_exact(plane).enumerate() {
            let first = (channel / 4 * batch + image) * plane * 4 + channel % 4;
            let lanes = packed.iter_mut().skip(first).step_by(4);
            lanes.zip(values).for_each(|(lane, value)| *lane = *value);
        }
    }
    packed
}

/// The inverse of [`pack`].
pub fn unpack(packed: &[f32], shape: Shape, batch: usize) -> Vec<f32> {
    let plane = shape.height * shape.width;
    let mut values = Vec::with_capacity(batch * shape.len());
    for image in 0..batch {
        for channel in 0..shape.channels {
            let first = (channel / 4 * batch + image) * plane * 4 + channel % 4;
            values.extend(packed.iter().skip(first).step_by(4).take(plane));
        }
    }
    values
}

/// A storage buffer of `size` bytes, checked against the adapter's limits.
pub(super) fn storage_buffer(
    device: &Device,
    what: &str,
    size: u64,
) -> Result<wgpu::Buffer, GpuError> {
    let limits = device.wgpu().limits();
    let allowed = limits
        .max_storage_buffer_binding_size
        .min(limits.max_buffer_size);
    device.require(&format!("{what}: bytes in a buffer"), size, allowed)?;
    // Kernels index texels and weights with 32 bits.
    device.require(&format!("{what}: bytes in a buffer"), size, 1 << 34)?;
    Ok(device.wgpu().create_buffer(&wgpu::BufferDescriptor {
        label: Some(what),
        size,
        usage: wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    }))
}

/// A storage buffer that holds `values`, written at the queue's next submission.
pub(super) fn constant_buffer(
    device: &Device,
    what: &str,
    values: &[f32],
) -> Result<wgpu::Buffer, GpuError> {
    constant_bytes(device, what, bytemuck::cast_slice(values))
}

/// The same, rounded to halves.
pub(super) fn constant_halves(
    device: &Device,
    what: &str,
    values: &[f32],
) -> Result<wgpu::Buffer, GpuError> {
    let halves: Vec<f16> = values.iter().copied().map(f16::from_f32).collect();
    constant_bytes(device, what, bytemuck::cast_slice(&halves))
}

fn constant_bytes(device: &Device, what: &str, bytes: &[u8]) -> Result<wgpu::Buffer, GpuError> {
    let buffer = storage_buffer(device, what, bytes.len() as u64)?;
    device.queue().write_buffer(&buffer, 0, bytes);
    Ok(buffer)
}

/// A uniform buffer that holds `values`, written at the queue's next submission.
pub(super) fn uniform_buffer(device: &Device, what: &str, values: &[u32]) -> wgpu::Buffer {
    let bytes: &[u8] = bytemuck::cast_slice(values);
    let buffer = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
        label: Some(what),
        size: bytes.len() as u64,
        usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    device.queue().write_buffer(&buffer, 0, bytes);
    buffer
}

/// A side that is no power of two. Mesa compiles a kernel again for textures whose sides are, and for those of one layer:
/// that takes a second in all, and a texel or a layer too much takes nothing.
fn uneven(side: usize) -> usize {
    if side.is_power_of_two() {
        // One more than one is a power itself.
        (side + 1).max(3)
    } else {
        side
    }
}

/// An array of storage textures of `[columns, rows, layers]`, checked against the adapter's limits.
fn storage_texture(
    device: &Device,
    what: &str,
    [width, height, layers]: [usize; 3],
) -> Result<wgpu::Texture, GpuError> {
    let limits = device.wgpu().limits();
    let side = limits.max_texture_dimension_2d;
    let (mut width, height, layers) = (uneven(width), uneven(height), layers.max(2));
    if width == height && layers.is_multiple_of(6) {
        // wgpu's GL backend takes it for a cube.
        width = uneven(width + 1);
    }
    let require = |quantity: &str, needed: usize, allowed: u32| {
        device.require(
            &format!("{what}: {quantity}"),
            needed as u64,
            allowed.into(),
        )
    };
    require("texels along a side", width.max(height), side)?;
    require(
        "layers of a texture",
        layers,
        limits.max_texture_array_layers,
    )?;
    Ok(device.wgpu().create_texture(&wgpu::TextureDescriptor {
        label: Some(what),
        size: wgpu::Extent3d {
            width: width as u32,
            height: height as u32,
            depth_or_array_layers: layers as u32,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba32Float,
        usage: wgpu::TextureUsages::STORAGE_BINDING
            | wgpu::TextureUsages::COPY_SRC
            | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    }))
}

/// A texture array of `[columns, rows, layers]` texels that holds `values`, written at the queue's
/// next submission.
pub(super) fn constant_texture(
    device: &Device,
    what: &str,
    size: [usize; 3],
    values: &[f32],
) -> Result<wgpu::TextureView, GpuError> {
    let texture = storage_texture(device, what, size)?;
    device.queue().write_texture(
        texture.as_image_copy(),
        bytemuck::cast_slice(values),
        wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some((TEXEL * size[0]) as u32),
            rows_per_image: Some(size[1] as u32),
        },
        wgpu::Extent3d {
            width: size[0] as u32,
            height: size[1] as u32,
            depth_or_array_layers: size[2] as u32,
        },
    );
    Ok(layers(&texture, 0, size[2] as u32))
}

fn layers(texture: &wgpu::Texture, first: u32, count: u32) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        base_array_layer: first,
        array_layer_count: Some(count),
        ..Default::default()
    })
}

/// A buffer to copy to and map.
pub(super) fn staging_buffer(device: &Device, size: u64) -> wgpu::Buffer {
    device.wgpu().create_buffer(&wgpu::BufferDescriptor {
        label: Some("readback"),
        size,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_side_of_a_texture_is_a_power_of_two() {
        for side in 1..5000 {
            let uneven = uneven(side);
            assert!(!uneven.is_power_of_two() && (side..side + 3).contains(&uneven));
        }
    }

    #[test]
    fn packing_is_undone_by_unpacking() {
        let shape = Shape::new(5, 2, 3);
        let values: Vec<f32> = (0..60).map(|v| v as f32).collect();
        let packed = pack(&values, shape, 2);
        assert_eq!(unpack(&packed, shape, 2), values);
        // Negative control: the two layouts differ.
        assert_ne!(packed.get(..60), Some(values.as_slice()));
    }

    #[test]
    #[allow(clippy::unwrap_used)]
    fn no_texture_looks_like_a_cube() {
        let device = Device::open(&crate::gpu::AdapterRequest::new(None, None)).unwrap();
        for side in 1..20 {
            let texture = storage_texture(&device, "test", [side, side, 6]).unwrap();
            assert_ne!(texture.width(), texture.height());
            assert!(!texture.width().is_power_of_two());
        }
        // Negative control: other textures may be square.
        let texture = storage_texture(&device, "test", [7, 7, 5]).unwrap();
        assert_eq!(texture.width(), texture.height());
    }
}
