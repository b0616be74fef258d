use std::array;

use super::comparison::Comparison;
use super::kernel::{BATCHES, Case, rounding_of, submit};
use crate::gpu::{self, Device, GpuError, Layout, Tensor};
use crate::network::{Arm, Links, Shape};
use crate::reference;

/// A UR5 and a UR5e.
const BODIES: [Links; 2] = [
    Links {
        shoulder_offset: 0.1358,
        upper_arm: 0.425,
        elbow_offset: -0.1197,
        forearm: 0.3922,
        wrist_offset: 0.093,
        wrist: 0.0946,
    },
    Links {
        shoulder_offset: 0.138,
        upper_arm: 0.425,
        elbow_offset: -0.131,
        forearm: 0.3922,
        wrist_offset: 0.1263,
        wrist: 0.0997,
    },
];

pub(super) async fn compare(
    device: &Device,
    layout: Layout,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    let batch = case.random.of(&BATCHES);
    // Joints two centimetres beside an arm's: from anything else the fit could end in more than one place.
    let joints: Vec<f32> = (0..batch)
        .flat_map(|_| {
            let links = case.random.of(&BODIES);
            near_an_arm(&links, || case.random.value())
        })
        .collect();
    let arm = Arm {
        bodies: BODIES[..case.turn(&[1, 2])].to_vec(),
        across: whitening(100.0, || case.random.value()),
        along: whitening(50.0, || case.random.value()),
    };
    let shape = Shape::new(3 * Arm::JOINTS, 1, 1);
    let tensor = |what| Tensor::in_layout(device, layout, what, shape, batch, 0);
    let (input, output) = (tensor("seen")?, tensor("joints")?);
    let step = device.scoped(|| gpu::kinematic_fit(device, &input, &output, &arm))?;
    let run = async |joints: &[f32]| {
        input.write(device, joints)?;
        submit(device, |encoder| {
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
        })?;
        output.read_async(device).await
    };
    let expected: Vec<f32> = joints
        .chunks_exact(shape.channels)
        .flat_map(|joints| reference::kinematic_fit(joints, &arm))
        .collect();
    // A twentieth of a metre farther is another place for all of them.
    let moved: Vec<f32> = joints.iter().map(|v| v + 0.05).collect();
    Ok(Comparison {
        found: run(&joints).await?,
        control: run(&moved).await?,
        allowed: 2e-4 + rounding_of(&expected, layout),
        expected,
    })
}

/// Joints of a random arm in front of a camera, each up to two centimetres off.
fn near_an_arm(links: &Links, mut random: impl FnMut() -> f32) -> Vec<f32> {
    let mut direction = || {
        let vector = glam::Vec3::from_array(array::from_fn(|_| random()));
        vector.try_normalize().unwrap_or(glam::Vec3::X)
    };
    let axis = direction();
    let links_across = array::from_fn(|_| {
        direction()
            .reject_from(axis)
            .normalize_or(axis.any_orthonormal_vector())
    });
    let [upper_arm, forearm, wrist]: [glam::Vec3; 3] = links_across;
    let mut at = glam::Vec3::new(0.2, 0.1, 2.0);
    let mut joints = at.to_array().to_vec();
    for link in [
        links.shoulder_offset * axis,
        links.upper_arm * upper_arm + links.elbow_offset * axis,
        links.forearm * forearm,
        links.wrist_offset * axis,
        links.wrist * wrist,
    ] {
        at += link;
        joints.extend(at.to_array());
    }
    joints.into_iter().map(|v| v + 0.02 * random()).collect()
}

/// Of errors of a standard deviation of 1 / `scale`, which depend on each other a little.
fn whitening(scale: f32, mut random: impl FnMut() -> f32) -> [[f32; Arm::JOINTS]; Arm::JOINTS] {
    array::from_fn(|i| {
        array::from_fn(|j| match i.cmp(&j) {
            std::cmp::Ordering::Less => 0.3 * scale * random(),
            std::cmp::Ordering::Equal => scale,
            std::cmp::Ordering::Greater => 0.0,
        })
    })
}
