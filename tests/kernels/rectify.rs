//! The rectify kernel against the reference, and both against what a camera would see.

use crate::common::{ORIENTATIONS, cases, device, difference, narrow_device, noise, run_step};
use image::{DynamicImage, Rgba, RgbaImage};
use proptest::prelude::*;
use whereabot::camera::{Camera, Crop, Distortion, Gaze, Intrinsics, Rectification, Texels};
use whereabot::gpu::{Device, Gazes, Planes, Rectify, Sight, Tensor, Yuv};
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

fn sight(device: &Device, gaze: Gaze, width: usize, height: usize) -> Sight {
    let camera = canonical(width as u32, height as u32);
    let gazes = device.scoped(|| Gazes::new(device, camera, 1)).unwrap();
    gazes.write(device, &[gaze]).unwrap();
    Sight {
        label: "rectify",
        gazes,
        image: Tensor::new(device, "output", Shape::new(3, height, width), 1).unwrap(),
    }
}

fn on_gpu(image: &RgbaImage, params: &Rectification, width: usize, height: usize) -> Vec<f32> {
    let device = device();
    let sight = sight(&device, Gaze::CANONICAL, width, height);
    on_device(&device, image, params, sight)
}

fn on_reference(
    image: &RgbaImage,
    params: &Rectification,
    rows: usize,
    columns: usize,
) -> reference::Tensor {
    reference::rectify(image, params, &Gaze::CANONICAL, rows, columns)
}

fn on_device(device: &Device, image: &RgbaImage, params: &Rectification, sight: Sight) -> Vec<f32> {
    let mut rectify = device.scoped(|| Ok(Rectify::new(device))).unwrap();
    let sights = [sight];
    rectify.write(device, &sights, image, params).unwrap();
    run_step(device, &rectify.steps()[0]);
    sights[0].image.read(device).unwrap()
}

/// The same of a host's textures, rectified into 64 x 53.
fn of_planes(planes: &Planes, params: &Rectification) -> Vec<f32> {
    let device = device();
    let sights = [sight(&device, Gaze::CANONICAL, 64, 53)];
    let mut rectify = device.scoped(|| Ok(Rectify::new(&device))).unwrap();
    rectify.bind(&device, &sights, planes, params).unwrap();
    run_step(&device, &rectify.steps()[0]);
    sights[0].image.read(&device).unwrap()
}

fn texture(
    format: wgpu::TextureFormat,
    [width, height]: [u32; 2],
    bytes: &[u8],
) -> wgpu::TextureView {
    let device = device();
    let texture = device.wgpu().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d {
            width,
            height,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    });
    device.queue().write_texture(
        texture.as_image_copy(),
        bytes,
        wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(bytes.len() as u32 / height),
            rows_per_image: None,
        },
        texture.size(),
    );
    texture.create_view(&Default::default())
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
        gaze in prop_oneof![
            Just(Gaze::CANONICAL),
            (-0.6..0.6_f32, -0.6..0.6_f32, 0.5..4.0_f32).prop_map(|(x, y, zoom)| Gaze::towards([x, y], zoom)),
        ],
        seed in any::<u32>(),
    ) {
        let camera = Camera { distortion, ..Camera::from_hfov(width, height, hfov) };
        let image = picture(width, height, seed.into());
        let params = Rectification::new(&camera, &canonical(out_width, out_height), out_width, out_height);
        let (columns, rows) = (out_width as usize, out_height as usize);
        let expected = reference::rectify(&image, &params, &gaze, rows, columns);
        let device = device();
        let found = on_device(&device, &image, &params, sight(&device, gaze, columns, rows));
        let found = difference(&found, expected.data()).unwrap();
        prop_assert!(found <= 2e-4, "{found}");
    }
}

