//! The engine in a host's device: nothing behind its back, answers as on our own, typed errors.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::common::{ORIENTATIONS, description, difference, joints, model_file, noise};
use image::{DynamicImage, Rgba, RgbaImage};
use whereabot::camera::{Camera, Crop, Orientation, Unrectification};
use whereabot::cascade::{
    Estimate, HostLocator, HostOptions, LocateError, Located, Locator, MaskSize, Output, Source,
    Status,
};
use whereabot::gpu::{Device, GpuError, Planes, Tier, Yuv};
use whereabot::network::{Model, Shape};
use whereabot::reference;

/// Drivers on a busy CPU take their time to compile.
const PATIENCE: Duration = Device::TIMEOUT;
const WIDTH: u32 = 61;
const HEIGHT: u32 = 47;

/// A program with a device of its own: no features, WebGPU's default limits.
struct Host {
    device: wgpu::Device,
    queue: wgpu::Queue,
}

impl Host {
    fn new() -> Self {
        Self::with(wgpu::Features::empty(), wgpu::Limits::default()).unwrap()
    }

    /// With `features` as far as the adapter has them.
    fn with(
        features: wgpu::Features,
        required_limits: wgpu::Limits,
    ) -> Result<Self, wgpu::RequestDeviceError> {
        let instance =
            wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
        let adapter = pollster::block_on(instance.request_adapter(&Default::default()))
            .expect("an adapter is needed: install mesa-vulkan-drivers");
        let (device, queue) =
            pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
                required_features: features & adapter.features(),
                required_limits,
                ..Default::default()
            }))?;
        Ok(Self { device, queue })
    }

    fn ours(&self) -> Arc<Device> {
        Arc::new(Device::from_host(self.device.clone(), self.queue.clone()).unwrap())
    }

    fn locator(&self, model: &Model) -> HostLocator {
        HostLocator::new(self.ours(), model, HostOptions::default()).unwrap()
    }

    fn texture(
        &self,
        format: wgpu::TextureFormat,
        [width, height]: [u32; 2],
        data: &[u8],
    ) -> wgpu::TextureView {
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        self.texture_for(format, [width, height], data, usage)
    }

    fn texture_for(
        &self,
        format: wgpu::TextureFormat,
        [width, height]: [u32; 2],
        data: &[u8],
        usage: wgpu::TextureUsages,
    ) -> wgpu::TextureView {
        let texture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("camera"),
            size: wgpu::Extent3d {
                width,
                height,
                depth_or_array_layers: 1,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        });
        if !data.is_empty() {
            self.queue.write_texture(
                texture.as_image_copy(),
                data,
                wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(data.len() as u32 / height),
                    rows_per_image: None,
                },
                texture.size(),
            );
        }
        texture.create_view(&Default::default())
    }

    fn rgba(&self, image: &RgbaImage) -> wgpu::TextureView {
        let (width, height) = image.dimensions();
        self.texture(wgpu::TextureFormat::Rgba8Unorm, [width, height], image)
    }

    /// A frame as a host makes it: encode, submit, and later ask.
    fn run(&self, locator: &mut HostLocator) -> Located {
        let mut encoder = self.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        assert!(locator.read_back(&mut encoder, 1).unwrap());
        self.queue.submit([encoder.finish()]);
        locator.wait(PATIENCE).unwrap().unwrap()
    }

    /// Makes `encoder` one whose submission is refused.
    fn spoil(&self, encoder: &mut wgpu::CommandEncoder) {
        // Something of the host's, that it may not clear.
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: 4,
            usage: wgpu::BufferUsages::UNIFORM,
            mapped_at_creation: false,
        });
        encoder.clear_buffer(&buffer, 0, None);
    }

    fn bytes(&self, buffer: &wgpu::Buffer) -> Vec<u8> {
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: buffer.size(),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, buffer.size());
        self.queue.submit([encoder.finish()]);
        self.ours().read(&staging, <[u8]>::to_vec).unwrap()
    }

    /// The values of a texture of r8unorm.
    fn values(&self, view: &wgpu::TextureView) -> Vec<f32> {
        let size = view.texture().size();
        let row = size
            .width
            .next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: u64::from(row * size.height),
            usage: wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.copy_texture_to_buffer(
            view.texture().as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &buffer,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(row),
                    rows_per_image: None,
                },
            },
            size,
        );
        self.queue.submit([encoder.finish()]);
        let bytes = self.bytes(&buffer);
        let rows = bytes.chunks_exact(row as usize);
        rows.flat_map(|r| &r[..size.width as usize])
            .map(|&v| f32::from(v) / 255.0)
            .collect()
    }
}

fn camera(width: u32, height: u32) -> Camera {
    Camera::from_hfov(width, height, 1.2)
}

