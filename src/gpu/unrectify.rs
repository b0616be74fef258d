use bytemuck::{Pod, Zeroable};

use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::{Tensor, storage_buffer};
use super::{Device, GpuError};
use crate::camera::Unrectification;

/// The mask of one image of a batch as a texture of `r8unorm` in the camera's image as it is stored
/// (`shaders/unrectify.wgsl`).
#[derive(Debug)]
pub struct Unrectify {
    step: Step,
    nodes: wgpu::Buffer,
    bytes: wgpu::Buffer,
    texture: wgpu::Texture,
    view: wgpu::TextureView,
}

/// What the kernel reads besides the mask.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Params {
    size: [u32; 2],
    columns: u32,
    stride: u32,
    index: u32,
    padding: [u32; 3],
}

impl Unrectify {
    /// Of image `index` of `mask` `[1, height, width]`, as `params` say.
    ///
    /// # Errors
    /// An image beyond the adapter's limits. Driver errors reach the caller's [`Device::scoped`].
    pub fn new(
        device: &Device,
        mask: &Tensor,
        index: usize,
        params: &Unrectification,
    ) -> Result<Self, GpuError> {
        let [width, height] = params.size;
        let side = device.wgpu().limits().max_texture_dimension_2d;
        device.require(
            "mask: pixels along a side",
            width.max(height).into(),
            side.into(),
        )?;
        // Rows of a copy to a texture begin at multiples of so many bytes.
        let row = width.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let bytes = storage_buffer(device, "mask: bytes", u64::from(row) * u64::from(height))?;
        let buffer = |label, content: &[u8]| {
            let buffer = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: content.len() as u64,
                usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            device.queue().write_buffer(&buffer, 0, content);
            buffer
        };
        let read = Params {
            size: params.size,
            columns: params.columns,
            stride: row / 4,
            index: index as u32,
            padding: [0; 3],
        };
        let nodes = buffer("unrectify: nodes", bytemuck::cast_slice(&params.nodes));
        let step = Step::new(
            device,
            &StepDescriptor {
                label: "unrectify",
                kernel: "unrectify",
                source: include_str!("../../shaders/unrectify.wgsl"),
                entry_point: "main",
                tensors: Tensors::from(mask),
                constants: &[],
                sizes: &[],
                bindings: &[
                    (
                        3,
                        buffer("unrectify: params", bytemuck::bytes_of(&read)).as_entire_binding(),
                    ),
                    (4, nodes.as_entire_binding()),
                    (5, bytes.as_entire_binding()),
                ],
                workgroups: (row as usize / 4 * height as usize).div_ceil(64),
                work: Work {
                    operations: 0,
                    bytes: 4 * mask.shape.len() as u64 + nodes.size() + bytes.size(),
                },
            },
        )?;
        let texture = device.wgpu().create_texture(&wgpu::TextureDescriptor {
            label: Some("mask"),
            size: wgpu::Extent3d {
                width,
                height,
                depth_or_array_layers: 1,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::R8Unorm,
            usage: wgpu::TextureUsages::TEXTURE_BINDING
                | wgpu::TextureUsages::COPY_DST
                | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        Ok(Self {
            step,
            nodes,
            bytes,
            view: texture.create_view(&Default::default()),
            texture,
        })
    }

    /// Columns and rows.
    pub fn size(&self) -> [u32; 2] {
        [self.texture.width(), self.texture.height()]
    }

    /// As other `params` of its size say, from the queue's next submission on.
    pub fn write(&self, device: &Device, params: &Unrectification) {
        let nodes = bytemuck::cast_slice(&params.nodes);
        device.queue().write_buffer(&self.nodes, 0, nodes);
    }

    /// The texture: `r8unorm`, to be bound and copied from.
    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// The dispatch.
    pub fn step(&self) -> &Step {
        &self.step
    }

    /// Records what follows the dispatch: the copy to the texture.
    pub fn copy(&self, encoder: &mut wgpu::CommandEncoder) {
        let size = self.texture.size();
        encoder.copy_buffer_to_texture(
            wgpu::TexelCopyBufferInfo {
                buffer: &self.bytes,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some((self.bytes.size() / u64::from(size.height)) as u32),
                    rows_per_image: None,
                },
            },
            self.texture.as_image_copy(),
            size,
        );
    }
}
