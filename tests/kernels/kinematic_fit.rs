//! The kinematic fit: the kernel against the reference, and the reference against arms whose joints are known.

use crate::common::{device, difference, noise, run_step};
use glam::Vec3;
use proptest::prelude::*;
use whereabot::gpu::{Tensor, kinematic_fit};
use whereabot::network::{Arm, Links, Shape};
use whereabot::reference;

const UR5: Links = Links {
    shoulder_offset: 0.1358,
    upper_arm: 0.425,
    elbow_offset: -0.1197,
    forearm: 0.3922,
    wrist_offset: 0.093,
    wrist: 0.0946,
};
const UR5E: Links = Links {
    shoulder_offset: 0.138,
    elbow_offset: -0.131,
    wrist_offset: 0.1263,
    wrist: 0.0997,
    ..UR5
};
const UR10: Links = Links {
    shoulder_offset: 0.2209,
    upper_arm: 0.612,
    elbow_offset: -0.1719,
    forearm: 0.5723,
    wrist_offset: 0.1149,
    wrist: 0.1157,
};

/// Errors of a centimetre in any direction, which neighbours share a little.
fn arm(bodies: &[Links]) -> Arm {
    let whitening = |scale: f32| {
        let mut matrix = [[0.0; 6]; 6];
        for i in 0..6 {
            matrix[i][i] = scale;
            if i > 0 {
                matrix[i - 1][i] = -0.1 * scale;
            }
        }
        matrix
    };
    Arm {
        bodies: bodies.to_vec(),
        across: whitening(100.0),
        along: whitening(250.0),
    }
}

/// The joints of a random arm in front of the camera, from the first to the last.
fn joints(links: &Links, seed: u64) -> Vec<f32> {
    let random = noise(15, seed);
    let direction = |i: usize| Vec3::from_slice(&random[3 * i..]).normalize();
    let axis = direction(0);
    let across = |i: usize| direction(i).reject_from(axis).normalize();
    let mut at = Vec3::new(0.3 * random[12], 0.3 * random[13], 2.5 + random[14]);
    let mut joints = at.to_array().to_vec();
    for link in [
        links.shoulder_offset * axis,
        links.upper_arm * across(1) + links.elbow_offset * axis,
        links.forearm * across(2),
        links.wrist_offset * axis,
        links.wrist * across(3),
    ] {
        at += link;
        joints.extend(at.to_array());
    }
    joints
}

fn off_by(joints: &[f32], metres: f32, seed: u64) -> Vec<f32> {
    let noise = noise(joints.len(), seed);
    joints
        .iter()
        .zip(noise)
        .map(|(v, n)| v + metres * n)
        .collect()
}

/// Mean distance of six joints.
fn distance(a: &[f32], b: &[f32]) -> f32 {
    let joints = a.chunks_exact(3).zip(b.chunks_exact(3));
    joints
        .map(|(a, b)| Vec3::from_slice(a).distance(Vec3::from_slice(b)))
        .sum::<f32>()
        / 6.0
}

fn on_gpu(seen: &[f32], arm: &Arm) -> Vec<f32> {
    let device = device();
    let shape = Shape::new(18, 1, 1);
    let tensor = |what| Tensor::new(&device, what, shape, seen.len() / 18).unwrap();
    let (input, output) = (tensor("seen"), tensor("joints"));
    input.write(&device, seen).unwrap();
    let step = device.scoped(|| kinematic_fit(&device, &input, &output, arm));
    run_step(&device, &step.unwrap());
    output.read(&device).unwrap()
}

fn on_reference(seen: &[f32], arm: &Arm) -> Vec<f32> {
    let images = seen.chunks_exact(18);
    images
        .flat_map(|seen| reference::kinematic_fit(seen, arm))
        .collect()
}

proptest! {
    #![proptest_config(crate::common::cases(32))]

    #[test]
    fn the_kernel_agrees_with_the_reference(
        bodies in prop::sample::subsequence(vec![UR5, UR5E, UR10], 1..=3),
        batch in 1_usize..5,
        seed in 1_u64..u64::from(u32::MAX),
    ) {
        let seen: Vec<f32> = (0..batch as u64)
            .flat_map(|image| off_by(&joints(&bodies[0], seed + image), 0.02, seed + image + 100))
            .collect();
        let arm = arm(&bodies);
        let difference = difference(&on_gpu(&seen, &arm), &on_reference(&seen, &arm)).unwrap();
        prop_assert!(difference <= 5e-4, "{difference}");
    }
}