fn picture(seed: u64) -> RgbaImage {
    let grain = noise((WIDTH * HEIGHT) as usize, seed);
    RgbaImage::from_fn(WIDTH, HEIGHT, |x, y| {
        let wave =
            |f: f32| 120.0 + 90.0 * (seed as f32 * 2.0 + x as f32 * f + y as f32 * 0.11).sin();
        let g = 15.0 * grain[(y * WIDTH + x) as usize];
        Rgba([wave(0.05) + g, wave(0.21) + g, wave(0.13) + g, 255.0].map(|v| v as u8))
    })
}

/// A random model that finds a robot in `picture`, at any place of its network's output.
fn model() -> Model {
    let mut description = description(48, 40, 5);
    description["presence"]["min_sure"] = 0.0.into();
    (1..100)
        .map(|seed| Model::from_bytes(&model_file(&description, seed), "random").unwrap())
        .find(|model| {
            [1, 2, 3]
                .iter()
                .all(|&seed| expected(model, &picture(seed)).status == Status::Found)
        })
        .unwrap()
}

fn expected(model: &Model, image: &RgbaImage) -> Estimate {
    let (width, height) = image.dimensions();
    let output = Output {
        mask: true,
        mask_only: false,
    };
    Locator::on_cpu(model)
        .locate(image, &camera(width, height), output)
        .unwrap()
}

/// Within 0.1 mm.
fn agree(found: &Estimate, expected: &Estimate) -> bool {
    found.status == expected.status
        && found.joints.len() == expected.joints.len()
        && difference(&joints(found), &joints(expected)).unwrap() <= 1e-4
}

thread_local! {
    static SUBMISSIONS: Cell<usize> = const { Cell::new(0) };
    static READBACKS: Cell<usize> = const { Cell::new(0) };
}

/// Counts, in each thread, what wgpu says that it is asked for.
struct Counter;

impl log::Log for Counter {
    fn enabled(&self, _: &log::Metadata<'_>) -> bool {
        true
    }

    fn log(&self, record: &log::Record<'_>) {
        let text = record.args().to_string();
        if text.starts_with("Queue::submit returned") {
            SUBMISSIONS.set(SUBMISSIONS.get() + 1);
        } else if text.starts_with("Buffer::get_mapped_range") {
            READBACKS.set(READBACKS.get() + 1);
        }
    }

    fn flush(&self) {}
}

#[test]
fn nothing_is_submitted_or_read_back_behind_the_host_s_back() {
    log::set_logger(&Counter).unwrap();
    log::set_max_level(log::LevelFilter::Trace);
    let counts = || (SUBMISSIONS.get(), READBACKS.get());
    let (host, model) = (Host::new(), model());
    let view = host.rgba(&picture(1));
    let before = counts();
    let mut locator = host.locator(&model);
    for frame in 0..3 {
        locator
            .set_source(0, &Source::new(view.clone(), camera(WIDTH, HEIGHT)))
            .unwrap();
        let mut encoder = host.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        locator.read_back(&mut encoder, frame).unwrap();
        assert_eq!(counts(), (before.0 + frame as usize, before.1));
        host.queue.submit([encoder.finish()]);
        assert_eq!(counts(), (before.0 + frame as usize + 1, before.1));
    }
    // Negative control: what comes back is counted.
    locator.wait(PATIENCE).unwrap().unwrap();
    while counts().1 < before.1 + 3 {
        locator.wait(PATIENCE).unwrap();
    }
    assert_eq!(counts(), (before.0 + 3, before.1 + 3));
}

#[test]
fn the_answers_are_those_of_our_own_device() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    for seed in [1, 2, 3] {
        let image = picture(seed);
        locator
            .set_source(0, &Source::new(host.rgba(&image), camera(WIDTH, HEIGHT)))
            .unwrap();
        let found = host.run(&mut locator);
        let expected = expected(&model, &image);
        assert!(agree(&found.estimates[0], &expected), "{found:?}");
        let mask = host.values(locator.mask(0).unwrap());
        let probabilities = &expected.mask.as_ref().unwrap().probability;
        assert!(difference(&mask, probabilities).unwrap() < 0.51 / 255.0 + 1e-4);
        // Negative control: another picture's.
        let other = self::expected(&model, &picture(seed + 1));
        assert!(!agree(&found.estimates[0], &other));
        let wrong = difference(&mask, &other.mask.unwrap().probability).unwrap();
        assert!(wrong > 0.02, "{wrong}");
    }
}

