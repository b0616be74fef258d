//! The host's device, its render pass, and what it draws with.

use std::error::Error;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use image::RgbaImage;
use whereabot::camera::{Camera, graphics};
use whereabot::cascade::{Estimate, HostLocator, HostOptions, MaskSize, Source, Status};
use whereabot::gpu::Device;
use whereabot::network::Model;
use winit::window::Window;

const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
const SPHERE_VERTICES: u32 = 6 * 24 * 12;

pub struct Scene {
    device: wgpu::Device,
    queue: wgpu::Queue,
    surface: wgpu::Surface<'static>,
    configuration: wgpu::SurfaceConfiguration,
    depth: wgpu::TextureView,
    picture_pipeline: wgpu::RenderPipeline,
    sphere_pipeline: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    view: wgpu::Buffer,
    joints: u32,
    locator: HostLocator,
    shown: Option<Shown>,
    frame: u64,
    last: Option<Estimate>,
}

/// The camera's texture, and what draws it.
struct Shown {
    texture: wgpu::Texture,
    bind_group: wgpu::BindGroup,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct View {
    projection: [f32; 16],
    radius: f32,
    padding: [f32; 3],
}

impl Scene {
    pub async fn new(window: &Arc<Window>, model: &Model) -> Result<Self, Box<dyn Error>> {
        let instance =
            wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
        let surface = instance.create_surface(Arc::clone(window))?;
        let adapter = instance
            .request_adapter(&wgpu::RequestAdapterOptions {
                compatible_surface: Some(&surface),
                ..Default::default()
            })
            .await?;
        let (device, queue) = adapter.request_device(&Default::default()).await?;
        let size = window.inner_size();
        let mut configuration = surface
            .get_default_config(&adapter, size.width.max(1), size.height.max(1))
            .ok_or("the adapter cannot draw to this window")?;
        let formats = surface.get_capabilities(&adapter).formats;
        if let Some(&srgb) = formats.iter().find(|format| format.is_srgb()) {
            configuration.format = srgb;
        }
        surface.configure(&device, &configuration);

        let ours = Arc::new(Device::from_host(device.clone(), queue.clone())?);
        let options = HostOptions {
            mask: MaskSize::Source,
            ..Default::default()
        };
        let locator = HostLocator::new(ours, model, options)?;

        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("overlay"),
            source: wgpu::ShaderSource::Wgsl(
                (locator.wgsl() + include_str!("overlay.wgsl")).into(),
            ),
        });
        let layout = bind_group_layout(&device);
        let pipelines = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            bind_group_layouts: &[Some(&layout)],
            ..Default::default()
        });
        let pipeline = |vertex, fragment| {
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some(vertex),
                layout: Some(&pipelines),
                vertex: wgpu::VertexState {
                    module: &module,
                    entry_point: Some(vertex),
                    compilation_options: Default::default(),
                    buffers: &[],
                },
                primitive: Default::default(),
                depth_stencil: Some(wgpu::DepthStencilState {
                    format: DEPTH,
                    depth_write_enabled: Some(true),
                    depth_compare: Some(wgpu::CompareFunction::LessEqual),
                    stencil: Default::default(),
                    bias: Default::default(),
                }),
                multisample: Default::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &module,
                    entry_point: Some(fragment),
                    compilation_options: Default::default(),
                    targets: &[Some(configuration.format.into())],
                }),
                multiview_mask: None,
                cache: None,
            })
        };
        Ok(Self {
            depth: depth(&device, &configuration),
            picture_pipeline: pipeline("picture_vertex", "picture_fragment"),
            sphere_pipeline: pipeline("sphere_vertex", "sphere_fragment"),
            layout,
            sampler: device.create_sampler(&wgpu::SamplerDescriptor {
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                ..Default::default()
            }),
            view: device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("view"),
                size: size_of::<View>() as u64,
                usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            }),
            joints: model.description.joints.len() as u32,
            device,
            queue,
            surface,
            configuration,
            locator,
            shown: None,
            frame: 0,
            last: None,
        })
    }

    pub fn resize(&mut self, width: u32, height: u32) {
        // A window that is hidden has no pixels.
        if width > 0 && height > 0 {
            (self.configuration.width, self.configuration.height) = (width, height);
            self.surface.configure(&self.device, &self.configuration);
            self.depth = depth(&self.device, &self.configuration);
        }
    }

    /// Shows the next picture, of `camera`. A camera's driver would write the texture.
    pub fn show(&mut self, picture: &RgbaImage, camera: &Camera) -> Result<(), Box<dyn Error>> {
        let size = wgpu::Extent3d {
            width: picture.width(),
            height: picture.height(),
            depth_or_array_layers: 1,
        };
        let texture = match self.shown.take() {
            Some(shown) if shown.texture.size() == size => shown.texture,
            _ => self.camera_texture(size),
        };
        let layout = wgpu::TexelCopyBufferLayout {
            bytes_per_row: Some(4 * size.width),
            ..Default::default()
        };
        self.queue
            .write_texture(texture.as_image_copy(), picture, layout, size);

        let view = texture.create_view(&Default::default());
        self.locator
            .set_source(0, &Source::new(view.clone(), *camera))?;
        let content = View {
            projection: graphics::projection(camera, 0.05, 20.0).to_cols_array(),
            radius: 0.03,
            padding: [0.0; 3],
        };
        self.queue
            .write_buffer(&self.view, 0, bytemuck::bytes_of(&content));
        // Another camera may have got another mask.
        let mask = self.locator.mask(0).ok_or("no mask")?;
        let resources = [
            self.view.as_entire_binding(),
            wgpu::BindingResource::TextureView(&view),
            wgpu::BindingResource::TextureView(mask),
            wgpu::BindingResource::Sampler(&self.sampler),
            self.locator.estimates().as_entire_binding(),
        ];
        let entries: Vec<_> = (0..)
            .zip(resources)
            .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
            .collect();
        let bind_group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("overlay"),
            layout: &self.layout,
            entries: &entries,
        });
        self.shown = Some(Shown {
            texture,
            bind_group,
        });
        Ok(())
    }

    fn camera_texture(&self, size: wgpu::Extent3d) -> wgpu::Texture {
        self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("camera"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            // What is read is what is drawn: both linear, or both as they are encoded.
            format: if self.configuration.format.is_srgb() {
                wgpu::TextureFormat::Rgba8UnormSrgb
            } else {
                wgpu::TextureFormat::Rgba8Unorm
            },
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        })
    }

    /// One submission: both networks, then the picture with what they found.
    pub fn draw(&mut self, window: &Window) -> Result<(), Box<dyn Error>> {
        use wgpu::CurrentSurfaceTexture as Current;
        let Some(shown) = &self.shown else {
            return Ok(());
        };
        let target = match self.surface.get_current_texture() {
            Current::Success(target) | Current::Suboptimal(target) => target,
            Current::Timeout | Current::Occluded => return Ok(()),
            Current::Outdated | Current::Lost => {
                self.surface.configure(&self.device, &self.configuration);
                return Ok(());
            }
            Current::Validation => return Err("the window's surface is not valid".into()),
        };
        let colour = target.texture.create_view(&Default::default());
        let mut encoder = self.device.create_command_encoder(&Default::default());
        self.locator.encode(&mut encoder)?;
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("overlay"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &colour,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                    store: wgpu::StoreOp::Store,
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &self.depth,
                depth_ops: Some(wgpu::Operations {
                    load: wgpu::LoadOp::Clear(1.0),
                    store: wgpu::StoreOp::Discard,
                }),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        // The whole picture, as large as it fits.
        let [width, height] =
            [self.configuration.width, self.configuration.height].map(|v| v as f32);
        let picture = shown.texture.size();
        let [columns, rows] = [picture.width, picture.height].map(|v| v as f32);
        let scale = (width / columns).min(height / rows);
        let [fit_width, fit_height] = [columns * scale, rows * scale];
        let [left, top] = [0.5 * (width - fit_width), 0.5 * (height - fit_height)];
        pass.set_viewport(left, top, fit_width, fit_height, 0.0, 1.0);
        pass.set_bind_group(0, &shown.bind_group, &[]);
        pass.set_pipeline(&self.picture_pipeline);
        pass.draw(0..3, 0..1);
        pass.set_pipeline(&self.sphere_pipeline);
        pass.draw(0..SPHERE_VERTICES, 0..self.joints);
        drop(pass);
        // For the window's title alone.
        self.frame += 1;
        self.locator.read_back(&mut encoder, self.frame)?;
        self.queue.submit([encoder.finish()]);
        window.pre_present_notify();
        self.queue.present(target);
        if let Some(mut located) = self.locator.latest()? {
            self.last = located.estimates.pop();
        }
        Ok(())
    }

    /// What the last frame that came back says.
    pub fn status(&self) -> &'static str {
        match self.last.as_ref().map(|estimate| estimate.status) {
            Some(Status::Found) => "robot found",
            Some(Status::NotFound) => "no robot",
            Some(Status::Invalid) => "invalid",
            None => "starting",
        }
    }
}

fn bind_group_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let buffer = |ty| wgpu::BindingType::Buffer {
        ty,
        has_dynamic_offset: false,
        min_binding_size: None,
    };
    let texture = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: true },
        view_dimension: wgpu::TextureViewDimension::D2,
        multisampled: false,
    };
    let types = [
        buffer(wgpu::BufferBindingType::Uniform),
        texture,
        texture,
        wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering),
        buffer(wgpu::BufferBindingType::Storage { read_only: true }),
    ];
    let entries: Vec<_> = (0..)
        .zip(types)
        .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::VERTEX_FRAGMENT,
            ty,
            count: None,
        })
        .collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("overlay"),
        entries: &entries,
    })
}

fn depth(device: &wgpu::Device, configuration: &wgpu::SurfaceConfiguration) -> wgpu::TextureView {
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("depth"),
        size: wgpu::Extent3d {
            width: configuration.width,
            height: configuration.height,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: DEPTH,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    texture.create_view(&Default::default())
}
