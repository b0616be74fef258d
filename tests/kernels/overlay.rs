//! The overlay kernel against the reference.

use crate::common::{device, difference, narrow_device, noise, run_step};
use proptest::prelude::*;
use whereabot::gpu::{Device, Tensor, overlay};
use whereabot::network::{Overlay, Shape};
use whereabot::reference;

fn run(image: &[f32], mask: &[f32], shape: Shape, batch: usize, rule: Overlay) -> Vec<f32> {
    run_on(&device(), image, mask, shape, batch, rule)
}

fn run_on(
    device: &Device,
    image: &[f32],
    mask: &[f32],
    shape: Shape,
    batch: usize,
    rule: Overlay,
) -> Vec<f32> {
    let one = Shape::new(1, shape.height, shape.width);
    let image_tensor = Tensor::new(device, "image", shape, batch).unwrap();
    let mask_tensor = Tensor::new(device, "mask", one, batch).unwrap();
    let output = Tensor::new(device, "output", shape, batch).unwrap();
    image_tensor.write(device, image).unwrap();
    mask_tensor.write(device, mask).unwrap();
    let step = device
        .scoped(|| overlay(device, &image_tensor, &mask_tensor, &output, rule))
        .unwrap();
    run_step(device, &step);
    output.read(device).unwrap()
}

fn expected(image: &[f32], mask: &[f32], shape: Shape, rule: Overlay) -> Vec<f32> {
    let one = Shape::new(1, shape.height, shape.width);
    image
        .chunks_exact(shape.len())
        .zip(mask.chunks_exact(one.len()))
        .flat_map(|(image, mask)| {
            let image = reference::Tensor::new(shape, image.to_vec()).unwrap();
            let mask = reference::Tensor::new(one, mask.to_vec()).unwrap();
            reference::overlay(&image, &mask, rule).data().to_vec()
        })
        .collect()
}

proptest! {
    #![proptest_config(crate::common::cases(16))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        (height, width) in (1_usize..40, 1_usize..40),
        batch in 1_usize..4,
        rule in prop_oneof![
            Just(Overlay::Multiply {}),
            Just(Overlay::Threshold { threshold: 0.25 }),
            Just(Overlay::Ramp { low: 0.25, high: 0.75 }),
        ],
        seed in any::<u32>(),
    ) {
        let shape = Shape::new(3, height, width);
        let image = noise(batch * shape.len(), seed.into());
        let mask = noise(batch * height * width, u64::from(seed) + 1);
        let found = run(&image, &mask, shape, batch, rule);
        prop_assert!(difference(&found, &expected(&image, &mask, shape, rule)).unwrap() <= 1e-6);
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let shape = Shape::new(3, 45, 70);
    let (image, mask) = (noise(shape.len(), 1), noise(45 * 70, 2));
    let rule = Overlay::Multiply {};
    let found = run_on(&narrow_device(16), &image, &mask, shape, 1, rule);
    assert!(difference(&found, &expected(&image, &mask, shape, rule)).unwrap() <= 1e-6);
}

#[test]
fn a_wrong_pixel_is_noticed() {
    let shape = Shape::new(3, 5, 7);
    let (image, mut mask) = (noise(shape.len(), 1), noise(35, 2));
    let rule = Overlay::Multiply {};
    let found = run(&image, &mask, shape, 1, rule);
    mask[17] += 0.5;
    assert!(difference(&found, &expected(&image, &mask, shape, rule)).unwrap() > 1e-3);
}
