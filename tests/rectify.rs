//! The rectify kernel against the reference, and both against what a camera would see.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

mod common;

use common::{cases, device, difference, noise};
use image::{Rgba, RgbaImage};
use proptest::prelude::*;
use whereabot::camera::{Camera, Distortion, Intrinsics, Rectification};
use whereabot::gpu::{Rectify, Tensor};
use whereabot::network::Shape;
use whereabot::reference;

fn canonical(width: u32, height: u32) -> Intrinsics {
    Intrinsics {
        fx: f64::from(width) * 182.5 / 256.0,
        fy: f64::from(width) * 182.5 / 256.0,
        cx: 0.5 * f64::from(width - 1),
        cy: 0.5 * f64::from(height - 1),
    }
}

fn on_gpu(image: &RgbaImage, params: &Rectification, width: usize, height: usize) -> Vec<f32> {
    let device = device();
    let output = Tensor::new(&device, "output", Shape::new(3, height, width), 1).unwrap();
    let mut rectify = device.scoped(|| Rectify::new(&device, &output)).unwrap();
    rectify.write(&device, &output, image, params).unwrap();
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    let step = rectify.step();
    step.encode(&mut encoder.begin_compute_pass(&Default::default()));
    device.queue().submit([encoder.finish()]);
    output.read(&device).unwrap()
}

/// Grain on slow waves: steep enough that a wrong position shows.
fn picture(width: u32, height: u32, seed: u64) -> RgbaImage {
    let grain = noise((width * height) as usize, seed);
    RgbaImage::from_fn(width, height, |x, y| {
        let value = |f: f32| {
            let wave = (x as f32 * f).sin() + (y as f32 * f * 0.7).cos();
            (120.0 + 50.0 * wave + 10.0 * grain[(y * width + x) as usize]) as u8
        };
        Rgba([value(0.1), value(0.05), value(0.02), 255])
    })
}

fn any_distortion() -> impl Strategy<Value = Distortion> {
    prop_oneof![
        Just(Distortion::None),
        (-0.3..0.1_f64, -0.02..0.05_f64, -0.003..0.003_f64).prop_map(|(k1, k2, p)| {
            Distortion::Rational {
                k: [k1, k2, 0.0, 0.01, 0.0, 0.0],
                p: [p, -p],
            }
        }),
        (-0.05..0.05_f64).prop_map(|k1| Distortion::Equidistant {
            k: [k1, 0.01, 0.0, 0.0]
        }),
    ]
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        (width, height) in (1_u32..300, 1_u32..300),
        (out_width, out_height) in (1_u32..70, 1_u32..70),
        hfov in 0.4..1.8_f64,
        distortion in any_distortion(),
        seed in any::<u32>(),
    ) {
        let camera = Camera { distortion, ..Camera::from_hfov(width, height, hfov) };
        let image = picture(width, height, seed.into());
        let params = Rectification::new(&camera, &canonical(out_width, out_height), out_width, out_height);
        let (columns, rows) = (out_width as usize, out_height as usize);
        let expected = reference::rectify(&image, &params, rows, columns);
        let found = on_gpu(&image, &params, columns, rows);
        let found = difference(&found, expected.data()).unwrap();
        prop_assert!(found <= 2e-4, "{found}");
    }
}

#[test]
fn the_recorder_s_camera_is_halved_exactly() {
    let image = picture(512, 424, 3);
    let camera = Camera {
        width: 512,
        height: 424,
        intrinsics: Intrinsics {
            fx: 365.0,
            fy: 365.0,
            cx: 255.5,
            cy: 211.5,
        },
        distortion: Distortion::None,
    };
    let params = Rectification::new(&camera, &canonical(256, 212), 256, 212);
    assert_eq!(params.samples, [2, 2]);
    let mut mean = vec![0.0; 3 * 212 * 256];
    for (x, y, pixel) in image.enumerate_pixels() {
        for channel in 0..3 {
            let at = (channel * 212 + y as usize / 2) * 256 + x as usize / 2;
            mean[at] += f32::from(pixel[channel]) / (4.0 * 255.0);
        }
    }
    let reference = reference::rectify(&image, &params, 212, 256);
    assert!(difference(reference.data(), &mean).unwrap() < 1e-4);
    assert!(difference(&on_gpu(&image, &params, 256, 212), &mean).unwrap() < 1e-4);
    // Negative control: a principal point off by one pixel.
    let off = Camera {
        intrinsics: Intrinsics {
            cx: 256.5,
            ..camera.intrinsics
        },
        ..camera
    };
    let off = Rectification::new(&off, &canonical(256, 212), 256, 212);
    assert!(difference(&on_gpu(&image, &off, 256, 212), &mean).unwrap() > 1e-2);
}

