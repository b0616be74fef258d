use image::RgbaImage;

use super::step::{Step, StepDescriptor, Work};
use super::tensor::Tensor;
use super::{Device, GpuError};
use crate::camera::Rectification;

/// A source image, and its way into one image of a batch (`shaders/rectify.wgsl`). The texture is
/// made anew only when the source's size changes.
#[derive(Debug)]
pub struct Rectify {
    texture: wgpu::Texture,
    params: wgpu::Buffer,
    step: Step,
}

impl Rectify {
    /// Into `output` `[3, height, width]`.
    ///
    /// # Errors
    /// More pixels than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
    pub fn new(device: &Device, output: &Tensor) -> Result<Self, GpuError> {
        let (height, width) = (output.shape.height, output.shape.width);
        let texture = texture(device, 1, 1)?;
        let params = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: Some("rectify: params"),
            size: size_of::<Rectification>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let view = texture.create_view(&Default::default());
        let step = Step::new(
            device,
            &StepDescriptor {
                label: "rectify",
                kernel: "rectify",
                source: include_str!("../../shaders/rectify.wgsl"),
                entry_point: "main",
                constants: &[("WIDTH", width as f64), ("HEIGHT", height as f64)],
                bindings: &bindings(&view, &params, output),
                workgroups: (height * width).div_ceil(64),
                work: work(&texture, output),
            },
        )?;
        Ok(Self {
            texture,
            params,
            step,
        })
    }

    /// Writes `image` and `params` at the queue's next submission. `output` is that of [`Self::new`].
    ///
    /// # Errors
    /// An image beyond the adapter's limits, or too little memory.
    pub fn write(
        &mut self,
        device: &Device,
        output: &Tensor,
        image: &RgbaImage,
        params: &Rectification,
    ) -> Result<(), GpuError> {
        let (width, height) = image.dimensions();
        if (width, height) != (self.texture.width(), self.texture.height()) {
            self.texture = device.scoped(|| texture(device, width, height))?;
            let view = self.texture.create_view(&Default::default());
            self.step.rebind(
                device,
                &bindings(&view, &self.params, output),
                work(&self.texture, output),
            );
        }
        device.queue().write_texture(
            self.texture.as_image_copy(),
            image,
            wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(4 * width),
                rows_per_image: None,
            },
            self.texture.size(),
        );
        device
            .queue()
            .write_buffer(&self.params, 0, bytemuck::bytes_of(params));
        Ok(())
    }

    /// The dispatch.
    pub fn step(&self) -> &Step {
        &self.step
    }
}

/// Reads the source once, writes one image of `output`.
fn work(source: &wgpu::Texture, output: &Tensor) -> Work {
    Work {
        operations: 0,
        bytes: 4 * u64::from(source.width()) * u64::from(source.height())
            + 4 * output.shape.len() as u64,
    }
}

fn bindings<'a>(
    view: &'a wgpu::TextureView,
    params: &'a wgpu::Buffer,
    output: &'a Tensor,
) -> [(u32, wgpu::BindingResource<'a>); 3] {
    [
        (0, wgpu::BindingResource::TextureView(view)),
        (1, params.as_entire_binding()),
        (2, output.buffer.as_entire_binding()),
    ]
}

fn texture(device: &Device, width: u32, height: u32) -> Result<wgpu::Texture, GpuError> {
    let side = device.wgpu().limits().max_texture_dimension_2d;
    let longest = width.max(height);
    device.require("image: pixels along a side", longest.into(), side.into())?;
    Ok(device.wgpu().create_texture(&wgpu::TextureDescriptor {
        label: Some("source image"),
        size: wgpu::Extent3d {
            width,
            height,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    }))
}
