//! The kernels that turn and zoom a network's camera against the reference.

use crate::common::{device, difference, noise, run_step};
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

/// By name: what the cameras see of the image; what they see of the mask, and the mask beyond; the joint network's input; the joints
/// that it sees in the canonical camera's frame.
type Outputs = [(&'static str, Vec<f32>); 3];

/// The mask that the cameras see: the image's first channel.
fn closer(image: &[f32], shape: Shape) -> Vec<f32> {
    let plane = shape.height * shape.width;
    let images = image.chunks_exact(shape.len());
    images.flat_map(|image| image[..plane].to_vec()).collect()
}

fn run(image: &[f32], mask: &[f32], seen: &[f32], shape: Shape, rule: Overlay) -> Outputs {
    let device = device();
    let batch = image.len() / shape.len();
    let joint_shape = Shape::new(3 * JOINTS, 1, 1);
    let one = Shape::new(1, shape.height, shape.width);
    let empty = |what, shape| Tensor::new(&device, what, shape, batch).unwrap();
    let tensor = |what, shape, values: &[f32]| {
        let tensor = empty(what, shape);
        tensor.write(&device, values).unwrap();
        tensor
    };
    let mask = tensor("mask", one, mask);
    let closer = tensor("closer", one, &closer(image, shape));
    let (image, seen) = (
        tensor("image", shape, image),
        tensor("seen", joint_shape, seen),
    );
    let merged = empty("merged", one);
    let (overlay, joints) = (empty("overlay", shape), empty("joints", joint_shape));
    let steps = device.scoped(|| {
        let gazes = Gazes::new(&device, camera(shape), batch)?;
        Ok([
            gazes.zoom(&device, &mask, ZOOM, rule)?,
            gazes.zoom_mask(&device, &closer, &mask, &merged)?,
            gazes.zoom_overlay(&device, &image, &mask, &overlay, rule)?,
            gazes.zoom_joints(&device, &seen, &joints)?,
        ])
    });
    for step in &steps.unwrap() {
        run_step(&device, step);
    }
    let outputs = [("mask", merged), ("overlay", overlay), ("joints", joints)];
    outputs.map(|(name, tensor)| (name, tensor.read(&device).unwrap()))
}

fn expected(image: &[f32], mask: &[f32], seen: &[f32], shape: Shape, rule: Overlay) -> Outputs {
    let one = Shape::new(1, shape.height, shape.width);
    let camera = camera(shape);
    let closer = closer(image, shape);
    let mut outputs = ["mask", "overlay", "joints"].map(|name| (name, Vec::new()));
    for (index, ((image, mask), seen)) in image
        .chunks_exact(shape.len())
        .zip(mask.chunks_exact(one.len()))
        .zip(seen.chunks_exact(3 * JOINTS))
        .enumerate()
    {
        let tensor =
            |shape, values: &[f32]| reference::Tensor::new(shape, values.to_vec()).unwrap();
        let closer = tensor(one, &closer[index * one.len()..][..one.len()]);
        let (image, mask) = (tensor(shape, image), tensor(one, mask));
        let gaze = reference::zoom(&mask, rule, &camera, ZOOM);
        outputs[0]
            .1
            .extend(reference::zoom_mask(&closer, &mask, &camera, &gaze).data());
        outputs[1]
            .1
            .extend(reference::zoom_overlay(&image, &mask, rule, &camera, &gaze).data());
        outputs[2].1.extend(reference::zoom_joints(seen, &gaze));
    }
    outputs
}

/// Of each output, by its name.
fn differences(found: &Outputs, expected: &Outputs) -> Vec<(&'static str, f32)> {
    let pairs = found.iter().zip(expected);
    pairs
        .map(|((name, found), (_, expected))| (*name, difference(found, expected).unwrap()))
        .collect()
}

proptest! {
    #![proptest_config(crate::common::cases(16))]

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
        let found = run(&image, &mask, &seen, shape, RAMP);
        let expected = expected(&image, &mask, &seen, shape, RAMP);
        for (name, difference) in differences(&found, &expected) {
            prop_assert!(difference <= 1e-4, "{name}: {difference}");
        }
    }
}

#[test]
fn a_threshold_is_kept_to_but_for_pixels_next_to_it() {
    let shape = Shape::new(3, 53, 64);
    let image: Vec<f32> = noise(2 * shape.len(), 1).iter().map(|v| v + 2.0).collect();
    let mask = masks(shape, 2, 4);
    let seen = vec![0.0; 2 * 3 * JOINTS];
    let rule = Overlay::Threshold { threshold: 0.5 };
    let [.., (_, found), _] = run(&image, &mask, &seen, shape, rule);
    let [.., (_, expected), _] = expected(&image, &mask, &seen, shape, rule);
    let other = |(a, b): (&f32, &f32)| (a - b).abs() > 1e-3;
    let wrong = found.iter().zip(&expected).filter(|pair| other(*pair));
    let wrong = wrong.count();
    assert!(wrong <= 6, "{wrong} of {} values", found.len());
    // Negative control: the threshold matters to more than those.
    let lower = Overlay::Threshold { threshold: 0.4 };
    let [.., (_, lower), _] = run(&image, &mask, &seen, shape, lower);
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
fn roundings_do_not_turn_the_camera() {
    let shape = Shape::new(3, 53, 64);
    let (image, seen) = (noise(shape.len(), 1), noise(3 * JOINTS, 3));
    let mask = masks(shape, 1, 1);
    let [.., (_, expected)] = run(&image, &mask, &seen, shape, RAMP);
    let noise = noise(mask.len(), 4);
    let rounded = |by: f32| -> Vec<f32> {
        let pairs = mask.iter().zip(&noise);
        pairs.map(|(value, noise)| value + by * noise).collect()
    };
    let [.., (_, found)] = run(&image, &rounded(1e-3), &seen, shape, RAMP);
    assert_eq!(difference(&found, &expected), Ok(0.0));
    // Negative control: by another mask it sees joints elsewhere.
    let [.., (_, found)] = run(&image, &rounded(1.0), &seen, shape, RAMP);
    assert!(difference(&found, &expected).unwrap() > 0.1);
}

#[test]
fn a_pixel_more_in_the_mask_is_noticed() {
    let shape = Shape::new(3, 20, 24);
    let (image, seen) = (noise(shape.len(), 1), noise(3 * JOINTS, 3));
    let mut mask = masks(shape, 1, 1);
    let found = run(&image, &mask, &seen, shape, RAMP);
    let far = mask.iter().rposition(|p| *p < 0.25).unwrap();
    mask[far] = 0.9;
    let expected = expected(&image, &mask, &seen, shape, RAMP);
    for (name, difference) in differences(&found, &expected) {
        assert!(difference > 1e-3, "{name}: {difference}");
    }
}

#[test]
fn what_the_canonical_camera_sees_stays_as_it_is() {
    let shape = Shape::new(3, 53, 64);
    let (image, seen) = (noise(shape.len(), 1), noise(3 * JOINTS, 3));
    let nothing = vec![0.0; shape.height * shape.width];
    let [(_, merged), ..] = run(&image, &nothing, &seen, shape, RAMP);
    assert!(difference(&merged, &closer(&image, shape)).unwrap() <= 1e-4);
    // Negative control: one pixel turns the camera.
    let mut mask = nothing;
    mask[70] = 0.9;
    let [(_, merged), ..] = run(&image, &mask, &seen, shape, RAMP);
    assert!(difference(&merged, &closer(&image, shape)).unwrap() > 0.1);
}