#[test]
fn what_the_host_enabled_is_used_and_none_of_it_is_needed() {
    use wgpu::Features as F;
    let model = model();
    for wanted in [F::empty(), F::SUBGROUP | F::SHADER_F16 | F::PIPELINE_CACHE] {
        let host = Host::with(wanted, wgpu::Limits::default()).unwrap();
        let has = |feature| host.device.features().contains(feature);
        let ours = host.ours();
        assert_eq!(ours.tier() > Tier::Baseline, has(F::SHADER_F16));
        assert_eq!(ours.subgroup_size().is_some(), has(F::SUBGROUP));
        assert_eq!(ours.pipeline_cache().is_some(), has(F::PIPELINE_CACHE));
        let mut locator = HostLocator::new(ours, &model, HostOptions::default()).unwrap();
        let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
        locator.set_source(0, &source).unwrap();
        let found = host.run(&mut locator);
        assert!(agree(&found.estimates[0], &expected(&model, &picture(1))));
    }
}

#[test]
fn a_part_of_a_turned_texture_is_what_it_is_upright() {
    let (host, model) = (Host::new(), model());
    let stored = picture(1);
    let view = host.rgba(&stored);
    let crop = Crop {
        x: 7,
        y: 3,
        width: 50,
        height: 41,
    };
    let part = image::imageops::crop_imm(&stored, 7, 3, 50, 41).to_image();
    let options = HostOptions {
        mask: MaskSize::Source,
        ..Default::default()
    };
    let mut locator = HostLocator::new(host.ours(), &model, options).unwrap();
    let mut first: Option<Vec<f32>> = None;
    for orientation in ORIENTATIONS {
        let mut upright = DynamicImage::from(part.clone());
        upright.apply_orientation(orientation);
        let upright = upright.to_rgba8();
        let camera = camera(upright.width(), upright.height());
        let source = Source {
            crop: Some(crop),
            orientation,
            ..Source::new(view.clone(), camera)
        };
        locator.set_source(0, &source).unwrap();
        let found = host.run(&mut locator).estimates.remove(0);
        let expected = expected(&model, &upright);
        assert!(agree(&found, &expected), "{orientation:?}: {found:?}");
        assert_eq!(found.coverage, expected.coverage);

        // The mask lies on the texture as it is stored.
        let mask = expected.mask.unwrap();
        let shape = Shape::new(1, mask.height as usize, mask.width as usize);
        let mask = reference::Tensor::new(shape, mask.probability).unwrap();
        let params = Unrectification::new(&camera, &model.description.camera, crop, orientation);
        let values = host.values(locator.mask(0).unwrap());
        let stored_mask = reference::unrectify(&mask, &params);
        assert!(difference(&values, &stored_mask).unwrap() < 0.51 / 255.0 + 1e-4);
        // Negative control: the orientations differ.
        if let Some(first) = &first {
            assert!(
                difference(&values, first).unwrap() > 0.02,
                "{orientation:?}"
            );
        } else {
            first = Some(values);
        }
    }
}

#[test]
fn a_mask_follows_a_camera_that_changes_in_the_texture_that_it_has() {
    let (host, model) = (Host::new(), model());
    let image = picture(1);
    let view = host.rgba(&image);
    let options = HostOptions {
        mask: MaskSize::Source,
        ..Default::default()
    };
    let mut locator = HostLocator::new(host.ours(), &model, options).unwrap();
    let (whole, upright) = (Crop::whole(WIDTH, HEIGHT), Orientation::NoTransforms);
    let mut drawn = Vec::new();
    let mut last = None;
    for hfov in [1.2, 0.9, 0.6] {
        let camera = Camera::from_hfov(WIDTH, HEIGHT, hfov);
        let source = Source::new(view.clone(), camera);
        locator.set_source(0, &source).unwrap();
        // What the host drew with is what it goes on drawing with.
        let mask = locator.mask(0).unwrap().clone();
        assert_eq!(*last.get_or_insert(mask.clone()), mask);
        host.run(&mut locator);
        let found = Locator::on_cpu(&model).locate(
            &image,
            &camera,
            Output {
                mask: true,
                mask_only: true,
            },
        );
        let found = found.unwrap().mask.unwrap();
        let shape = Shape::new(1, found.height as usize, found.width as usize);
        let found = reference::Tensor::new(shape, found.probability).unwrap();
        let params = Unrectification::new(&camera, &model.description.camera, whole, upright);
        let expected = reference::unrectify(&found, &params);
        let values = host.values(&mask);
        assert!(difference(&values, &expected).unwrap() < 0.51 / 255.0 + 1e-4);
        drawn.push(values);
    }
    // Negative control: they are not the same; and another size is another texture.
    assert!(difference(&drawn[0], &drawn[1]).unwrap() > 0.02);
    assert!(difference(&drawn[1], &drawn[2]).unwrap() > 0.02);
    let source = Source::new(host.rgba(&RgbaImage::new(40, 30)), camera(40, 30));
    locator.set_source(0, &source).unwrap();
    assert_ne!(last.as_ref(), locator.mask(0));
}

