use super::{Device, GpuError};
use crate::network::Shape;

/// A batch of activations on the GPU: `[image][channel / 4][row][column]` of `vec4<f32>`, four
/// channels side by side. Lanes beyond the last channel are finite and mean nothing.
#[derive(Debug)]
pub struct Tensor {
    /// Shape of one image.
    pub shape: Shape,
    /// Number of images.
    pub batch: usize,
    /// `batch * blocks * height * width` times 16 bytes.
    pub buffer: wgpu::Buffer,
}

/// Blocks of four channels that hold `channels`.
pub fn blocks(channels: usize) -> usize {
    channels.div_ceil(4)
}

impl Tensor {
    /// Allocates a tensor, zeroed. `what` names it in errors.
    ///
    /// # Errors
    /// [`GpuError::Limit`] where the adapter's buffers are too small.
    pub fn new(device: &Device, what: &str, shape: Shape, batch: usize) -> Result<Self, GpuError> {
        let texels = blocks(shape.channels) as u64 * (shape.height * shape.width) as u64;
        let size = 16 * batch as u64 * texels;
        let buffer = storage_buffer(device, what, size)?;
        Ok(Self {
            shape,
            batch,
            buffer,
        })
    }

    /// Texels (vec4) of the whole batch. Fits 32 bits: the kernels count in them.
    pub fn texels(&self) -> usize {
        self.batch * blocks(self.shape.channels) * self.shape.height * self.shape.width
    }

    /// Bytes of the values of the whole batch, without unused lanes.
    pub fn bytes(&self) -> u64 {
        4 * (self.batch * self.shape.len()) as u64
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
        let packed = pack(values, self.shape);
        device
            .queue()
            .write_buffer(&self.buffer, 0, bytemuck::cast_slice(&packed));
        Ok(())
    }

    /// Reads `[image][channel][row][column]` values back. Waits for what was submitted before.
    ///
    /// # Errors
    /// As [`Device::read`].
    pub fn read(&self, device: &Device) -> Result<Vec<f32>, GpuError> {
        let staging = device.scoped(|| Ok(staging_buffer(device, self.buffer.size())))?;
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.buffer, 0, &staging, 0, self.buffer.size());
        device.queue().submit([encoder.finish()]);
        device.read(&staging, |bytes| {
            unpack(&bytemuck::pod_collect_to_vec(bytes), self.shape)
        })
    }
}

/// From `[image][channel][row][column]` to the layout of [`Tensor`], with zeros in unused lanes.
pub fn pack(values: &[f32], shape: Shape) -> Vec<f32> {
    let plane = shape.height * shape.width;
    let mut packed = vec![0.0; values.len() / shape.len() * blocks(shape.channels) * plane * 4];
    let images = values.chunks_exact(shape.len());
    let packed_images = packed.chunks_exact_mut(blocks(shape.channels) * plane * 4);
    for (image, packed) in images.zip(packed_images) {
        for (index, value) in image.iter().enumerate() {
            let (channel, pixel) = (index / plane, index % plane);
            packed[(channel / 4 * plane + pixel) * 4 + channel % 4] = *value;
        }
    }
    packed
}

/// The inverse of [`pack`].
pub fn unpack(packed: &[f32], shape: Shape) -> Vec<f32> {
    let plane = shape.height * shape.width;
    packed
        .chunks_exact(blocks(shape.channels) * plane * 4)
        .flat_map(|image| {
            (0..shape.len()).map(move |index| {
                let (channel, pixel) = (index / plane, index % plane);
                image[(channel / 4 * plane + pixel) * 4 + channel % 4]
            })
        })
        .collect()
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
    let bytes: &[u8] = bytemuck::cast_slice(values);
    let buffer = storage_buffer(device, what, bytes.len() as u64)?;
    device.queue().write_buffer(&buffer, 0, bytes);
    Ok(buffer)
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
    fn packing_is_undone_by_unpacking() {
        let shape = Shape::new(5, 2, 3);
        let values: Vec<f32> = (0..60).map(|v| v as f32).collect();
        let packed = pack(&values, shape);
        assert_eq!(unpack(&packed, shape), values);
        // Negative control: the two layouts differ.
        assert_ne!(packed.get(..60), Some(values.as_slice()));
    }
}
