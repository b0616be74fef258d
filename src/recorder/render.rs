//! Draws scenes with wgpu: a colour picture and where the robot is visible in it.

use bytemuck::{Pod, Zeroable};
use glam::{DAffine3, DVec3, Mat4, Vec3, Vec4};
use wgpu::util::DeviceExt;

use super::picture::Picture;
use super::scene::{Item, Kind, Scene};
use super::{HEIGHT, INTRINSICS, RecorderError, WIDTH};
use crate::gpu::{Device, GpuError};
use crate::robot::Mesh;

const SAMPLES: u32 = 4;
const COLOUR: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
const ROBOT: wgpu::TextureFormat = wgpu::TextureFormat::R8Unorm;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
const SHADOW_EDGE: u32 = 768;
/// Half the edge of the square that the shadow map covers, metres.
const SHADOW_REACH: f32 = 1.5;
/// Nearest and farthest distance drawn, metres.
const NEAR: f64 = 0.05;
const FAR: f64 = 30.0;

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Vertex {
    position: [f32; 3],
    normal: [f32; 3],
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Instance {
    rows: [[f32; 4]; 3],
    albedo: [f32; 4],
    finish: [f32; 4],
    texture: [f32; 4],
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct View {
    clip_from_camera: [[f32; 4]; 4],
    shadow_from_camera: [[f32; 4]; 4],
    up: [f32; 4],
    sky: [f32; 4],
    ground: [f32; 4],
    light_direction: [[f32; 4]; 3],
    light_colour: [[f32; 4]; 3],
    mirrored: [[f32; 4]; 3],
}

/// The most items that one scene may hold.
const ITEMS: usize = 4096;

struct Range {
    first_index: u32,
    indices: u32,
    first_vertex: i32,
}

/// Draws scenes made of a fixed set of meshes.
pub struct Renderer<'a> {
    device: &'a Device,
    ranges: Vec<Range>,
    vertices: wgpu::Buffer,
    indices: wgpu::Buffer,
    instances: wgpu::Buffer,
    view: wgpu::Buffer,
    readback: wgpu::Buffer,
    photos: wgpu::Texture,
    colour: Target,
    robot: Target,
    depth: wgpu::TextureView,
    shadow: wgpu::TextureView,
    scene_group: wgpu::BindGroup,
    shadow_group: wgpu::BindGroup,
    background_pipeline: wgpu::RenderPipeline,
    object_pipeline: wgpu::RenderPipeline,
    overlay_pipeline: wgpu::RenderPipeline,
    shadow_pipeline: wgpu::RenderPipeline,
}

struct Target {
    multisampled: wgpu::TextureView,
    resolved: wgpu::Texture,
    resolved_view: wgpu::TextureView,
}

impl<'a> Renderer<'a> {
    /// Makes pipelines and buffers for scenes whose items refer to `meshes` by their position.
    ///
    /// # Errors
    /// The device rejects a pipeline or a buffer.
    pub fn new(device: &'a Device, meshes: &[Mesh]) -> Result<Renderer<'a>, RecorderError> {
        Ok(device.scoped(|| Ok(Self::build(device, meshes)))?)
    }

    fn build(owner: &'a Device, meshes: &[Mesh]) -> Renderer<'a> {
        let device = owner.wgpu();
        let mut vertices = Vec::new();
        let mut indices: Vec<u32> = Vec::new();
        let mut ranges = Vec::new();
        for mesh in meshes {
            ranges.push(Range {
                first_index: indices.len() as u32,
                indices: mesh.indices.len() as u32,
                first_vertex: vertices.len() as i32,
            });
            indices.extend(&mesh.indices);
            let pairs = mesh.positions.iter().zip(&mesh.normals);
            vertices.extend(pairs.map(|(&position, &normal)| Vertex { position, normal }));
        }
        let fixed = |label, contents: &[u8], usage| {
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some(label),
                contents,
                usage,
            })
        };
        let buffer = |label, size: usize, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: size as u64,
                usage,
                mapped_at_creation: false,
            })
        };
        let vertices = fixed(
            "meshes' vertices",
            bytemuck::cast_slice(&vertices),
            wgpu::BufferUsages::VERTEX,
        );
        let indices = fixed(
            "meshes' indices",
            bytemuck::cast_slice(&indices),
            wgpu::BufferUsages::INDEX,
        );
        let instances = buffer(
            "items",
            ITEMS * size_of::<Instance>(),
            wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
        );
        let view = buffer(
            "view",
            size_of::<View>(),
            wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
        );
        let pixels = (WIDTH * HEIGHT) as usize;
        let readback = buffer(
            "picture",
            pixels * 5,
            wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        );

        let texture = |label, width, height, layers, samples, format, usage| {
            device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d {
                    width,
                    height,
                    depth_or_array_layers: layers,
                },
                mip_level_count: 1,
                sample_count: samples,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage,
                view_formats: &[],
            })
        };
        let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let target = |format| {
            let resolved = texture(
                "resolved",
                WIDTH,
                HEIGHT,
                1,
                1,
                format,
                attachment | wgpu::TextureUsages::COPY_SRC,
            );
            Target {
                multisampled: texture(
                    "multisampled",
                    WIDTH,
                    HEIGHT,
                    1,
                    SAMPLES,
                    format,
                    attachment,
                )
                .create_view(&Default::default()),
                resolved_view: resolved.create_view(&Default::default()),
                resolved,
            }
        };
        let colour = target(COLOUR);
        let robot = target(ROBOT);
        let depth = texture("depth", WIDTH, HEIGHT, 1, SAMPLES, DEPTH, attachment)
            .create_view(&Default::default());
        let sampled = wgpu::TextureUsages::TEXTURE_BINDING;
        let shadow = texture(
            "shadow map",
            SHADOW_EDGE,
            SHADOW_EDGE,
            1,
            1,
            DEPTH,
            attachment | sampled,
        )
        .create_view(&Default::default());
        let photos = texture(
            "photos",
            WIDTH,
            HEIGHT,
            2,
            1,
            COLOUR,
            sampled | wgpu::TextureUsages::COPY_DST,
        );
        let photos_view = photos.create_view(&wgpu::TextureViewDescriptor {
            dimension: Some(wgpu::TextureViewDimension::D2Array),
            ..Default::default()
        });
        let photo_sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("photos"),
            address_mode_u: wgpu::AddressMode::MirrorRepeat,
            address_mode_v: wgpu::AddressMode::MirrorRepeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        });
        let shadow_sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("shadow map"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            compare: Some(wgpu::CompareFunction::LessEqual),
            ..Default::default()
        });

        let entry = |binding, visibility, ty| wgpu::BindGroupLayoutEntry {
            binding,
            visibility,
            ty,
            count: None,
        };
        let uniform = wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Uniform,
            has_dynamic_offset: false,
            min_binding_size: None,
        };
        let sampled = |sample_type, view_dimension| wgpu::BindingType::Texture {
            sample_type,
            view_dimension,
            multisampled: false,
        };
        let fragment = wgpu::ShaderStages::FRAGMENT;
        let shadow_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("shadow pass"),
            entries: &[entry(0, wgpu::ShaderStages::VERTEX, uniform)],
        });
        let scene_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("scene pass"),
            entries: &[
                entry(0, wgpu::ShaderStages::VERTEX_FRAGMENT, uniform),
                entry(
                    1,
                    fragment,
                    sampled(
                        wgpu::TextureSampleType::Float { filterable: true },
                        wgpu::TextureViewDimension::D2Array,
                    ),
                ),
                entry(
                    2,
                    fragment,
                    wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering),
                ),
                entry(
                    3,
                    fragment,
                    sampled(
                        wgpu::TextureSampleType::Depth,
                        wgpu::TextureViewDimension::D2,
                    ),
                ),
                entry(
                    4,
                    fragment,
                    wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Comparison),
                ),
            ],
        });
        let bound = |binding, resource| wgpu::BindGroupEntry { binding, resource };
        let shadow_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("shadow pass"),
            layout: &shadow_layout,
            entries: &[bound(0, view.as_entire_binding())],
        });
        let scene_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("scene pass"),
            layout: &scene_layout,
            entries: &[
                bound(0, view.as_entire_binding()),
                bound(1, wgpu::BindingResource::TextureView(&photos_view)),
                bound(2, wgpu::BindingResource::Sampler(&photo_sampler)),
                bound(3, wgpu::BindingResource::TextureView(&shadow)),
                bound(4, wgpu::BindingResource::Sampler(&shadow_sampler)),
            ],
        });

        let shader = device.create_shader_module(wgpu::include_wgsl!("../../shaders/render.wgsl"));
        let pipelines = Pipelines {
            device,
            shader: &shader,
        };
        let all = wgpu::ColorWrites::ALL;
        let none = wgpu::ColorWrites::empty();
        Renderer {
            background_pipeline: pipelines.scene(&scene_layout, "background", false, all),
            object_pipeline: pipelines.scene(&scene_layout, "object", true, all),
            overlay_pipeline: pipelines.scene(&scene_layout, "object", true, none),
            shadow_pipeline: pipelines.shadow(&shadow_layout),
            device: owner,
            ranges,
            vertices,
            indices,
            instances,
            view,
            readback,
            photos,
            colour,
            robot,
            depth,
            shadow,
            scene_group,
            shadow_group,
        }
    }

    /// Draws a scene. `background` and `texture` are RGBA pictures of `WIDTH` x `HEIGHT`: what is behind
    /// everything, and what textured surfaces show.
    ///
    /// # Errors
    /// The scene has more items than fit, a photo has another size, or the device fails or does not
    /// answer in time.
    pub fn draw(
        &mut self,
        scene: &Scene,
        background: &[u8],
        texture: Option<&[u8]>,
    ) -> Result<Picture, RecorderError> {
        let (device, queue) = (self.device.wgpu(), self.device.queue());
        self.device
            .require("items in a scene", scene.items.len() as u64, ITEMS as u64)?;
        for (layer, photo) in [Some(background), texture].into_iter().enumerate() {
            let Some(photo) = photo else { continue };
            let expected = (4 * WIDTH * HEIGHT) as usize;
            if photo.len() != expected {
                let found = photo.len();
                return Err(GpuError::Size {
                    what: "photo",
                    expected,
                    found,
                }
                .into());
            }
            queue.write_texture(
                wgpu::TexelCopyTextureInfo {
                    texture: &self.photos,
                    mip_level: 0,
                    origin: wgpu::Origin3d {
                        x: 0,
                        y: 0,
                        z: layer as u32,
                    },
                    aspect: wgpu::TextureAspect::All,
                },
                photo,
                wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(4 * WIDTH),
                    rows_per_image: Some(HEIGHT),
                },
                wgpu::Extent3d {
                    width: WIDTH,
                    height: HEIGHT,
                    depth_or_array_layers: 1,
                },
            );
        }
        queue.write_buffer(&self.view, 0, bytemuck::bytes_of(&view(scene)));
        let instances: Vec<Instance> = scene
            .items
            .iter()
            .map(|item| instance(scene.camera_from_base, item))
            .collect();
        queue.write_buffer(&self.instances, 0, bytemuck::cast_slice(&instances));

        let mut encoder = device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("shadow"),
                depth_stencil_attachment: Some(depth_attachment(
                    &self.shadow,
                    wgpu::StoreOp::Store,
                )),
                ..Default::default()
            });
            pass.set_pipeline(&self.shadow_pipeline);
            pass.set_bind_group(0, &self.shadow_group, &[]);
            self.draw_items(&mut pass, scene, |kind| kind.casts_shadow());
        }
        {
            let attachment = |target| {
                let Target {
                    multisampled,
                    resolved_view,
                    ..
                }: &Target = target;
                Some(wgpu::RenderPassColorAttachment {
                    view: multisampled,
                    depth_slice: None,
                    resolve_target: Some(resolved_view),
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                        store: wgpu::StoreOp::Discard,
                    },
                })
            };
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("scene"),
                color_attachments: &[attachment(&self.colour), attachment(&self.robot)],
                depth_stencil_attachment: Some(depth_attachment(
                    &self.depth,
                    wgpu::StoreOp::Discard,
                )),
                ..Default::default()
            });
            pass.set_bind_group(0, &self.scene_group, &[]);
            // Mostly front to back, so that hidden pixels cost little.
            pass.set_pipeline(&self.object_pipeline);
            for drawn in [Kind::Robot, Kind::Scenery, Kind::Surface] {
                self.draw_items(&mut pass, scene, |kind| kind == drawn);
            }
            pass.set_pipeline(&self.overlay_pipeline);
            self.draw_items(&mut pass, scene, |kind| kind == Kind::Cable);
            pass.set_pipeline(&self.background_pipeline);
            pass.draw(0..3, 0..1);
        }
        let pixels = u64::from(WIDTH * HEIGHT);
        for (target, offset, bytes) in [(&self.colour, 0, 4), (&self.robot, 4 * pixels, 1)] {
            encoder.copy_texture_to_buffer(
                target.resolved.as_image_copy(),
                wgpu::TexelCopyBufferInfo {
                    buffer: &self.readback,
                    layout: wgpu::TexelCopyBufferLayout {
                        offset,
                        bytes_per_row: Some(bytes * WIDTH),
                        rows_per_image: Some(HEIGHT),
                    },
                },
                wgpu::Extent3d {
                    width: WIDTH,
                    height: HEIGHT,
                    depth_or_array_layers: 1,
                },
            );
        }
        queue.submit([encoder.finish()]);

        Ok(self.device.read(&self.readback, |bytes| {
            let (colour, robot) = bytes.split_at(4 * pixels as usize);
            let colour = colour.as_chunks::<4>().0;
            Picture {
                rgb: colour.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect(),
                mask: robot
                    .iter()
                    .map(|&c| if c >= 128 { 255 } else { 0 })
                    .collect(),
            }
        })?)
    }

    fn draw_items(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        scene: &Scene,
        drawn: impl Fn(Kind) -> bool,
    ) {
        pass.set_vertex_buffer(0, self.vertices.slice(..));
        pass.set_vertex_buffer(1, self.instances.slice(..));
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        for (i, item) in scene.items.iter().enumerate() {
            let Some(range) = self.ranges.get(item.mesh).filter(|_| drawn(item.kind)) else {
                continue;
            };
            let i = i as u32;
            let indices = range.first_index..range.first_index + range.indices;
            pass.draw_indexed(indices, range.first_vertex, i..i + 1);
        }
    }
}