#[test]
fn a_source_whose_mask_has_no_room_is_refused_and_the_former_stays() {
    let limits = wgpu::Limits {
        max_storage_buffer_binding_size: 1 << 20,
        ..Default::default()
    };
    let host = Host::with(wgpu::Features::empty(), limits).unwrap();
    let model = model();
    let options = HostOptions {
        mask: MaskSize::Source,
        ..Default::default()
    };
    let mut locator = HostLocator::new(host.ours(), &model, options).unwrap();
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source).unwrap();
    let mask = locator.mask(0).unwrap().clone();
    let (width, height) = (4096, 300);
    let large = host.texture(wgpu::TextureFormat::Rgba8Unorm, [width, height], &[]);
    let large = Source::new(large, camera(width, height));
    // However often it is tried.
    for _ in 0..2 {
        let error = locator.set_source(0, &large).unwrap_err().to_string();
        assert!(error.contains("mask: bytes"), "{error}");
    }
    let found = host.run(&mut locator);
    assert!(agree(&found.estimates[0], &expected(&model, &picture(1))));
    assert_eq!(locator.mask(0), Some(&mask));
    // Negative control: what has room is taken.
    let source = Source::new(host.rgba(&RgbaImage::new(40, 30)), camera(40, 30));
    locator.set_source(0, &source).unwrap();
    assert_ne!(locator.mask(0), Some(&mask));
}

#[test]
fn the_host_s_shaders_read_the_estimates() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    locator
        .set_source(
            0,
            &Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT)),
        )
        .unwrap();
    let found = host.run(&mut locator).estimates.remove(0);
    assert_eq!(found.status, Status::Found);
    let text = locator.wgsl()
        + "@group(0) @binding(0) var<storage, read> estimates: array<Estimate>;
           @group(0) @binding(1) var<storage, read_write> copy: array<vec4<f32>>;
           @compute @workgroup_size(1) fn main() {
               copy[0] = vec4(f32(estimates[0].status), f32(FOUND), f32(estimates[0].pixels), 0.0);
               for (var i = 0u; i < JOINTS; i++) { copy[i + 1u] = estimates[0].joints[i]; }
           }";
    let module = host
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: None,
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
    let pipeline = host
        .device
        .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: None,
            layout: None,
            module: &module,
            entry_point: None,
            compilation_options: Default::default(),
            cache: None,
        });
    let copy = host.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 7 * 16,
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    let bind_group = host.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[
            wgpu::BindGroupEntry {
                binding: 0,
                resource: locator.estimates().as_entire_binding(),
            },
            wgpu::BindGroupEntry {
                binding: 1,
                resource: copy.as_entire_binding(),
            },
        ],
    });
    let mut encoder = host.device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    let mut pass = encoder.begin_compute_pass(&Default::default());
    pass.set_pipeline(&pipeline);
    pass.set_bind_group(0, &bind_group, &[]);
    pass.dispatch_workgroups(1, 1, 1);
    drop(pass);
    host.queue.submit([encoder.finish()]);
    let values: Vec<[f32; 4]> = bytemuck::pod_collect_to_vec(&host.bytes(&copy));
    assert_eq!(values[0][0], values[0][1]);
    let seen: Vec<f32> = values[1..]
        .iter()
        .flat_map(|v| [v[0], v[1], v[2]])
        .collect();
    assert_eq!(seen, joints(&found));
    assert!(values[1..].iter().all(|v| v[3] == 1.0));
}

#[test]
fn the_host_s_error_scopes_and_handlers_see_nothing_of_us() {
    let (host, model) = (Host::new(), model());
    let errors = Arc::new(AtomicUsize::new(0));
    let seen = Arc::clone(&errors);
    host.device.on_uncaptured_error(Arc::new(move |_| {
        seen.fetch_add(1, Ordering::SeqCst);
    }));
    let wrong = || {
        host.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: 4,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::STORAGE,
            mapped_at_creation: false,
        })
    };
    let scope = host.device.push_error_scope(wgpu::ErrorFilter::Validation);
    let mut locator = host.locator(&model);
    let depth = host.texture(wgpu::TextureFormat::R32Float, [8, 8], &[]);
    locator
        .set_source(0, &Source::new(depth, camera(8, 8)))
        .unwrap_err();
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source).unwrap();
    locator.warm_up(&mut |_, _| {}).unwrap();
    host.run(&mut locator);
    assert!(pollster::block_on(scope.pop()).is_none());
    assert_eq!(errors.load(Ordering::SeqCst), 0);
    // Negative control: both are still the host's.
    let scope = host.device.push_error_scope(wgpu::ErrorFilter::Validation);
    wrong();
    assert!(pollster::block_on(scope.pop()).is_some());
    wrong();
    assert_eq!(errors.load(Ordering::SeqCst), 1);
    host.run(&mut locator);
}