/// A frame's images are of several cameras: each sees by its own gaze.
#[test]
fn a_camera_that_looks_closer_sees_the_picture_s_own_pixels() {
    let device = device();
    let camera = Camera::from_hfov(400, 300, 0.9);
    let params = Rectification {
        index: 1,
        ..Rectification::new(&camera, &camera.intrinsics, 64, 53)
    };
    let image = picture(400, 300, 9);
    // Its focal length is the picture's: what it sees are pixels of the picture.
    let scale = 64.0 / 400.0;
    let params = Rectification {
        canonical: [
            (1.0 / (scale * camera.intrinsics.fx)) as f32,
            (1.0 / (scale * camera.intrinsics.fy)) as f32,
            31.5,
            25.5,
        ],
        samples: [1, 1],
        ..params
    };
    let gaze = Gaze::towards([0.0, 0.0], (1.0 / scale) as f32);
    let gazes = device
        .scoped(|| Gazes::new(&device, camera.intrinsics, 2))
        .unwrap();
    gazes.write(&device, &[Gaze::CANONICAL, gaze]).unwrap();
    assert!(gazes.write(&device, &[gaze]).is_err());
    let sights = [Sight {
        label: "rectify",
        gazes,
        image: Tensor::new(&device, "output", Shape::new(3, 53, 64), 2).unwrap(),
    }];
    let mut rectify = device.scoped(|| Ok(Rectify::new(&device))).unwrap();
    rectify.write(&device, &sights, &image, &params).unwrap();
    run_step(&device, &rectify.steps()[0]);
    let found = sights[0]
        .image
        .read(&device)
        .unwrap()
        .split_off(3 * 53 * 64);
    let (left, top) = (
        (camera.intrinsics.cx - 31.5) as u32,
        (camera.intrinsics.cy - 25.5) as u32,
    );
    let part = |left: u32| -> Vec<f32> {
        (0..3 * 53 * 64)
            .map(|i| {
                let (channel, y, x) = (i / (53 * 64), i as u32 / 64 % 53, i as u32 % 64);
                f32::from(image.get_pixel(left + x, top + y)[channel]) / 255.0
            })
            .collect()
    };
    assert!(difference(&found, &part(left)).unwrap() <= 2e-3);
    // Negative control: a pixel beside.
    assert!(difference(&found, &part(left + 1)).unwrap() > 2e-2);
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
    let reference = on_reference(&image, &params, 212, 256);
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
        on_reference(&image, &params, 64, 64).data().to_vec(),
    ] {
        assert_eq!(values[0], 0.0);
        assert!(values[32 * 64 + 32] > 0.99);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let (width, height) = (64_u32, 53_u32);
    let camera = Camera::from_hfov(64, 60, 1.4);
    let image = picture(64, 60, 5);
    let params = Rectification::new(&camera, &canonical(width, height), width, height);
    let (columns, rows) = (width as usize, height as usize);
    let expected = on_reference(&image, &params, rows, columns);
    let narrow = narrow_device(16);
    let found = on_device(
        &narrow,
        &image,
        &params,
        sight(&narrow, Gaze::CANONICAL, columns, rows),
    );
    assert!(difference(&found, expected.data()).unwrap() <= 2e-4);
    // Negative control: the last row holds more than zeros.
    assert!(
        found[columns * rows - columns..columns * rows]
            .iter()
            .any(|&v| v > 0.1)
    );
}

#[test]
fn every_format_shows_the_same() {
    use wgpu::TextureFormat as F;
    let image = picture(90, 70, 1);
    let camera = Camera::from_hfov(90, 70, 1.2);
    let params = Rectification::new(&camera, &canonical(64, 53), 64, 53);
    let expected = on_reference(&image, &params, 53, 64);
    let mut swapped = image.clone();
    swapped.pixels_mut().for_each(|pixel| pixel.0.swap(0, 2));
    for (format, right, wrong) in [
        (F::Rgba8Unorm, &image, &swapped),
        (F::Rgba8UnormSrgb, &image, &swapped),
        (F::Bgra8Unorm, &swapped, &image),
        (F::Bgra8UnormSrgb, &swapped, &image),
    ] {
        let off = |image: &RgbaImage| {
            let found = of_planes(&Planes::Rgba(texture(format, [90, 70], image)), &params);
            difference(&found, expected.data()).unwrap()
        };
        // WebGPU lets a driver decode sRGB to within half a step of eight bits.
        let allowed = if format.is_srgb() { 0.6 / 255.0 } else { 2e-4 };
        assert!(off(right) <= allowed, "{format:?}: {}", off(right));
        // Negative control: red for blue.
        assert!(off(wrong) > 0.1, "{format:?}");
    }
}