fn depth_attachment(
    view: &wgpu::TextureView,
    store: wgpu::StoreOp,
) -> wgpu::RenderPassDepthStencilAttachment<'_> {
    wgpu::RenderPassDepthStencilAttachment {
        view,
        depth_ops: Some(wgpu::Operations {
            load: wgpu::LoadOp::Clear(1.0),
            store,
        }),
        stencil_ops: None,
    }
}

struct Pipelines<'a> {
    device: &'a wgpu::Device,
    shader: &'a wgpu::ShaderModule,
}

impl Pipelines<'_> {
    fn make(
        &self,
        layout: &wgpu::BindGroupLayout,
        vertex_entry: &str,
        buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
        depth: wgpu::DepthStencilState,
        samples: u32,
        fragment: Option<wgpu::FragmentState<'_>>,
    ) -> wgpu::RenderPipeline {
        let layout = self
            .device
            .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(vertex_entry),
                bind_group_layouts: &[Some(layout)],
                immediate_size: 0,
            });
        self.device
            .create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some(vertex_entry),
                layout: Some(&layout),
                vertex: wgpu::VertexState {
                    module: self.shader,
                    entry_point: Some(vertex_entry),
                    compilation_options: Default::default(),
                    buffers,
                },
                primitive: Default::default(),
                depth_stencil: Some(depth),
                multisample: wgpu::MultisampleState {
                    count: samples,
                    ..Default::default()
                },
                fragment,
                multiview_mask: None,
                cache: None,
            })
    }

    fn scene(
        &self,
        layout: &wgpu::BindGroupLayout,
        entry: &str,
        is_object: bool,
        mask_writes: wgpu::ColorWrites,
    ) -> wgpu::RenderPipeline {
        let compare = if is_object {
            wgpu::CompareFunction::Less
        } else {
            wgpu::CompareFunction::LessEqual
        };
        let target = |format, write_mask| {
            Some(wgpu::ColorTargetState {
                format,
                blend: None,
                write_mask,
            })
        };
        let targets = [
            target(COLOUR, wgpu::ColorWrites::ALL),
            target(ROBOT, mask_writes),
        ];
        let fragment_entry = format!("{entry}_fragment");
        let fragment = wgpu::FragmentState {
            module: self.shader,
            entry_point: Some(&fragment_entry),
            compilation_options: Default::default(),
            targets: &targets,
        };
        let buffers = if is_object {
            object_buffers().to_vec()
        } else {
            Vec::new()
        };
        let depth = depth_state(compare, is_object, 0);
        self.make(
            layout,
            &format!("{entry}_vertex"),
            &buffers,
            depth,
            SAMPLES,
            Some(fragment),
        )
    }

    fn shadow(&self, layout: &wgpu::BindGroupLayout) -> wgpu::RenderPipeline {
        let depth = depth_state(wgpu::CompareFunction::Less, true, 2);
        self.make(layout, "shadow_vertex", &object_buffers(), depth, 1, None)
    }
}