#[test]
fn two_locators_share_a_device() {
    let (host, model) = (Host::new(), model());
    let ours = host.ours();
    let mut locators: Vec<HostLocator> = (0..2)
        .map(|_| HostLocator::new(Arc::clone(&ours), &model, HostOptions::default()).unwrap())
        .collect();
    let images = [picture(1), picture(2)];
    let mut encoder = host.device.create_command_encoder(&Default::default());
    for (locator, image) in locators.iter_mut().zip(&images) {
        let source = Source::new(host.rgba(image), camera(WIDTH, HEIGHT));
        locator.set_source(0, &source).unwrap();
        locator.encode(&mut encoder).unwrap();
        locator.read_back(&mut encoder, 1).unwrap();
    }
    host.queue.submit([encoder.finish()]);
    let mut found = locators
        .iter_mut()
        .map(|l| l.wait(PATIENCE).unwrap().unwrap());
    let [first, second] = [found.next().unwrap(), found.next().unwrap()];
    assert!(agree(&first.estimates[0], &expected(&model, &images[0])));
    assert!(agree(&second.estimates[0], &expected(&model, &images[1])));
    // Negative control: they are not each other's.
    assert!(!agree(&first.estimates[0], &second.estimates[0]));
}

#[test]
fn a_batch_has_a_camera_each() {
    let (host, model) = (Host::new(), model());
    let options = HostOptions {
        batch: 2,
        ..Default::default()
    };
    let mut locator = HostLocator::new(host.ours(), &model, options).unwrap();
    let images = [picture(1), image::imageops::rotate90(&picture(2))];
    let source =
        |image: &RgbaImage| Source::new(host.rgba(image), camera(image.width(), image.height()));
    locator.set_source(1, &source(&images[1])).unwrap();
    let mut encoder = host.device.create_command_encoder(&Default::default());
    let error = locator.encode(&mut encoder).unwrap_err();
    assert!(
        matches!(error, LocateError::NoSource { index: 0 }),
        "{error}"
    );
    locator.set_source(0, &source(&images[0])).unwrap();
    locator.set_source(2, &source(&images[0])).unwrap_err();
    let found = host.run(&mut locator).estimates;
    assert_eq!(found.len(), 2);
    for (found, image) in found.iter().zip(&images) {
        let expected = expected(&model, image);
        assert!(agree(found, &expected), "{found:?}");
    }
    assert!(locator.mask(1).is_some() && locator.mask(2).is_none());
}

#[test]
fn several_frames_are_in_flight_and_the_newest_counts() {
    let (host, model) = (Host::new(), model());
    let options = HostOptions {
        in_flight: 2,
        ..Default::default()
    };
    let mut locator = HostLocator::new(host.ours(), &model, options).unwrap();
    assert!(locator.latest().unwrap().is_none());
    assert!(locator.wait(PATIENCE).unwrap().is_none());
    let images = [picture(1), picture(2), picture(3)];
    for (frame, image) in images.iter().enumerate() {
        let source = Source::new(host.rgba(image), camera(WIDTH, HEIGHT));
        locator.set_source(0, &source).unwrap();
        let mut encoder = host.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        let read = locator.read_back(&mut encoder, frame as u64).unwrap();
        // There is room for two.
        assert_eq!(read, frame < 2);
        host.queue.submit([encoder.finish()]);
    }
    host.device
        .poll(wgpu::PollType::wait_indefinitely())
        .unwrap();
    let newest = locator.latest().unwrap().unwrap();
    assert_eq!(newest.frame, 1);
    assert!(agree(&newest.estimates[0], &expected(&model, &images[1])));
    assert!(locator.latest().unwrap().is_none());

    // An encoder that is dropped takes its frame along, and gives its room back.
    let mut encoder = host.device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    assert!(locator.read_back(&mut encoder, 7).unwrap());
    assert!(matches!(
        locator.wait(Duration::from_millis(20)),
        Err(LocateError::Gpu(GpuError::Timeout(_)))
    ));
    drop(encoder);
    assert!(locator.latest().unwrap().is_none());
    assert!(pollster::block_on(locator.next()).unwrap().is_none());
    assert_eq!(host.run(&mut locator).frame, 1);
}

