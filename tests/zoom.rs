//! The kernels that turn and zoom the joint network's camera against the reference.
#![allow(clippy::unwrap_used, missing_docs)]

mod common;

use common::{device, difference, noise, run_step};
use proptest::prelude::*;
use whereabot::camera::Intrinsics;
use whereabot::gpu::{Gazes, Tensor};
use whereabot::network::{Overlay, Shape, Zoom};
use whereabot::reference;

const ZOOM: Zoom = Zoom {
    spread: 5.0,
    least: 0.5,
    most: 4.0,
};
const RAMP: Overlay = Overlay::Ramp {
    low: 0.25,
    high: 0.75,
};
const JOINTS: usize = 6;

fn camera(shape: Shape) -> Intrinsics {
    let [width, height] = [shape.width, shape.height].map(|side| side as f64);
    Intrinsics {
        fx: 0.7 * width,
        fy: 0.8 * width,
        cx: 0.5 * width - 0.7,
        cy: 0.5 * height - 0.4,
    }
}

/// A mask for each image: nothing, a box somewhere, noise.
fn masks(shape: Shape, batch: usize, seed: u64) -> Vec<f32> {
    let (width, height) = (shape.width, shape.height);
    let values = noise(batch * width * height, seed);
    (0..batch)
        .flat_map(|image| {
            let at = |n: u64, side: usize| (seed.wrapping_mul(n) >> 7) as usize % side.max(1);
            let (x, y) = (at(2_654_435_761, width), at(40_503, height));
            let kind = (seed as usize + image) % 3;
            let values = values[image * width * height..][..width * height].to_vec();
            values.into_iter().enumerate().map(move |(i, value)| {
                let inside = (x..=x + width / 4).contains(&(i % width))
                    && (y..=y + height / 3).contains(&(i / width));
                match kind {
                    0 => 0.25 * value,
                    1 if inside => 0.8 + 0.1 * value,
                    1 => 0.1,
                    _ => value,
                }
            })
        })
        .collect()
}

/// What the joint network is shown, and the joints that it sees `seen` in the canonical camera's frame.
fn run(
    image: &[f32],
    mask: &[f32],
    seen: &[f32],
    shape: Shape,
    rule: Overlay,
) -> (Vec<f32>, Vec<f32>) {
    let device = device();
    let batch = image.len() / shape.len();
    let joint_shape = Shape::new(3 * JOINTS, 1, 1);
    let tensor = |what, shape, values: &[f32]| {
        let tensor = Tensor::new(&device, what, shape, batch).unwrap();
        tensor.write(&device, values).unwrap();
        tensor
    };
    let mask = tensor("mask", Shape::new(1, shape.height, shape.width), mask);
    let (image, seen) = (
        tensor("image", shape, image),
        tensor("seen", joint_shape, seen),
    );
    let overlay = Tensor::new(&device, "overlay", shape, batch).unwrap();
    let joints = Tensor::new(&device, "joints", joint_shape, batch).unwrap();
    let steps = device.scoped(|| {
        let gazes = Gazes::new(&device, camera(shape), batch)?;
        Ok([
            gazes.zoom(&device, &mask, ZOOM, rule)?,
            gazes.zoom_overlay(&device, &image, &mask, &overlay, rule)?,
            gazes.zoom_joints(&device, &seen, &joints)?,
        ])
    });
    for step in &steps.unwrap() {
        run_step(&device, step);
    }
    (
        overlay.read(&device).unwrap(),
        joints.read(&device).unwrap(),
    )
}

fn expected(
    image: &[f32],
    mask: &[f32],
    seen: &[f32],
    shape: Shape,
    rule: Overlay,
) -> (Vec<f32>, Vec<f32>) {
    let one = Shape::new(1, shape.height, shape.width);
    let camera = camera(shape);
    let (mut overlays, mut joints) = (Vec::new(), Vec::new());
    for ((image, mask), seen) in image
        .chunks_exact(shape.len())
        .zip(mask.chunks_exact(one.len()))
        .zip(seen.chunks_exact(3 * JOINTS))
    {
        let image = reference::Tensor::new(shape, image.to_vec()).unwrap();
        let mask = reference::Tensor::new(one, mask.to_vec()).unwrap();
        let gaze = reference::zoom(&mask, rule, &camera, ZOOM);
        overlays.extend(reference::zoom_overlay(&image, &mask, rule, &camera, &gaze).data());
        joints.extend(reference::zoom_joints(seen, &gaze));
    }
    (overlays, joints)
}

proptest! {
    #![proptest_config(common::cases(16))]

    #[test]
    fn the_kernels_agree_with_the_reference(
        (height, width) in (1_usize..60, 1_usize..60),
        batch in 1_usize..4,
        seed in any::<u32>(),
    ) {
        let shape = Shape::new(3, height, width);
        // Smooth: a place is known to a ten-thousandth of a pixel, which noise would show.
        let image: Vec<f32> = noise(batch * shape.len(), seed.into()).iter().map(|v| 0.1 * v).collect();
        let mask = masks(shape, batch, seed.into());
        let seen = noise(batch * 3 * JOINTS, u64::from(seed) + 2);
        let (overlay, joints) = run(&image, &mask, &seen, shape, RAMP);
        let (expected_overlay, expected_joints) = expected(&image, &mask, &seen, shape, RAMP);
        prop_assert!(difference(&joints, &expected_joints).unwrap() <= 1e-4);
        prop_assert!(difference(&overlay, &expected_overlay).unwrap() <= 1e-4);
    }
}

#[test]
fn a_threshold_is_kept_to_but_for_pixels_next_to_it() {
    let shape = Shape::new(3, 53, 64);
    let image: Vec<f32> = noise(2 * shape.len(), 1).iter().map(|v| v + 2.0).collect();
    let mask = masks(shape, 2, 4);
    let seen = vec![0.0; 2 * 3 * JOINTS];
    let rule = Overlay::Threshold { threshold: 0.5 };
    let (found, _) = run(&image, &mask, &seen, shape, rule);
    let (expected, _) = expected(&image, &mask, &seen, shape, rule);
    let other = |(a, b): (&f32, &f32)| (a - b).abs() > 1e-3;
    let wrong = found.iter().zip(&expected).filter(|pair| other(*pair));
    let wrong = wrong.count();
    assert!(wrong <= 6, "{wrong} of {} values", found.len());
    // Negative control: the threshold matters to more than those.
    let lower = Overlay::Threshold { threshold: 0.4 };
    let (lower, _) = run(&image, &mask, &seen, shape, lower);
    assert!(
        lower
            .iter()
            .zip(&expected)
            .filter(|pair| other(*pair))
            .count()
            > 60
    );
}

#[test]
fn a_pixel_more_in_the_mask_is_noticed() {
    let shape = Shape::new(3, 20, 24);
    let (image, seen) = (noise(shape.len(), 1), noise(3 * JOINTS, 3));
    let mut mask = masks(shape, 1, 1);
    let (overlay, joints) = run(&image, &mask, &seen, shape, RAMP);
    let far = mask.iter().rposition(|p| *p < 0.25).unwrap();
    mask[far] = 0.9;
    let (expected_overlay, expected_joints) = expected(&image, &mask, &seen, shape, RAMP);
    assert!(difference(&joints, &expected_joints).unwrap() > 1e-3);
    assert!(difference(&overlay, &expected_overlay).unwrap() > 1e-3);
}