fn depth_state(compare: wgpu::CompareFunction, write: bool, bias: i32) -> wgpu::DepthStencilState {
    wgpu::DepthStencilState {
        format: DEPTH,
        depth_write_enabled: Some(write),
        depth_compare: Some(compare),
        stencil: Default::default(),
        bias: wgpu::DepthBiasState {
            constant: bias,
            slope_scale: bias as f32,
            clamp: 0.0,
        },
    }
}

const VERTEX: [wgpu::VertexAttribute; 2] = wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3];
const INSTANCE: [wgpu::VertexAttribute; 6] = wgpu::vertex_attr_array![
    2 => Float32x4, 3 => Float32x4, 4 => Float32x4, 5 => Float32x4, 6 => Float32x4, 7 => Float32x4
];

fn object_buffers() -> [Option<wgpu::VertexBufferLayout<'static>>; 2] {
    [
        Some(wgpu::VertexBufferLayout {
            array_stride: size_of::<Vertex>() as u64,
            step_mode: wgpu::VertexStepMode::Vertex,
            attributes: &VERTEX,
        }),
        Some(wgpu::VertexBufferLayout {
            array_stride: size_of::<Instance>() as u64,
            step_mode: wgpu::VertexStepMode::Instance,
            attributes: &INSTANCE,
        }),
    ]
}