#[test]
fn shrinking_averages_and_does_not_alias() {
    // Black and white columns, seen twelve times smaller: grey everywhere.
    let image = RgbaImage::from_fn(3072, 400, |x, _| {
        let v = if x % 2 == 0 { 0 } else { 255 };
        Rgba([v, v, v, 255])
    });
    let camera = Camera::from_hfov(3072, 400, 70_f64.to_radians());
    let params = Rectification::new(&camera, &canonical(256, 33), 256, 33);
    let found = on_gpu(&image, &params, 256, 33);
    let middle = &found[16 * 256..17 * 256];
    assert!(
        middle[2..254].iter().all(|v| (v - 0.5).abs() < 0.05),
        "{middle:?}"
    );
}

#[test]
fn a_distorted_camera_shows_straight_lines_straight() {
    // A picture of the vertical plane x = 0.45 z, as the lens would show it: bright to its right.
    let distortion = Distortion::Rational {
        k: [-0.25, 0.05, 0.0, 0.0, 0.0, 0.0],
        p: [0.001, -0.001],
    };
    let camera = Camera {
        distortion,
        ..Camera::from_hfov(640, 480, 1.2)
    };
    let image = RgbaImage::from_fn(640, 480, |x, y| {
        let ray = camera.unproject([f64::from(x), f64::from(y)]);
        let v = if ray.is_some_and(|r| r[0] > 0.45) {
            255
        } else {
            0
        };
        Rgba([v, v, v, 255])
    });
    let straight = |camera: &Camera| {
        let params = Rectification::new(camera, &canonical(256, 212), 256, 212);
        let found = on_gpu(&image, &params, 256, 212);
        // Column where each row turns bright, rows near top and middle.
        [40, 106, 170].map(|row| {
            found[row * 256..(row + 1) * 256]
                .iter()
                .position(|&v| v > 0.5)
                .unwrap()
        })
    };
    let edge = 127.5 + 0.45 * 182.5;
    assert!(
        straight(&camera)
            .iter()
            .all(|&c| (c as f64 - edge).abs() <= 1.0)
    );
    // Negative control: without the lens the line is elsewhere, or bent.
    let pinhole = Camera {
        distortion: Distortion::None,
        ..camera
    };
    assert!(
        straight(&pinhole)
            .iter()
            .any(|&c| (c as f64 - edge).abs() > 1.0)
    );
}

#[test]
fn beyond_the_lens_there_is_black() {
    let distortion = Distortion::Rational {
        k: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0],
        p: [0.0; 2],
    };
    let camera = Camera {
        distortion,
        ..Camera::from_hfov(400, 300, 1.0)
    };
    let image = RgbaImage::from_pixel(400, 300, Rgba([255; 4]));
    let wide = Intrinsics {
        fx: 20.0,
        fy: 20.0,
        cx: 31.5,
        cy: 31.5,
    };
    let params = Rectification::new(&camera, &wide, 64, 64);
    assert!(params.max_radius < 1.0);
    for values in [
        on_gpu(&image, &params, 64, 64),
        reference::rectify(&image, &params, 64, 64).data().to_vec(),
    ] {
        assert_eq!(values[0], 0.0);
        assert!(values[32 * 64 + 32] > 0.99);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let (width, height) = (2100_u32, 2050_u32);
    let camera = Camera::from_hfov(64, 60, 1.4);
    let image = picture(64, 60, 5);
    let params = Rectification::new(&camera, &canonical(width, height), width, height);
    let (columns, rows) = (width as usize, height as usize);
    let expected = reference::rectify(&image, &params, rows, columns);
    let found = on_gpu(&image, &params, columns, rows);
    assert!(difference(&found, expected.data()).unwrap() <= 2e-4);
    // Negative control: the last row holds more than zeros.
    assert!(
        found[columns * rows - columns..columns * rows]
            .iter()
            .any(|&v| v > 0.1)
    );
}
