//! The smallest host: a program with a wgpu device and a camera texture of its own finds the robot in it.
//!
//! `cargo run --release --example headless_host [-- IMAGE [WEIGHTS]]`

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use whereabot::camera::Camera;
use whereabot::cascade::{HostLocator, HostOptions, Source};
use whereabot::gpu::Device;
use whereabot::network::Model;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let mut next = |default: &str| arguments.next().unwrap_or(default.to_owned());
    let image = image::open(next("examples/images/ur5_1.jpg"))?.to_rgba8();
    let model = Model::load(next("weights/ur5.safetensors"))?;

    // What a host has already: a device, with WebGPU's defaults, and the camera's image in a texture.
    let (device, queue) = pollster::block_on(open())?;
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("camera"),
        size: wgpu::Extent3d {
            width: image.width(),
            height: image.height(),
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8UnormSrgb,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    });
    let layout = wgpu::TexelCopyBufferLayout {
        bytes_per_row: Some(4 * image.width()),
        ..Default::default()
    };
    queue.write_texture(texture.as_image_copy(), &image, layout, texture.size());

    // Once: the networks, planned for this device.
    let ours = Arc::new(Device::from_host(device.clone(), queue.clone())?);
    let mut locator = HostLocator::new(ours, &model, HostOptions::default())?;
    let camera = Camera::from_hfov(image.width(), image.height(), 70_f64.to_radians());
    let view = texture.create_view(&Default::default());
    locator.set_source(0, &Source::new(view, camera))?;

    // Each frame: record behind what made the image, before what draws with `locator.mask(0)` and
    // `locator.estimates()`; then submit.
    let mut encoder = device.create_command_encoder(&Default::default());
    locator.encode(&mut encoder)?;
    locator.read_back(&mut encoder, 0)?;
    queue.submit([encoder.finish()]);

    // A program with a window asks `locator.latest()` in each frame instead, and never waits.
    let located = locator.wait(Duration::from_secs(60))?;
    for estimate in located.iter().flat_map(|located| &located.estimates) {
        println!(
            "{:?}, {:.1} % robot",
            estimate.status,
            100.0 * estimate.coverage
        );
        for joint in &estimate.joints {
            let [x, y, z] = joint.xyz_m;
            println!("{:>13}: {x:6.3} {y:6.3} {z:6.3} m", joint.name);
        }
    }
    Ok(())
}

async fn open() -> Result<(wgpu::Device, wgpu::Queue), Box<dyn Error>> {
    let descriptor = wgpu::InstanceDescriptor::new_without_display_handle_from_env();
    let instance = wgpu::Instance::new(descriptor);
    let adapter = instance.request_adapter(&Default::default()).await?;
    Ok(adapter.request_device(&Default::default()).await?)
}