fn instance(camera_from_base: DAffine3, item: &Item) -> Instance {
    let pose = camera_from_base * item.base_from_mesh;
    let rotation = pose.matrix3.transpose();
    let row = |axis: DVec3, shift: f64| axis.as_vec3().extend(shift as f32).to_array();
    let material = &item.material;
    let [r, g, b] = material.albedo;
    let robot = if item.kind == Kind::Robot { 1.0 } else { 0.0 };
    Instance {
        rows: [
            row(rotation.x_axis, pose.translation.x),
            row(rotation.y_axis, pose.translation.y),
            row(rotation.z_axis, pose.translation.z),
        ],
        albedo: [r, g, b, robot],
        finish: [
            material.metal,
            material.specular,
            material.shininess,
            material.photo,
        ],
        texture: [
            material.photo_offset[0],
            material.photo_offset[1],
            material.photo_scale,
            0.0,
        ],
    }
}

/// Clip coordinates of points in the camera optical frame. Pixel (0, 0)'s centre is half a pixel inside
/// the picture's corner, hence the halves.
fn clip_from_camera() -> Mat4 {
    let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
    let k = INTRINSICS;
    let depth = FAR / (FAR - NEAR);
    let column = |x: f64, y: f64, z: f64, w: f64| Vec4::new(x as f32, y as f32, z as f32, w as f32);
    Mat4::from_cols(
        column(2.0 * k.fx / width, 0.0, 0.0, 0.0),
        column(0.0, -2.0 * k.fy / height, 0.0, 0.0),
        column(
            2.0 * (k.cx + 0.5) / width - 1.0,
            1.0 - 2.0 * (k.cy + 0.5) / height,
            depth,
            1.0,
        ),
        column(0.0, 0.0, -NEAR * depth, 0.0),
    )
}

