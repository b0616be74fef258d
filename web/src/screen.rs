use wasm_bindgen::JsError;
use web_sys::HtmlCanvasElement;
use wgpu::CurrentSurfaceTexture;

/// What the robot is tinted with, red, green and blue in [0, 1], and how much of it.
pub const TINT: [f32; 3] = [0.0, 0.86, 0.43];
pub const STRENGTH: f32 = 0.5;

/// Draws pictures on a canvas, tinted by their masks.
pub struct Screen {
    device: wgpu::Device,
    surface: wgpu::Surface<'static>,
    format: wgpu::TextureFormat,
    size: [u32; 2],
    pipeline: wgpu::RenderPipeline,
}

impl Screen {
    /// `format` is the one that the browser prefers: `bgra8unorm` or `rgba8unorm`.
    pub fn new(
        device: &wgpu::Device,
        canvas: HtmlCanvasElement,
        format: &str,
    ) -> Result<Self, JsError> {
        let format = match format {
            "bgra8unorm" => wgpu::TextureFormat::Bgra8Unorm,
            _ => wgpu::TextureFormat::Rgba8Unorm,
        };
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let surface = instance.create_surface(wgpu::SurfaceTarget::Canvas(canvas))?;
        let module = device.create_shader_module(wgpu::include_wgsl!("tint.wgsl"));
        let [red, green, blue] = TINT.map(f64::from);
        let constants = [
            ("RED", red),
            ("GREEN", green),
            ("BLUE", blue),
            ("STRENGTH", STRENGTH.into()),
        ];
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("tint"),
            layout: None,
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("cover"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: Default::default(),
            depth_stencil: None,
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("tint"),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &constants,
                    ..Default::default()
                },
                targets: &[Some(format.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        Ok(Self {
            device: device.clone(),
            surface,
            format,
            size: [0, 0],
            pipeline,
        })
    }

    /// Records that the canvas shows `picture`, whose robot is `mask`, both of one size. What it answers is
    /// to be presented after the submission.
    pub fn draw(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        picture: &wgpu::TextureView,
        mask: &wgpu::TextureView,
    ) -> Result<wgpu::SurfaceTexture, JsError> {
        let size = [picture.texture().width(), picture.texture().height()];
        if size != self.size {
            self.size = size;
            self.surface.configure(
                &self.device,
                &wgpu::SurfaceConfiguration {
                    usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
                    format: self.format,
                    color_space: Default::default(),
                    width: size[0],
                    height: size[1],
                    present_mode: wgpu::PresentMode::Fifo,
                    desired_maximum_frame_latency: 2,
                    alpha_mode: wgpu::CompositeAlphaMode::Opaque,
                    view_formats: Vec::new(),
                },
            );
        }
        let (CurrentSurfaceTexture::Success(target) | CurrentSurfaceTexture::Suboptimal(target)) =
            self.surface.get_current_texture()
        else {
            return Err(JsError::new("the canvas cannot be drawn on"));
        };
        let bind_group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("tint"),
            layout: &self.pipeline.get_bind_group_layout(0),
            entries: &[(0, picture), (1, mask)].map(|(binding, view)| wgpu::BindGroupEntry {
                binding,
                resource: wgpu::BindingResource::TextureView(view),
            }),
        });
        let view = target.texture.create_view(&Default::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("tint"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                    store: wgpu::StoreOp::Store,
                },
            })],
            ..Default::default()
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bind_group, &[]);
        pass.draw(0..3, 0..1);
        drop(pass);
        Ok(target)
    }
}
