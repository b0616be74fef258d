//! The coverage kernel against the reference.

use crate::common::{device, narrow_device, noise};
use proptest::prelude::*;
use whereabot::gpu::{Device, Precision, Tensor, Totals, coverage};
use whereabot::network::{Coverage, Shape};
use whereabot::reference;

const SURE: f32 = 0.75;

fn run(mask: &[f32], height: usize, width: usize, batch: usize, threshold: f32) -> Vec<Coverage> {
    run_on(&device(), mask, height, width, batch, threshold)
}

fn run_on(
    device: &Device,
    mask: &[f32],
    height: usize,
    width: usize,
    batch: usize,
    threshold: f32,
) -> Vec<Coverage> {
    let shape = Shape::new(1, height, width);
    let layout = device.layout(Precision::F32).unwrap();
    let tensor = Tensor::in_layout(device, layout, "mask", shape, batch, 0).unwrap();
    tensor.write(device, mask).unwrap();
    let size = (batch * size_of::<Totals>()) as u64;
    let buffer = |size, usage| {
        device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage,
            mapped_at_creation: false,
        })
    };
    use wgpu::BufferUsages as U;
    let totals = buffer(size, U::STORAGE | U::COPY_SRC | U::COPY_DST);
    let runs = buffer(4, U::STORAGE | U::COPY_SRC);
    let readback = buffer(size + 4, U::MAP_READ | U::COPY_DST);
    let step = device
        .scoped(|| coverage(device, &tensor, &totals, &runs, (threshold, SURE)))
        .unwrap();
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    for _ in 0..2 {
        encoder.clear_buffer(&totals, 0, None);
        step.encode(&mut encoder.begin_compute_pass(&Default::default()));
    }
    encoder.copy_buffer_to_buffer(&totals, 0, &readback, 0, size);
    encoder.copy_buffer_to_buffer(&runs, 0, &readback, size, 4);
    device.queue().submit([encoder.finish()]);
    device
        .read(&readback, |bytes| {
            let (totals, runs) = bytes.split_at(size as usize);
            assert_eq!(runs, 2_u32.to_le_bytes());
            bytemuck::pod_collect_to_vec::<u8, Totals>(totals)
        })
        .unwrap()
        .iter()
        .map(|t| t.coverage(width as u32, height as u32))
        .collect()
}

fn expected(mask: &[f32], height: usize, width: usize, threshold: f32) -> Vec<Coverage> {
    mask.chunks_exact(height * width)
        .map(|mask| {
            let mask = reference::Tensor::new(Shape::new(1, height, width), mask.to_vec());
            reference::coverage(&mask.unwrap(), threshold, SURE)
        })
        .collect()
}

proptest! {
    #![proptest_config(crate::common::cases(24))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        (height, width) in (1_usize..60, 1_usize..60),
        batch in 1_usize..4,
        threshold in prop_oneof![Just(0.5_f32), Just(0.99), Just(2.0)],
        seed in any::<u32>(),
    ) {
        let mask = noise(batch * height * width, seed.into());
        prop_assert_eq!(
            run(&mask, height, width, batch, threshold),
            expected(&mask, height, width, threshold)
        );
    }
}

#[test]
fn more_workgroups_than_one_dimension_holds() {
    let mask = noise(20 * 257, 1);
    let found = run_on(&narrow_device(16), &mask, 1, 257, 20, 0.5);
    assert_eq!(found, expected(&mask, 1, 257, 0.5));
}

#[test]
fn the_last_pixel_is_found() {
    let (height, width) = (420, 400);
    let mut mask = vec![0.0; height * width];
    mask[height * width - 1] = 1.0;
    let found = run(&mask, height, width, 1, 0.5);
    assert_eq!(found[0].bbox, Some([399, 419, 399, 419]));
}

#[test]
fn an_empty_mask_has_no_box() {
    let found = run(&[0.0; 12], 3, 4, 1, 0.5);
    assert_eq!((found[0].pixels, found[0].bbox), (0, None));
}

#[test]
fn values_that_are_not_finite_are_counted_and_cover_nothing() {
    let mut mask = vec![0.9; 12];
    mask[3] = f32::NAN;
    mask[4] = f32::INFINITY;
    let found = run(&mask, 3, 4, 1, 0.5);
    assert_eq!(found, expected(&mask, 3, 4, 0.5));
    let Coverage {
        pixels,
        sure,
        not_finite,
        ..
    } = found[0];
    assert_eq!((pixels, sure, not_finite), (10, 10, 2));
}

#[test]
fn a_wrong_pixel_is_noticed() {
    let mut mask = noise(35, 2);
    let found = run(&mask, 5, 7, 1, 0.5);
    mask[17] = if mask[17] >= 0.5 { 0.0 } else { 1.0 };
    assert_ne!(found, expected(&mask, 5, 7, 0.5));
}
