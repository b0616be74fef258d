use image::RgbaImage;

use super::source::{Planes, SourceKind};
use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::Tensor;
use super::zoom::Gazes;
use super::{Device, GpuError};
use crate::camera::Rectification;

/// What sees the sources of a batch: the canonical cameras, or others that look closer.
#[derive(Debug, Clone)]
pub struct Sight {
    /// The layer's label.
    pub label: &'static str,
    /// Where they look.
    pub gazes: Gazes,
    /// What they see, `[3, height, width]` each.
    pub image: Tensor,
}

/// A source image, and its way into one image of each of a batch's [`Sight`]s (`shaders/rectify.wgsl`): a texture of our own,
/// made anew only when the size of what is written changes, or a host's.
#[derive(Debug)]
pub struct Rectify {
    params: wgpu::Buffer,
    /// What `params` holds from the next submission on.
    written: Option<Rectification>,
    bound: Option<Bound>,
}

/// A source that is bound.
#[derive(Debug)]
struct Bound {
    source: Source,
    kind: SourceKind,
    /// One a sight.
    steps: Vec<Step>,
}

#[derive(Debug, PartialEq)]
enum Source {
    Own(wgpu::Texture),
    Host(Planes),
}

impl Rectify {
    /// Without a source. Driver errors reach the caller's [`Device::scoped`].
    pub fn new(device: &Device) -> Self {
        let params = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: Some("rectify: params"),
            size: size_of::<Rectification>() as u64,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Self {
            params,
            written: None,
            bound: None,
        }
    }

    /// Writes `image` and `params` at the queue's next submission. To be rectified for `sights`, always the same.
    ///
    /// # Errors
    /// An image beyond the adapter's limits, or too little memory.
    pub fn write(
        &mut self,
        device: &Device,
        sights: &[Sight],
        image: &RgbaImage,
        params: &Rectification,
    ) -> Result<(), GpuError> {
        let (width, height) = image.dimensions();
        let own = match &self.bound {
            Some(Bound {
                source: Source::Own(texture),
                ..
            }) if (texture.width(), texture.height()) == (width, height) => texture.clone(),
            _ => {
                let texture = device.scoped(|| texture(device, width, height))?;
                self.bind_source(
                    device,
                    sights,
                    Source::Own(texture.clone()),
                    SourceKind::Storage,
                )?;
                texture
            }
        };
        device.queue().write_texture(
            own.as_image_copy(),
            image,
            wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(4 * width),
                rows_per_image: None,
            },
            own.size(),
        );
        self.write_params(device, params);
        Ok(())
    }

    /// Reads a host's `planes` from now on, and takes `params` from the queue's next submission on. To be
    /// rectified for `sights`, always the same. Makes nothing where the planes are those of the last time.
    ///
    /// # Errors
    /// Planes that cannot be read: nothing is changed then.
    pub fn bind(
        &mut self,
        device: &Device,
        sights: &[Sight],
        planes: &Planes,
        params: &Rectification,
    ) -> Result<(), GpuError> {
        let is_bound =
            |bound: &Bound| matches!(&bound.source, Source::Host(host) if host == planes);
        if !self.bound.as_ref().is_some_and(is_bound) {
            let kind = planes.kind(device)?;
            self.bind_source(device, sights, Source::Host(planes.clone()), kind)?;
        }
        self.write_params(device, params);
        Ok(())
    }

    /// The dispatches, one a sight; none without a source.
    pub fn steps(&self) -> &[Step] {
        self.bound.as_ref().map_or(&[], |bound| &bound.steps)
    }

    fn write_params(&mut self, device: &Device, params: &Rectification) {
        if self.written.as_ref() != Some(params) {
            let bytes = bytemuck::bytes_of(params);
            device.queue().write_buffer(&self.params, 0, bytes);
            self.written = Some(*params);
        }
    }

    fn bind_source(
        &mut self,
        device: &Device,
        sights: &[Sight],
        source: Source,
        kind: SourceKind,
    ) -> Result<(), GpuError> {
        let own;
        let mut bindings = vec![(4, self.params.as_entire_binding())];
        let bytes = match &source {
            Source::Own(texture) => {
                own = texture.create_view(&Default::default());
                bindings.push((3, wgpu::BindingResource::TextureView(&own)));
                4 * u64::from(texture.width()) * u64::from(texture.height())
            }
            Source::Host(planes) => {
                let (first, chroma) = match planes {
                    Planes::Rgba(view) => (view, None),
                    Planes::Nv12 { luma, chroma, .. } => (luma, Some(chroma)),
                };
                bindings.push((3, wgpu::BindingResource::TextureView(first)));
                bindings.extend(chroma.map(|v| (5, wgpu::BindingResource::TextureView(v))));
                planes.bytes()
            }
        };
        let constants = match kind {
            SourceKind::Nv12(encoding) => encoding.constants().to_vec(),
            _ => Vec::new(),
        };
        let before = self.bound.as_ref().filter(|bound| bound.kind == kind);
        let before = before.map_or(&[][..], |bound| &bound.steps);
        let step = |index: usize, sight: &Sight| {
            let output = &sight.image;
            let bindings = [&bindings[..], &[(6, sight.gazes.binding())]].concat();
            let work = Work {
                operations: 0,
                bytes: bytes + 4 * output.shape.len() as u64,
            };
            let tensors = Tensors::to(output);
            if let Some(step) = before.get(index) {
                return Ok(step.rebound(device, tensors, &bindings, work));
            }
            Step::new(
                device,
                &StepDescriptor {
                    label: sight.label,
                    kernel: "rectify",
                    source: kind.text(),
                    entry_point: "main",
                    tensors,
                    constants: &constants,
                    sizes: &[],
                    bindings: &bindings,
                    workgroups: (output.shape.height * output.shape.width).div_ceil(64),
                    work,
                },
            )
        };
        let steps = sights.iter().enumerate().map(|(i, sight)| step(i, sight));
        let steps = device.scoped(|| steps.collect())?;
        self.bound = Some(Bound {
            source,
            kind,
            steps,
        });
        Ok(())
    }
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
        usage: wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    }))
}