#[test]
fn a_frame_that_did_not_run_has_no_results() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    let source = |seed| Source::new(host.rgba(&picture(seed)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source(1)).unwrap();
    host.run(&mut locator);
    locator.set_source(0, &source(2)).unwrap();
    for (frame, runs, is_refused) in [(2, true, true), (3, false, false), (4, true, false)] {
        let scope = host.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let mut encoder = host.device.create_command_encoder(&Default::default());
        if runs {
            locator.encode(&mut encoder).unwrap();
        }
        assert!(locator.read_back(&mut encoder, frame).unwrap());
        if is_refused {
            host.spoil(&mut encoder);
        }
        host.queue.submit([encoder.finish()]);
        assert_eq!(pollster::block_on(scope.pop()).is_some(), is_refused);
        let located = locator.wait(PATIENCE).unwrap();
        // Negative control: the last one ran.
        assert_eq!(located.as_ref().map(|l| l.frame), (frame == 4).then_some(4));
        if let Some(located) = located {
            assert!(agree(&located.estimates[0], &expected(&model, &picture(2))));
        }
    }
}

#[test]
fn probabilities_are_those_behind_the_newest_results_or_none() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    let source = |seed| Source::new(host.rgba(&picture(seed)), camera(WIDTH, HEIGHT));
    let probabilities =
        |locator: &HostLocator| pollster::block_on(locator.probabilities_async()).unwrap();
    let shows = |locator: &HostLocator, seed: u64| {
        let mask = expected(&model, &picture(seed)).mask.unwrap();
        difference(&probabilities(locator).unwrap(), &mask.probability).unwrap() < 1e-4
    };
    locator.set_source(0, &source(1)).unwrap();
    assert_eq!(probabilities(&locator), None);
    host.run(&mut locator);
    assert!(shows(&locator, 1) && shows(&locator, 1));
    // Negative control: another picture's.
    assert!(!shows(&locator, 2));

    // A frame that is refused.
    locator.set_source(0, &source(2)).unwrap();
    let scope = host.device.push_error_scope(wgpu::ErrorFilter::Validation);
    let mut encoder = host.device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    locator.read_back(&mut encoder, 2).unwrap();
    host.spoil(&mut encoder);
    host.queue.submit([encoder.finish()]);
    assert!(pollster::block_on(scope.pop()).is_some());
    assert!(locator.wait(PATIENCE).unwrap().is_none());
    assert_eq!(probabilities(&locator), None);
    host.run(&mut locator);
    assert!(shows(&locator, 2));

    // One that is dropped changes nothing; one whose results nobody asked for writes over the masks.
    let mut encoder = host.device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    locator.read_back(&mut encoder, 3).unwrap();
    drop(encoder);
    assert!(locator.latest().unwrap().is_none());
    assert!(shows(&locator, 2));
    let mut encoder = host.device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    host.queue.submit([encoder.finish()]);
    assert_eq!(probabilities(&locator), None);
}

#[test]
fn results_can_be_awaited() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    let source = Source::new(host.rgba(&picture(2)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source).unwrap();
    for frame in 0..3 {
        let mut encoder = host.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        locator.read_back(&mut encoder, frame).unwrap();
        host.queue.submit([encoder.finish()]);
        let located = pollster::block_on(locator.next()).unwrap().unwrap();
        assert_eq!(located.frame, frame);
        assert!(agree(&located.estimates[0], &expected(&model, &picture(2))));
    }
}

#[test]
fn a_frame_that_is_not_submitted_keeps_no_other_from_being_awaited() {
    let (host, model) = (Host::new(), model());
    let mut locator = host.locator(&model);
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source).unwrap();
    let mut recorded = [1, 2].map(|frame| {
        let mut encoder = host.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        locator.read_back(&mut encoder, frame).unwrap();
        Some(encoder)
    });
    for (place, frame) in [(1, 2), (0, 1)] {
        host.queue
            .submit(recorded[place].take().map(|e| e.finish()));
        let located = pollster::block_on(locator.next()).unwrap().unwrap();
        assert_eq!(located.frame, frame);
        assert!(agree(&located.estimates[0], &expected(&model, &picture(1))));
    }
    // Negative control: then none is on its way.
    assert!(pollster::block_on(locator.next()).unwrap().is_none());
}

#[test]
fn a_locator_that_is_dropped_in_mid_flight_harms_nobody() {
    let (host, model) = (Host::new(), model());
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    for submit in [true, false] {
        let mut locator = host.locator(&model);
        locator.set_source(0, &source).unwrap();
        let mut encoder = host.device.create_command_encoder(&Default::default());
        locator.encode(&mut encoder).unwrap();
        locator.read_back(&mut encoder, 1).unwrap();
        if submit {
            host.queue.submit([encoder.finish()]);
            drop(locator);
        } else {
            drop(locator);
            host.queue.submit([encoder.finish()]);
        }
        host.device
            .poll(wgpu::PollType::wait_indefinitely())
            .unwrap();
    }
    let mut locator = host.locator(&model);
    locator.set_source(0, &source).unwrap();
    let found = host.run(&mut locator);
    assert!(agree(&found.estimates[0], &expected(&model, &picture(1))));
}

