//! The whole cascade: GPU against reference, on the paper's shape at its size.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

mod common;

use common::{description, device, difference, model_file, noise};
use image::RgbaImage;
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Locator, Output, Status};
use whereabot::network::Model;

const ALL: Output = Output {
    mask: true,
    mask_only: false,
};

fn model(seed: u64) -> Model {
    Model::from_bytes(&model_file(&description(256, 212, 32), seed), "random").unwrap()
}

/// Smooth colours with some noise, as a photo has.
fn picture(width: u32, height: u32, seed: u64) -> RgbaImage {
    let grain = noise((width * height) as usize, seed);
    RgbaImage::from_fn(width, height, |x, y| {
        let wave = |f: f32, p: f32| 110.0 + 80.0 * (x as f32 * f + y as f32 * (0.07 - f) + p).sin();
        let g = 20.0 * grain[(y * width + x) as usize];
        image::Rgba(
            [
                wave(0.05, 0.0) + g,
                wave(0.02, 1.0) + g,
                wave(0.04, 2.0) + g,
                255.0,
            ]
            .map(|v| v as u8),
        )
    })
}

fn mask(estimate: &Estimate) -> &[f32] {
    &estimate.mask.as_ref().unwrap().probability
}

fn joints(estimate: &Estimate) -> Vec<f32> {
    estimate
        .joints
        .iter()
        .flat_map(|j| j.xyz_m.map(|v| v as f32))
        .collect()
}

#[test]
fn gpu_and_reference_agree() {
    // Seeds whose masks cover enough for joints; the model is random.
    for (seed, width, height) in [(1, 512, 424), (2, 640, 480), (3, 300, 700)] {
        let model = model(seed);
        let image = picture(width, height, seed);
        let camera = Camera::from_hfov(width, height, 70_f64.to_radians());
        let gpu = Locator::on_gpu(device(), &model)
            .unwrap()
            .locate(&image, &camera, ALL)
            .unwrap();
        let cpu = Locator::on_cpu(&model)
            .locate(&image, &camera, ALL)
            .unwrap();
        assert!(difference(mask(&gpu), mask(&cpu)).unwrap() <= 1e-4);
        assert_eq!(gpu.status, cpu.status);
        if gpu.status == Status::Found {
            // 0.1 mm
            assert!(difference(&joints(&gpu), &joints(&cpu)).unwrap() <= 1e-4);
        }
        println!("{seed}: {:?} {:.3}", gpu.status, gpu.coverage);
    }
}

#[test]
fn another_picture_is_noticed() {
    let model = model(1);
    let camera = Camera::from_hfov(512, 424, 70_f64.to_radians());
    let mut locator = Locator::on_gpu(device(), &model).unwrap();
    let first = locator.locate(&picture(512, 424, 1), &camera, ALL).unwrap();
    let second = locator.locate(&picture(512, 424, 9), &camera, ALL).unwrap();
    let again = locator.locate(&picture(512, 424, 1), &camera, ALL).unwrap();
    assert!(difference(mask(&first), mask(&second)).unwrap() > 1e-3);
    assert_eq!(first, again);
}