fn view(scene: &Scene) -> View {
    let light = &scene.lighting;
    let turn = |v: DVec3| scene.camera_from_base.transform_vector3(v).as_vec3();
    let four = |v: Vec3, w: f32| v.extend(w).to_array();
    let directions = light.lamps.each_ref().map(|lamp| turn(lamp.direction));

    let towards = directions[0];
    let side = towards.any_orthonormal_vector();
    let other = towards.cross(side);
    let centre = scene
        .camera_from_base
        .transform_point3(scene.centre)
        .as_vec3();
    let scale = 0.5 / SHADOW_REACH;
    let row = |axis: Vec3, scale: f32| (axis * scale).extend(0.5 - axis.dot(centre) * scale);
    // Far from the light is deep; objects up to 4 m before and behind the centre are told apart.
    let shadow = Mat4::from_cols(
        row(side, scale),
        row(other, scale),
        row(-towards, 0.125),
        Vec4::W,
    );

    View {
        clip_from_camera: clip_from_camera().to_cols_array_2d(),
        shadow_from_camera: shadow.transpose().to_cols_array_2d(),
        up: four(
            turn(DVec3::Z),
            -turn(DVec3::Z).dot(scene.camera_from_base.translation.as_vec3()),
        ),
        sky: four(light.sky.into(), 0.0),
        ground: four(light.ground.into(), 0.0),
        light_direction: [
            four(directions[0], light.shadow),
            four(directions[1], 0.0),
            four(directions[2], 0.0),
        ],
        light_colour: light
            .lamps
            .each_ref()
            .map(|lamp| four(lamp.colour.into(), 0.0)),
        mirrored: light.mirrored.map(|(wave, phase)| four(turn(wave), phase)),
    }
}