fn is_lost<T>(result: Result<T, LocateError>) -> bool {
    matches!(result, Err(LocateError::Gpu(GpuError::Lost(_))))
}

/// Loses a device at a stage of its work, and goes on with another one: how long it takes until all calls
/// say so.
fn lose(model: &Model, stage: usize) -> Duration {
    let host = Host::new();
    let lost = Arc::new(AtomicUsize::new(0));
    let seen = Arc::clone(&lost);
    host.device.set_device_lost_callback(move |_, _| {
        seen.fetch_add(1, Ordering::SeqCst);
    });
    let ours = host.ours();
    let destroy = || {
        host.device.destroy();
        Instant::now()
    };
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    let new = || HostLocator::new(Arc::clone(&ours), model, HostOptions::default());
    let mut encoder = host.device.create_command_encoder(&Default::default());
    let start = if stage == 0 {
        let start = destroy();
        assert!(is_lost(new()));
        start
    } else {
        let mut locator = new().unwrap();
        let mut start = None;
        if stage == 1 {
            start = Some(destroy());
            assert!(is_lost(locator.set_source(0, &source)));
        }
        if stage >= 2 {
            locator.set_source(0, &source).unwrap();
        }
        if stage == 2 {
            start = Some(destroy());
            assert!(is_lost(locator.encode(&mut encoder)));
            assert!(is_lost(locator.read_back(&mut encoder, 1)));
        }
        if stage >= 3 {
            locator.encode(&mut encoder).unwrap();
            locator.read_back(&mut encoder, 1).unwrap();
        }
        if stage == 3 {
            start = Some(destroy());
            host.queue.submit([encoder.finish()]);
            assert!(is_lost(locator.latest()));
        } else if stage >= 4 {
            host.queue.submit([encoder.finish()]);
            start = Some(destroy());
        }
        if stage == 4 {
            assert!(is_lost(locator.latest()));
        } else if stage == 5 {
            assert!(is_lost(pollster::block_on(locator.next())));
        }
        // It stays lost.
        assert!(is_lost(locator.latest()));
        assert!(is_lost(locator.wait(PATIENCE)));
        start.unwrap()
    };
    let took = start.elapsed();
    // The host learns of it as ever.
    let _ = host.device.poll(wgpu::PollType::wait_indefinitely());
    assert_eq!(lost.load(Ordering::SeqCst), 1, "stage {stage}");
    // Another device goes on.
    let host = Host::new();
    let mut locator = host.locator(model);
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    locator.set_source(0, &source).unwrap();
    let found = host.run(&mut locator);
    assert!(agree(&found.estimates[0], &expected(model, &picture(1))));
    took
}

#[test]
fn a_device_that_is_lost_at_any_stage_is_an_error_at_once() {
    let model = model();
    for stage in 0..6 {
        // A busy machine may come between.
        let soon = (0..5).any(|_| lose(&model, stage) < Duration::from_millis(100));
        assert!(soon, "stage {stage}");
    }
}

#[test]
fn a_device_that_was_lost_before_is_an_error_and_the_host_s_handler_sees_nothing() {
    let host = Host::new();
    host.device
        .on_uncaptured_error(Arc::new(|error| panic!("the host's handler got {error}")));
    host.device.destroy();
    let error = Device::from_host(host.device.clone(), host.queue.clone()).unwrap_err();
    assert!(matches!(error, GpuError::Lost(_)), "{error}");
}

#[test]
fn a_host_that_submits_in_another_thread_hears_nothing_of_the_question_whether_it_lost_its_device()
{
    let host = Host::new();
    host.device
        .on_uncaptured_error(Arc::new(|error| panic!("the host's handler got {error}")));
    let ours = host.ours();
    std::thread::scope(|scope| {
        let asking = scope.spawn(|| (0..20_000).for_each(|_| ours.check().unwrap()));
        while !asking.is_finished() {
            host.queue.submit([]);
            host.device.poll(wgpu::PollType::Poll).unwrap();
        }
    });
    // Nor does it take a device for sound that is not.
    host.device.destroy();
    assert!(matches!(ours.check(), Err(GpuError::Lost(_))));
}