/// Luma and chroma of an image, each four pixels of one colour.
fn nv12(image: &RgbaImage, encoding: Yuv) -> (Vec<u8>, Vec<u8>) {
    let (red, blue) = match encoding {
        Yuv::Bt601 | Yuv::Bt601Full => (0.299, 0.114),
        Yuv::Bt709 | Yuv::Bt709Full => (0.2126, 0.0722),
    };
    let full = matches!(encoding, Yuv::Bt601Full | Yuv::Bt709Full);
    let (luma_span, chroma_span, black) = if full {
        (255.0, 255.0, 0.0)
    } else {
        (219.0, 224.0, 16.0)
    };
    let (mut luma, mut chroma) = (Vec::new(), Vec::new());
    for (x, y, pixel) in image.enumerate_pixels() {
        let [r, g, b] = [0, 1, 2].map(|c| f64::from(pixel.0[c]) / 255.0);
        let value = red * r + (1.0 - red - blue) * g + blue * b;
        luma.push((black + luma_span * value).round() as u8);
        if x % 2 == 0 && y % 2 == 0 {
            let cb = (b - value) / (2.0 * (1.0 - blue));
            let cr = (r - value) / (2.0 * (1.0 - red));
            chroma.extend([cb, cr].map(|c| (128.0 + chroma_span * c).round() as u8));
        }
    }
    (luma, chroma)
}

#[test]
fn nv12_shows_the_same_in_each_encoding() {
    use wgpu::TextureFormat as F;
    let blocks = picture(31, 24, 1);
    let image = RgbaImage::from_fn(61, 47, |x, y| *blocks.get_pixel(x / 2, y / 2));
    let camera = Camera::from_hfov(61, 47, 1.2);
    let params = Rectification::new(&camera, &canonical(64, 53), 64, 53);
    let expected = on_reference(&image, &params, 53, 64);
    let off = |written, read| {
        let (luma, chroma) = nv12(&image, written);
        let planes = Planes::Nv12 {
            luma: texture(F::R8Unorm, [61, 47], &luma),
            chroma: texture(F::Rg8Unorm, [31, 24], &chroma),
            encoding: read,
        };
        difference(&of_planes(&planes, &params), expected.data()).unwrap()
    };
    let all = [Yuv::Bt601, Yuv::Bt601Full, Yuv::Bt709, Yuv::Bt709Full];
    for (index, written) in all.into_iter().enumerate() {
        // Luma and chroma were rounded to 219 or 224 steps.
        let right = off(written, written);
        assert!(right < 0.009, "{written:?}: {right}");
        // Negative control: another encoding.
        let wrong = off(written, all[(index + 1) % 4]);
        assert!(wrong > 0.02, "{written:?}: {wrong}");
    }
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn a_part_of_a_turned_image_is_what_it_is_upright(
        (width, height) in (1_u32..90, 1_u32..90),
        (left, top, right, bottom) in (0_u32..9, 0_u32..9, 0_u32..9, 0_u32..9),
        turn in 0_usize..8,
    ) {
        let orientation = ORIENTATIONS[turn];
        let crop = Crop { x: left, y: top, width, height };
        let stored = picture(left + width + right, top + height + bottom, 5);
        let part = image::imageops::crop_imm(&stored, left, top, width, height).to_image();
        let mut upright = DynamicImage::from(part);
        upright.apply_orientation(orientation);
        let upright = upright.to_rgba8();
        let camera = Camera::from_hfov(upright.width(), upright.height(), 1.1);
        let plain = Rectification::new(&camera, &canonical(64, 53), 64, 53);
        let turned = Rectification { texels: Texels::new(crop, orientation), ..plain };
        let expected = on_reference(&upright, &plain, 53, 64);
        let on_cpu = on_reference(&stored, &turned, 53, 64);
        prop_assert_eq!(&on_cpu, &expected);
        let found = difference(&on_gpu(&stored, &turned, 64, 53), expected.data()).unwrap();
        prop_assert!(found <= 2e-4, "{}", found);
    }
}
