//! The unrectify kernel against the reference, and both against what a camera would see.

use crate::common::{cases, device, difference, noise};
use proptest::prelude::*;
use whereabot::camera::{Camera, Crop, Distortion, Intrinsics, Orientation, Unrectification};
use whereabot::gpu::{Layout, Tensor, Unrectify};
use whereabot::network::Shape;
use whereabot::reference;

const SHAPE: Shape = Shape::new(1, 53, 64);

fn canonical() -> Intrinsics {
    Intrinsics {
        fx: 45.6,
        fy: 45.6,
        cx: 31.5,
        cy: 26.0,
    }
}

/// What the GPU makes of image `index` of `masks`, in `layout`.
fn on_gpu(layout: Layout, masks: &[f32], index: usize, params: &Unrectification) -> Vec<f32> {
    let device = device();
    let batch = masks.len() / SHAPE.len();
    let tensor = Tensor::in_layout(&device, layout, "mask", SHAPE, batch, 0).unwrap();
    tensor.write(&device, masks).unwrap();
    let made = device.scoped(|| Unrectify::new(&device, &tensor, index, params));
    let unrectify = made.unwrap();
    let [width, height] = params.size;
    let row = width.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let staging = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(row) * u64::from(height),
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    let step = unrectify.step();
    step.encode(&mut encoder.begin_compute_pass(&Default::default()));
    unrectify.copy(&mut encoder);
    let texture = unrectify.view().texture();
    encoder.copy_texture_to_buffer(
        texture.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &staging,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row),
                rows_per_image: None,
            },
        },
        texture.size(),
    );
    device.queue().submit([encoder.finish()]);
    let values = device.read(&staging, |bytes| {
        let rows = bytes.chunks_exact(row as usize);
        let texels = rows.flat_map(|row| &row[..width as usize]);
        texels.map(|&v| f32::from(v) / 255.0).collect()
    });
    values.unwrap()
}

fn probabilities(count: usize, seed: u64) -> Vec<f32> {
    let values = noise(count, seed);
    values.iter().map(|v| 0.5 + 0.5 * v).collect()
}

fn on_reference(mask: &[f32], params: &Unrectification) -> Vec<f32> {
    let mask = reference::Tensor::new(SHAPE, mask.to_vec()).unwrap();
    reference::unrectify(&mask, params)
}

/// A texel has 255 steps.
const STEP: f32 = 0.5 / 255.0 + 1e-4;

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        (width, height) in (1_u32..300, 1_u32..200),
        hfov in 0.4..2.0_f64,
        k1 in -0.3..0.1_f64,
        turned in any::<bool>(),
        layout in 0_usize..3,
        index in 0_usize..2,
        seed in any::<u32>(),
    ) {
        let orientation = if turned { Orientation::Rotate90 } else { Orientation::FlipVertical };
        let crop = Crop { x: 5, y: 9, width, height };
        let [columns, rows] = crop.turned(orientation);
        let camera = Camera {
            distortion: Distortion::Rational { k: [k1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.001, 0.002] },
            ..Camera::from_hfov(columns, rows, hfov)
        };
        let params = Unrectification::new(&camera, &canonical(), crop, orientation);
        let mut masks = probabilities(2 * SHAPE.len(), seed.into());
        let layout = Layout::ALL[layout];
        if layout == Layout::HalfBuffer {
            masks = crate::common::in_halves(&masks);
        }
        let mask = &masks[index * SHAPE.len()..][..SHAPE.len()];
        let found = on_gpu(layout, &masks, index, &params);
        let found = difference(&found, &on_reference(mask, &params)).unwrap();
        // Noise is steep: a hundredth of a pixel is a hundredth of its range.
        prop_assert!(found <= STEP + 0.003, "{}", found);
    }
}

#[test]
fn a_straight_border_is_where_the_lens_shows_it() {
    // Robot is what lies right of the plane x = 0.44 z.
    let border = |ray: [f64; 2]| f32::from(ray[0] > 0.44);
    let mask: Vec<f32> = (0..SHAPE.len())
        .map(|at| ((at % 64) as f64 - 31.5) / 45.6)
        .map(|x| border([x, 0.0]))
        .collect();
    let camera = Camera {
        distortion: Distortion::Rational {
            k: [-0.25, 0.05, 0.0, 0.0, 0.0, 0.0],
            p: [0.001, -0.001],
        },
        ..Camera::from_hfov(320, 240, 1.1)
    };
    let whole = Crop::whole(320, 240);
    let straight = Orientation::NoTransforms;
    let params = Unrectification::new(&camera, &canonical(), whole, straight);
    let wrong = |found: &[f32]| {
        let mut wrong = 0;
        for (at, value) in found.iter().enumerate() {
            let pixel = [(at % 320) as f64, (at / 320) as f64];
            let ray = camera.unproject(pixel).unwrap();
            if ray[0].abs() > 0.68 || ray[1].abs() > 0.56 {
                // The canonical camera does not see it.
                continue;
            }
            // Between two pixels of the mask it may be either.
            let clear = (ray[0] - 0.44).abs() > 0.7 / 45.6;
            wrong += usize::from(clear && (value - border(ray)).abs() > 0.01);
        }
        wrong
    };
    assert_eq!(wrong(&on_reference(&mask, &params)), 0);
    assert_eq!(wrong(&on_gpu(Layout::Buffer, &mask, 0, &params)), 0);
    // Negative control: without the lens the border is elsewhere.
    let pinhole = Camera {
        distortion: Distortion::None,
        ..camera
    };
    let params = Unrectification::new(&pinhole, &canonical(), whole, straight);
    assert!(wrong(&on_reference(&mask, &params)) > 100);
}

#[test]
fn the_network_s_own_image_is_as_it_is() {
    let mask = probabilities(SHAPE.len(), 3);
    let params = Unrectification::identity(64, 53);
    assert!(difference(&on_reference(&mask, &params), &mask).unwrap() < 1e-5);
    assert!(difference(&on_gpu(Layout::Buffer, &mask, 0, &params), &mask).unwrap() <= STEP);
    // Negative control: upside down.
    let upside: Vec<f32> = mask.iter().rev().copied().collect();
    assert!(difference(&on_reference(&upside, &params), &mask).unwrap() > 0.1);
}

#[test]
fn what_is_no_number_and_what_is_not_seen_is_no_robot() {
    let mut mask = vec![1.0; SHAPE.len()];
    mask[5] = f32::NAN;
    mask[9] = f32::INFINITY;
    let params = Unrectification::identity(64, 53);
    for found in [
        on_reference(&mask, &params),
        on_gpu(Layout::Buffer, &mask, 0, &params),
    ] {
        assert_eq!((found[5], found[9], found[300]), (0.0, 0.0, 1.0));
    }
    let wide = Camera::from_hfov(200, 100, 2.6);
    let whole = Crop::whole(200, 100);
    let params = Unrectification::new(&wide, &canonical(), whole, Orientation::NoTransforms);
    for found in [
        on_reference(&mask, &params),
        on_gpu(Layout::Buffer, &mask, 0, &params),
    ] {
        assert_eq!((found[50 * 200], found[50 * 200 + 100]), (0.0, 1.0));
    }
}
