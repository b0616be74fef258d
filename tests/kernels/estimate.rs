//! The estimate kernel: what it says of each image's totals and joints.

use crate::common::{cases, device, noise, run_step};
use proptest::prelude::*;
use whereabot::gpu::{Layout, Tensor, estimate, estimate_size};
use whereabot::network::Shape;

/// One image's.
#[derive(Debug, Clone, PartialEq)]
struct Case {
    /// `pixels, sure, not_finite`.
    totals: [u32; 3],
    max_radius: f32,
    joints: Vec<[f32; 3]>,
}

const MIN_SURE: u32 = 10;

/// Status, pixels, sure pixels and joints with their weights, as they should be.
fn expected(case: &Case) -> (u32, u32, u32, Vec<[f32; 4]>) {
    let [pixels, sure, not_finite] = case.totals;
    let possible = |[x, y, z]: &[f32; 3]| {
        let radius = (x / z).hypot(y / z);
        [x, y, z].iter().all(|v| v.is_finite()) && *z > 0.0 && radius <= case.max_radius
    };
    let status = if not_finite > 0 {
        2
    } else if sure < MIN_SURE {
        0
    } else if case.joints.iter().all(possible) {
        1
    } else {
        2
    };
    let weighed = |&[x, y, z]: &[f32; 3]| {
        if status == 1 {
            [x, y, z, 1.0]
        } else {
            [0.0; 4]
        }
    };
    let joints = case.joints.iter().map(weighed).collect();
    (status, pixels, sure, joints)
}

fn on_gpu(layout: Layout, cases: &[Case]) -> Vec<(u32, u32, u32, Vec<[f32; 4]>)> {
    use wgpu::BufferUsages as U;
    let (device, count) = (device(), cases[0].joints.len());
    let shape = Shape::new(3 * count, 1, 1);
    let tensor = Tensor::in_layout(&device, layout, "joints", shape, cases.len(), 0).unwrap();
    let joints: Vec<f32> = cases.iter().flat_map(|c| c.joints.concat()).collect();
    tensor.write(&device, &joints).unwrap();
    let buffer = |bytes: &[u8], usage: U| {
        let buffer = device.wgpu().create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: bytes.len() as u64,
            usage: usage | U::COPY_DST,
            mapped_at_creation: false,
        });
        if !usage.contains(U::MAP_READ) {
            device.queue().write_buffer(&buffer, 0, bytes);
        }
        buffer
    };
    let totals = cases.iter().map(|c| c.totals);
    let totals: Vec<u32> = totals.flat_map(|[a, b, c]| [a, b, c, 0, 0, 0, 0]).collect();
    let radii: Vec<f32> = cases.iter().map(|c| c.max_radius).collect();
    let totals = buffer(bytemuck::cast_slice(&totals), U::STORAGE);
    let radii = buffer(bytemuck::cast_slice(&radii), U::STORAGE);
    let size = cases.len() * estimate_size(count) as usize;
    let estimates = buffer(&vec![0xff; size], U::STORAGE | U::COPY_SRC);
    let staging = buffer(&vec![0; size], U::MAP_READ);
    let step = device
        .scoped(|| estimate(&device, &tensor, &totals, &radii, &estimates, MIN_SURE))
        .unwrap();
    run_step(&device, &step);
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(&estimates, 0, &staging, 0, size as u64);
    device.queue().submit([encoder.finish()]);
    let read = device.read(&staging, |bytes| {
        let images = bytes.chunks_exact(size / cases.len());
        let image = |bytes: &[u8]| {
            let (head, joints) = bytes.split_at(16);
            let head: Vec<u32> = bytemuck::pod_collect_to_vec(head);
            let joints = bytemuck::pod_collect_to_vec(joints);
            (head[0], head[1], head[2], joints)
        };
        images.map(image).collect()
    });
    read.unwrap()
}

fn case(seed: u64, joints: usize, sure: u32, not_finite: u32, lift: f32) -> Case {
    let values = noise(3 * joints, seed);
    Case {
        totals: [sure + 7, sure, not_finite],
        max_radius: 1.5,
        joints: values
            .as_chunks()
            .0
            .iter()
            .map(|&[x, y, z]: &[f32; 3]| [x, y, z + lift])
            .collect(),
    }
}

proptest! {
    #![proptest_config(cases(32))]

    #[test]
    fn the_kernel_says_what_it_should(
        joints in 1_usize..9,
        layout in 0_usize..3,
        images in proptest::collection::vec(
            (any::<u32>(), 5_u32..15, 0_u32..8, 0.9_f32..3.0), 1..80,
        ),
    ) {
        let cases: Vec<Case> = images
            .into_iter()
            // One in eight has values that are not finite.
            .map(|(seed, sure, bad, lift)| case(seed.into(), joints, sure, bad / 7, lift))
            .collect();
        let wanted: Vec<_> = cases.iter().map(expected).collect();
        prop_assert_eq!(on_gpu(Layout::ALL[layout], &cases), wanted);
    }
}

#[test]
fn what_cannot_be_is_invalid() {
    let right = case(1, 6, 20, 0, 2.0);
    let with = |index: usize, joint| {
        let mut case = right.clone();
        case.joints[index] = joint;
        case
    };
    let cases = [
        right.clone(),
        with(5, [0.0, 0.0, f32::NAN]),
        with(0, [f32::INFINITY, 0.0, 1.0]),
        with(3, [0.0, 0.0, -1.0]),
        with(3, [0.0, 0.0, 0.0]),
        with(2, [4.0, 0.0, 1.0]),
        with(2, [1e30, 0.0, 1e-30]),
        Case {
            max_radius: 1e9,
            ..with(2, [4.0, 0.0, 1.0])
        },
    ];
    let statuses = on_gpu(Layout::Buffer, &cases).into_iter().map(|e| e.0);
    assert_eq!(statuses.collect::<Vec<_>>(), [1, 2, 2, 2, 2, 2, 2, 1]);
}