#[test]
fn a_locator_is_made_and_warmed_up_in_the_background() {
    let (host, model) = (Host::new(), model());
    let source = Source::new(host.rgba(&picture(1)), camera(WIDTH, HEIGHT));
    let (ours, expected) = (host.ours(), expected(&model, &picture(1)));
    let background = std::thread::spawn(move || {
        let mut told = [Vec::new(), Vec::new()];
        let [planned, ran] = &mut told;
        let mut plan = |done, all| planned.push((done, all));
        let options = HostOptions::default();
        let mut locator = HostLocator::with_progress(ours, &model, options, &mut plan).unwrap();
        locator.set_source(0, &source).unwrap();
        locator
            .warm_up(&mut |done, all| ran.push((done, all)))
            .unwrap();
        (locator, told)
    });
    // The host's frames go on meanwhile.
    while !background.is_finished() {
        host.queue.submit([]);
    }
    let (mut locator, told) = background.join().unwrap();
    for told in told {
        let (last, all) = told[told.len() - 1];
        assert!(last == all && all > 5, "{told:?}");
        assert!(
            told.is_sorted_by(|a, b| a.0 < b.0 && a.1 == b.1),
            "{told:?}"
        );
    }
    let found = host.run(&mut locator);
    assert!(agree(&found.estimates[0], &expected));
}

#[test]
fn what_cannot_be_read_is_refused_in_words() {
    use wgpu::{TextureFormat as F, TextureUsages as U};
    let (host, model) = (Host::new(), model());
    host.device
        .on_uncaptured_error(Arc::new(|error| panic!("wgpu noticed first: {error}")));
    let mut locator = host.locator(&model);
    let right = host.rgba(&picture(1));
    let ours = camera(WIDTH, HEIGHT);
    let planes = |planes| Source {
        planes,
        ..Source::new(right.clone(), ours)
    };
    let size = [WIDTH, HEIGHT];
    let luma = host.texture(F::R8Unorm, size, &[]);
    let nv12 = |luma: &wgpu::TextureView, chroma: &wgpu::TextureView| {
        planes(Planes::Nv12 {
            luma: luma.clone(),
            chroma: chroma.clone(),
            encoding: Yuv::Bt601,
        })
    };
    let wrong = [
        (
            planes(Planes::Rgba(host.texture(F::Rgba16Float, size, &[]))),
            "Rgba16Float",
        ),
        (
            planes(Planes::Rgba(host.texture_for(
                F::Rgba8Unorm,
                size,
                &[],
                U::COPY_DST,
            ))),
            "TEXTURE_BINDING",
        ),
        (nv12(&right, &luma), "luma"),
        (nv12(&luma, &luma), "chroma"),
        (
            nv12(&luma, &host.texture(F::Rg8Unorm, [30, 23], &[])),
            "31 x 24",
        ),
        (
            Source::new(right.clone(), camera(WIDTH + 1, HEIGHT)),
            "61 x 47",
        ),
        (
            Source {
                crop: Some(Crop {
                    x: 20,
                    y: 0,
                    width: 42,
                    height: 9,
                }),
                ..Source::new(right.clone(), camera(42, 9))
            },
            "42",
        ),
        (
            Source {
                crop: Some(Crop {
                    x: u32::MAX,
                    y: 0,
                    width: 2,
                    height: 9,
                }),
                ..Source::new(right.clone(), camera(2, 9))
            },
            "crop",
        ),
    ];
    locator
        .set_source(0, &Source::new(right.clone(), ours))
        .unwrap();
    for (source, word) in &wrong {
        let error = locator.set_source(0, source).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    }
    // What was there before is still there.
    let found = host.run(&mut locator);
    assert!(agree(&found.estimates[0], &expected(&model, &picture(1))));
}

#[test]
fn a_device_that_lacks_a_limit_is_refused_in_words() {
    let limits = wgpu::Limits::downlevel_webgl2_defaults();
    let host = Host::with(wgpu::Features::empty(), limits).unwrap();
    let error = Device::from_host(host.device, host.queue).unwrap_err();
    assert!(matches!(error, GpuError::Limit { .. }), "{error}");
}

#[test]
fn compiled_kernels_of_strangers_are_passed_over() {
    let open = || Device::open(&whereabot::gpu::AdapterRequest::new(None, None)).unwrap();
    let model = model();
    let run = |memory: &[u8]| {
        // SAFETY: it is the device's own, or has no right checksum.
        #[allow(unsafe_code)]
        let device = unsafe { open().with_pipeline_cache(memory) };
        let mut locator = Locator::on_gpu(Arc::new(device), &model, Default::default()).unwrap();
        let found = locator
            .locate(&picture(1), &camera(WIDTH, HEIGHT), Output::default())
            .unwrap();
        assert!(agree(&found, &expected(&model, &picture(1))));
    };
    let device = Arc::new(open());
    Locator::on_gpu(Arc::clone(&device), &model, Default::default()).unwrap();
    let memory = device.pipeline_cache().unwrap_or_default();
    run(&memory);
    run(b"");
    run(b"not a cache at all");
    let mut damaged = memory;
    damaged.iter_mut().skip(20).for_each(|byte| *byte ^= 0x55);
    run(&damaged);
}
