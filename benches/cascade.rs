//! What an image costs on the adapter in use, on the reference, and before the first one.
//! Compare figures of one run only; `benches/README.md` says what was learnt.
#![allow(clippy::unwrap_used, missing_docs)]

use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use image::RgbaImage;
use whereabot::camera::{Camera, Gaze, Rectification};
use whereabot::cascade::{Locator, Output};
use whereabot::gpu::{AdapterRequest, Device, Plan, Precision};
use whereabot::network::Model;
use whereabot::reference;

fn cascade(criterion: &mut Criterion) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = root.join("weights/ur5.safetensors");
    let model = Model::load(&file).unwrap();
    let device = Arc::new(Device::open(&AdapterRequest::new(None, None)).unwrap());
    println!("adapter: {} ({})", device.info().name, device.tier());
    let image = image::open(root.join("examples/images/ur5_1.jpg")).unwrap();
    let image: RgbaImage = image.into_rgba8();
    let camera = Camera::assumed(image.width(), image.height());

    let mut group = criterion.benchmark_group("locate");
    group.sample_size(10);
    let mut gpu = Locator::on_gpu(Arc::clone(&device), &model, Precision::F32).unwrap();
    let mut cpu = Locator::on_cpu(&model);
    for (name, locator) in [("gpu", &mut gpu), ("reference", &mut cpu)] {
        for (what, mask_only) in [("mask and joints", false), ("mask only", true)] {
            let output = Output {
                mask: false,
                mask_only,
            };
            group.bench_function(format!("{name}, {what}"), |b| {
                b.iter(|| locator.locate(black_box(&image), &camera, output).unwrap());
            });
        }
    }
    group.finish();

    let mut group = criterion.benchmark_group("start");
    group.sample_size(10);
    group.bench_function("load the model", |b| b.iter(|| Model::load(&file).unwrap()));
    group.bench_function("plan it", |b| {
        b.iter(|| Locator::on_gpu(Arc::clone(&device), &model, Precision::F32).unwrap());
    });
    group.finish();

    let mut group = criterion.benchmark_group("on the CPU");
    group.sample_size(10);
    let input = model.description.input;
    let to = &model.description.camera;
    let rectification = Rectification::new(&camera, to, input.width, input.height);
    let (rows, columns) = (input.height as usize, input.width as usize);
    group.bench_function("rectify, reference", |b| {
        b.iter(|| {
            reference::rectify(
                black_box(&image),
                &rectification,
                &Gaze::CANONICAL,
                rows,
                columns,
            )
        });
    });
    let mut plan = Plan::new(&device, &model, 1, Precision::F32).unwrap();
    plan.write(&device, 0, &image, &rectification).unwrap();
    group.bench_function("encode and submit", |b| {
        b.iter_custom(|frames| {
            let mut total = Duration::ZERO;
            for _ in 0..frames {
                let clock = Instant::now();
                let mut encoder = device.wgpu().create_command_encoder(&Default::default());
                plan.encode(&mut encoder, true, false, None);
                device.queue().submit([encoder.finish()]);
                total += clock.elapsed();
                device.wait().unwrap();
            }
            total
        });
    });
    group.finish();
}

criterion_group!(benches, cascade);
criterion_main!(benches);