#[test]
fn a_link_that_is_longer_is_noticed() {
    let seen = off_by(&joints(&UR5, 5), 0.02, 6);
    let longer = Links {
        forearm: UR5.forearm + 0.01,
        ..UR5
    };
    let found = on_gpu(&seen, &arm(&[longer]));
    assert!(difference(&found, &on_reference(&seen, &arm(&[UR5]))).unwrap() > 1e-3);
}

#[test]
fn an_arm_stays_where_it_is() {
    for seed in 1..50 {
        let joints = joints(&UR10, seed);
        let found = on_reference(&joints, &arm(&[UR10]));
        let moved = difference(&found, &joints).unwrap();
        assert!(moved < 1e-4, "seed {seed}: {moved}");
        // Negative control: that of other links does not.
        let other = on_reference(&joints, &arm(&[UR5]));
        assert!(difference(&other, &joints).unwrap() > 0.02);
    }
}

#[test]
fn what_no_arm_can_have_is_taken_out_of_the_errors() {
    let (mut before, mut after, mut independent) = (0.0, 0.0, 0.0);
    for seed in 1..200 {
        let truth = joints(&UR10, seed);
        let seen = off_by(&truth, 0.02, seed + 1000);
        let fitted = on_reference(&seen, &arm(&[UR10]));
        before += distance(&seen, &truth);
        after += distance(&fitted, &truth);
        let links = |joints: &[f32]| {
            let at = |i: usize| Vec3::from_slice(&joints[3 * i..]);
            [
                at(0).distance(at(1)),
                at(2).distance(at(3)),
                at(4).distance(at(5)),
            ]
        };
        assert!(difference(&links(&fitted), &links(&truth)).unwrap() < 1e-4);
        // Negative control: of another arm's length.
        let wrong = on_reference(&seen, &arm(&[UR5]));
        independent += distance(&wrong, &truth);
    }
    // Eight freedoms of eighteen: the root of 8 / 18 is 0.67.
    assert!(after < 0.8 * before, "{after} of {before}");
    assert!(independent > before, "{independent} of {before}");
}

#[test]
fn of_two_bodies_the_one_that_fits_is_taken() {
    let both = arm(&[UR5, UR5E]);
    for (links, seed) in [(UR5, 3), (UR5E, 4)] {
        let joints = joints(&links, seed);
        assert!(difference(&on_reference(&joints, &both), &joints).unwrap() < 1e-4);
        assert!(difference(&on_gpu(&joints, &both), &joints).unwrap() < 2e-4);
        // Negative control: the other one alone does not fit.
        let other = arm(&[if links == UR5 { UR5E } else { UR5 }]);
        assert!(difference(&on_reference(&joints, &other), &joints).unwrap() > 5e-3);
    }
}

#[test]
fn joints_that_cannot_be_stay_as_they_are() {
    let arm = arm(&[UR5]);
    let good = off_by(&joints(&UR5, 8), 0.02, 9);
    for (index, value) in [(2, f32::NAN), (4, f32::INFINITY), (17, -20.0), (5, -1e30)] {
        let mut seen = good.clone();
        seen[index] = value;
        let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&on_reference(&seen, &arm)), bits(&seen), "{value}");
        assert_eq!(bits(&on_gpu(&seen, &arm)), bits(&seen), "{value}");
    }
    // Negative control: all others are moved.
    assert!(difference(&on_reference(&good, &arm), &good).unwrap() > 1e-3);
}

#[test]
fn any_camera_gives_the_same_arm() {
    let arm = arm(&[UR5]);
    let seen = off_by(&joints(&UR5, 11), 0.02, 12);
    let turn = glam::Quat::from_euler(glam::EulerRot::XYZ, 0.4, -0.3, 2.0);
    let turned = |joints: &[f32]| -> Vec<f32> {
        let joints = joints.chunks_exact(3).map(Vec3::from_slice);
        joints.flat_map(|joint| (turn * joint).to_array()).collect()
    };
    let one = turned(&on_reference(&seen, &arm));
    let other = on_reference(&turned(&seen), &arm);
    assert!(difference(&one, &other).unwrap() < 1e-4);
    // Negative control: the turn is one.
    assert!(difference(&one, &on_reference(&seen, &arm)).unwrap() > 0.1);
}
