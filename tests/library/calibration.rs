//! Rigid registration of joints, and rigs of cameras.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use proptest::prelude::*;
use whereabot::calibration::{Pair, RegistrationError, Rig, RigOptions, Spread, kabsch, register};

/// Numbers with mean 0 and deviation 1, the same for the same seed.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) as f64 / u64::MAX as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }
}

fn transform() -> impl Strategy<Value = DAffine3> {
    let number = || -1.0..1.0_f64;
    (
        [number(), number(), number(), number()],
        [number(), number(), number()],
    )
        .prop_filter("no rotation", |(q, _)| {
            q.iter().map(|x| x * x).sum::<f64>() > 0.01
        })
        .prop_map(|(q, t)| {
            let turn = DQuat::from_array(q).normalize();
            DAffine3::from_rotation_translation(turn, 3.0 * DVec3::from(t))
        })
}

fn angle(a: DAffine3, b: DAffine3) -> f64 {
    let between = DQuat::from_mat3(&(a.matrix3 * b.matrix3.transpose()));
    2.0 * between.xyz().length().atan2(between.w.abs())
}

/// `frames` times six joints before a camera, seen with an error of `sigma`, and where they are in truth.
fn pairs(truth: DAffine3, frames: usize, sigma: f64, noise: &mut Noise) -> Vec<Pair> {
    (0..6 * frames)
        .map(|n| {
            let from = DVec3::new(0.0, 0.0, 2.0) + 0.4 * noise.vector();
            Pair {
                from: from + sigma * noise.vector(),
                from_covariance: DMat3::from_diagonal(DVec3::splat(sigma.max(1e-3).powi(2))),
                to: truth.transform_point3(from),
                to_covariance: DMat3::ZERO,
                weight: 1.0,
                group: n / 6,
            }
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn exact_points_give_the_exact_transform(truth in transform(), seed: u64) {
        let pairs = pairs(truth, 1, 0.0, &mut Noise(seed));
        let points = pairs.iter().map(|p| (p.from, p.to, 1.0));
        for found in [kabsch(points).unwrap(), register(&pairs).unwrap().transform] {
            prop_assert!(angle(found, truth) < 1e-7);
            prop_assert!(found.translation.distance(truth.translation) < 1e-7);
        }
        // The way back is another one, unless nothing moves.
        let back = pairs.iter().map(|p| (p.to, p.from, 1.0));
        let back = kabsch(back).unwrap();
        prop_assert!(angle(back, truth.inverse()) < 1e-7);
        prop_assert!(back.translation.distance(truth.translation) > 1e-7 || truth.translation.length() < 1e-3);
    }

    #[test]
    fn weights_say_whom_to_believe(truth in transform(), seed: u64) {
        let mut noise = Noise(seed);
        let mut pairs = pairs(truth, 2, 0.0, &mut noise);
        pairs[0].to += DVec3::ONE;
        let with = |weight: f64| {
            let points = pairs.iter().enumerate();
            kabsch(points.map(|(i, p)| (p.from, p.to, if i == 0 { weight } else { 1.0 }))).unwrap()
        };
        prop_assert!(with(1e-12).translation.distance(truth.translation) < 1e-6);
        prop_assert!(with(1.0).translation.distance(truth.translation) > 1e-3);
    }

    #[test]
    fn mirrored_points_give_a_proper_rotation(truth in transform(), seed: u64) {
        let mut noise = Noise(seed);
        let pairs = pairs(truth, 2, 0.0, &mut noise);
        let points = pairs.iter().map(|p| (p.from, p.to * DVec3::new(-1.0, 1.0, 1.0), 1.0));
        let found = kabsch(points.clone()).unwrap();
        prop_assert!((found.matrix3.determinant() - 1.0).abs() < 1e-9);
        // No rotation does what a mirror does.
        let worst = points.map(|(from, to, _)| found.transform_point3(from).distance(to)).fold(0.0, f64::max);
        prop_assert!(worst > 0.05, "{worst}");
    }

    #[test]
    fn two_in_five_may_be_wrong(truth in transform(), seed: u64, together: bool) {
        let mut noise = Noise(seed);
        let mut pairs = pairs(truth, 20, 0.02, &mut noise);
        let right = pairs.clone();
        // Wrong each in its own way, or all alike: another robot.
        let elsewhere = DAffine3::from_rotation_translation(DQuat::from_rotation_x(1.0), DVec3::new(1.0, 0.4, 0.2));
        for (n, pair) in pairs.iter_mut().enumerate().filter(|(n, _)| n % 5 < 2) {
            pair.to = if together {
                (elsewhere * truth).transform_point3(pair.from)
            } else {
                pair.to + 0.5 * noise.vector().normalize() + noise.vector() * (n % 3) as f64
            };
        }
        let found = register(&pairs).unwrap();
        prop_assert!(angle(found.transform, truth) < 0.03, "{}", angle(found.transform, truth));
        let off = found.transform.transform_point3(DVec3::Z * 2.0).distance(truth.transform_point3(DVec3::Z * 2.0));
        prop_assert!(off < 0.02, "{off}");
        let wrong = found.inliers.iter().enumerate().filter(|&(n, &inlier)| inlier && n % 5 < 2).count();
        prop_assert!(wrong <= 2, "{wrong} outliers counted");
        prop_assert!((0.5..0.65).contains(&found.inlier_share()), "{}", found.inlier_share());
        // Least squares alone are misled: by a third of the way to where the other robot is, a metre off. What errs
        // each in its own way may cancel out. And nothing is thrown away where nothing is wrong.
        let plain = kabsch(pairs.iter().map(|p| (p.from, p.to, 1.0))).unwrap();
        let misled = plain.transform_point3(DVec3::Z * 2.0).distance(truth.transform_point3(DVec3::Z * 2.0));
        prop_assert!(!together || misled > 0.2, "{misled}");
        prop_assert!(register(&right).unwrap().inlier_share() > 0.9);
    }
}

#[test]
fn the_stated_uncertainty_is_that_of_the_error() {
    let truth = DAffine3::from_rotation_translation(
        DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -2.0, 1.0),
        DVec3::new(1.0, -2.0, 0.5),
    );
    let mut noise = Noise(1);
    // Few groups and many, and errors that are alike within a group.
    for (frames, common) in [(4, 0.0), (40, 0.0), (40, 0.05)] {
        let (mut shift, mut turn, mut stated_shift, mut stated_turn) = (0.0, 0.0, 0.0, 0.0);
        for _ in 0..100 {
            let mut pairs = pairs(truth, frames, 0.03, &mut noise);
            for group in pairs.chunks_mut(6) {
                let off = common * noise.vector();
                group.iter_mut().for_each(|pair| pair.from += off);
            }
            let found = register(&pairs).unwrap();
            shift += found
                .transform
                .translation
                .distance_squared(truth.translation);
            turn += angle(found.transform, truth).powi(2);
            stated_shift += found.translation_sigma_m().powi(2);
            stated_turn += found.rotation_sigma_rad().powi(2);
        }
        let shift: f64 = (shift / stated_shift).sqrt();
        let turn: f64 = (turn / stated_turn).sqrt();
        // Few groups are taken to err together, whether they do or not.
        let least = if frames < 10 { 0.3 } else { 0.75 };
        assert!(
            (least..1.35).contains(&shift),
            "{frames}, {common}: {shift}"
        );
        assert!((least..1.35).contains(&turn), "{frames}, {common}: {turn}");
    }
}

#[test]
fn the_way_back_is_as_sure_as_the_way() {
    let mut noise = Noise(8);
    let truth = camera(1.0);
    let one = register(&pairs(truth, 20, 0.02, &mut noise)).unwrap();
    let back = one.inverse();
    let pairs = pairs(truth, 20, 0.02, &mut Noise(8));
    let turned = pairs.iter().map(|pair| Pair {
        from: pair.to,
        from_covariance: pair.to_covariance,
        to: pair.from,
        to_covariance: pair.from_covariance,
        ..*pair
    });
    let other = register(&turned.collect::<Vec<_>>()).unwrap();
    assert!(angle(back.transform, other.transform) < 1e-9);
    // Levers are measured with noise in the one and without in the other.
    let farthest = |a: [[f64; 6]; 6], b: [[f64; 6]; 6]| {
        let cells = (0..6).flat_map(|i| (0..6).map(move |j| (i, j)));
        let off = |(i, j): (usize, usize)| (a[i][j] - b[i][j]).abs() / (b[i][i] * b[j][j]).sqrt();
        cells.map(off).fold(0.0, f64::max)
    };
    assert!(farthest(back.covariance, other.covariance) < 0.06);
    assert!(farthest(one.covariance, other.covariance) > 0.3);
}

#[test]
fn what_cannot_be_told_is_an_error() {
    let mut noise = Noise(2);
    let pairs = pairs(DAffine3::IDENTITY, 2, 0.01, &mut noise);
    assert_eq!(
        register(&pairs[..2]),
        Err(RegistrationError::TooFew { found: 2 })
    );
    assert!(register(&pairs[..3]).is_ok());
    let line = |sigma: f64, noise: &mut Noise| -> Vec<Pair> {
        (0..30)
            .map(|n| Pair {
                from: DVec3::new(0.1, 0.2, 0.3) * f64::from(n) + sigma * noise.vector(),
                to: DVec3::new(0.3, 0.1, -0.2) * f64::from(n) + sigma * noise.vector(),
                ..pairs[0]
            })
            .collect()
    };
    let error = register(&line(0.0, &mut noise)).unwrap_err();
    assert!(
        matches!(error, RegistrationError::Collinear { .. }),
        "{error}"
    );
    // Noise makes a plane of a line, and means nothing.
    let error = register(&line(0.01, &mut noise)).unwrap_err();
    assert!(
        matches!(error, RegistrationError::Undetermined { .. }),
        "{error}"
    );
    let mut wrong = pairs.clone();
    wrong[3].to.y = f64::NAN;
    assert_eq!(
        register(&wrong),
        Err(RegistrationError::NotFinite { index: 3 })
    );
    let mut wrong = pairs;
    wrong[4].from_covariance = DMat3::ZERO;
    wrong[5].weight = 0.0;
    assert_eq!(
        register(&wrong),
        Err(RegistrationError::NotFinite { index: 4 })
    );
}

/// A camera at `azimuth` round the robot, as it stands in the robot's base frame.
fn camera(azimuth: f64) -> DAffine3 {
    let place = DQuat::from_rotation_z(azimuth) * DVec3::new(2.0, 0.0, 0.6);
    let forward = (DVec3::new(0.0, 0.0, 0.4) - place).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let axes = DMat3::from_cols(right, forward.cross(right), forward);
    DAffine3::from_mat3_translation(axes, place)
}

/// Six joints of a robot that moves, base frame.
fn robot(time: f64) -> Vec<DVec3> {
    let turn = DQuat::from_rotation_z(time) * DQuat::from_rotation_y(0.5 * (0.7 * time).sin());
    let joints = [
        [0.0, 0.0, 0.09],
        [0.0, 0.14, 0.09],
        [0.3, 0.1, 0.4],
        [0.6, 0.1, 0.2],
        [0.6, 0.2, 0.1],
        [0.65, 0.2, 0.05],
    ];
    joints.map(|joint| turn * DVec3::from(joint)).to_vec()
}

const SPREAD: Spread = Spread {
    across_m: 0.01,
    along_m: 0.06,
};

/// What a camera makes of the robot.
fn seen(base_from_camera: DAffine3, time: f64, noise: &mut Noise) -> Vec<DVec3> {
    let camera_from_base = base_from_camera.inverse();
    let joints = robot(time)
        .into_iter()
        .map(|j| camera_from_base.transform_point3(j));
    joints
        .map(|joint| {
            let ray = joint.normalize();
            let across = SPREAD.across_m * noise.vector();
            joint + across.reject_from(ray) + SPREAD.along_m * noise.normal() * ray
        })
        .collect()
}

fn error(rig: &Rig, first: DAffine3, time: f64) -> f64 {
    let fused = rig.fused();
    assert_eq!(fused.len(), 6);
    let joints = fused.iter().zip(robot(time));
    let square = |(fused, joint): (&whereabot::calibration::FusedJoint, DVec3)| {
        first.transform_point3(fused.xyz_m).distance_squared(joint)
    };
    (joints.map(square).sum::<f64>() / 6.0).sqrt()
}

#[test]
fn cameras_that_see_the_same_robot_find_each_other() {
    let cameras = [0.0, 1.2, 2.4, 3.6].map(camera);
    let mut noise = Noise(3);
    let mut rigs = [1, 2, 4].map(|n| Rig::new(n, RigOptions::default()));
    let mut errors = [0.0; 3];
    for n in 0..200 {
        let time = 0.1 * f64::from(n);
        for (camera, &place) in cameras.iter().enumerate() {
            // Frames come a little after each other, and the last camera never sees the robot with the first.
            let late = 0.01 * camera as f64;
            let joints = seen(place, time, &mut noise);
            for rig in &mut rigs {
                rig.observe(camera, time + late, &joints, SPREAD);
            }
        }
        if n >= 100 {
            for (sum, rig) in errors.iter_mut().zip(&rigs) {
                *sum += error(rig, cameras[0], time) / 100.0;
            }
        }
    }
    let [one, two, four] = errors;
    assert!(two < 0.7 * one && four < 0.8 * two, "{errors:?}");
    for (camera, &place) in cameras.iter().enumerate().skip(1) {
        let pose = rigs[2].pose(camera).unwrap();
        let truth = cameras[0].inverse() * place;
        let off = pose
            .first_from_camera
            .translation
            .distance(truth.translation);
        assert!(
            off < 0.05 && off < 4.0 * pose.translation_sigma_m(),
            "{camera}: {off}"
        );
        assert!(angle(pose.first_from_camera, truth) < 0.03);
        assert!(pose.inlier_share > 0.9);
        // A neighbour's pose is another one.
        let other = cameras[0].inverse() * cameras[camera - 1];
        assert!(angle(pose.first_from_camera, other) > 0.5);
    }
}

#[test]
fn a_robot_that_stands_says_the_same_again_and_again() {
    let cameras = [0.0, 1.2].map(camera);
    let truth = cameras[0].inverse() * cameras[1];
    // Of 20 pairs of cameras: how far the second one is off in units of what is stated.
    let run = |stands: bool| {
        let mut noise = Noise(8);
        let mut ratios: Vec<f64> = (0..20)
            .map(|_| {
                let biases: [Vec<DVec3>; 2] =
                    std::array::from_fn(|_| (0..6).map(|_| 0.025 * noise.vector()).collect());
                let mut rig = Rig::new(2, RigOptions::default());
                for n in 0..40 {
                    let time = 0.1 * f64::from(n);
                    for (camera, &place) in cameras.iter().enumerate() {
                        let pose = robot(if stands { 1.0 } else { 10.0 * time });
                        let joint = |(&joint, &bias): (&DVec3, &DVec3)| {
                            let bias = if stands { bias } else { 0.025 * noise.vector() };
                            place.inverse().transform_point3(joint) + bias + 0.002 * noise.vector()
                        };
                        let joints = pose.iter().zip(&biases[camera]).map(joint);
                        rig.observe(camera, time, &joints.collect::<Vec<_>>(), SPREAD);
                    }
                }
                let pose = rig.pose(1).unwrap();
                let at = pose.first_from_camera.translation;
                at.distance(truth.translation) / pose.translation_sigma_m()
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        ratios[10]
    };
    let stands = run(true);
    assert!(stands < 3.0, "{stands}");
    // With the negative control: errors of their own each time average out, and what is stated says so.
    let moves = run(false);
    assert!((0.2..3.0).contains(&moves), "{moves}");
}

#[test]
fn poses_go_by_way_of_cameras_between() {
    let cameras = [0.0, 1.2, 2.4].map(camera);
    let mut noise = Noise(4);
    let mut rig = Rig::new(3, RigOptions::default());
    for n in 0..100 {
        let time = 0.1 * f64::from(n);
        // The first and the last camera are never there together.
        for camera in if n % 2 == 0 { [0, 1] } else { [1, 2] } {
            let joints = seen(cameras[camera], time, &mut noise);
            rig.observe(camera, time, &joints, SPREAD);
        }
        assert_eq!(rig.pose(2).is_some(), n > 0);
    }
    let pose = rig.pose(2).unwrap();
    let truth = cameras[0].inverse() * cameras[2];
    let off = pose
        .first_from_camera
        .translation
        .distance(truth.translation);
    assert!(off < 0.1 && off < 4.0 * pose.translation_sigma_m(), "{off}");
    assert!(pose.translation_sigma_m() > rig.pose(1).unwrap().translation_sigma_m());
}

#[test]
fn a_rig_follows_cameras_that_move_and_forgets() {
    let mut noise = Noise(5);
    let still = camera(0.0);
    let moving = |time: f64| camera(1.5 + 0.05 * time);
    let rig = |memory_s| {
        Rig::new(
            2,
            RigOptions {
                memory_s,
                ..RigOptions::default()
            },
        )
    };
    let (mut short, mut long) = (rig(1.0), rig(1000.0));
    for n in 0..600 {
        let time = n as f64 / 30.0;
        for (camera, place) in [(0, still), (1, moving(time))] {
            let joints = seen(place, time, &mut noise);
            for rig in [&mut short, &mut long] {
                rig.observe(camera, time, &joints, SPREAD);
            }
        }
    }
    let truth = still.inverse() * moving(20.0);
    let off = |rig: &Rig| angle(rig.pose(1).unwrap().first_from_camera, truth);
    assert!(off(&short) < 0.08, "{}", off(&short));
    assert!(off(&long) > 0.3, "{}", off(&long));
    let back = |rig: &Rig| rig.pose(1).unwrap().translation_sigma_m();
    assert!(back(&short) > 0.0 && back(&short) < 0.2, "{}", back(&short));
    // Alone for long enough, a camera is lost, and only what one camera sees is left.
    let joints = seen(still, 20.0, &mut noise);
    short.observe(0, 30.0, &joints, SPREAD);
    assert!(short.pose(1).is_none() && long.pose(1).is_some());
    let alone = short.fused();
    assert!(!alone.is_empty() && alone.iter().all(|joint| joint.cameras == 1));
    // What it saw then is not where the robot is now, which a camera of unknown place sees.
    for rig in [&mut short, &mut long] {
        rig.observe(1, 31.0, &joints, SPREAD);
    }
    assert!(short.fused().is_empty() && !long.fused().is_empty());
}

#[test]
fn one_camera_that_is_wrong_does_not_move_the_joints() {
    let cameras = [0.0, 1.2, 2.4, 3.6].map(camera);
    let mut noise = Noise(6);
    let mut rig = Rig::new(4, RigOptions::default());
    for n in 0..60 {
        let time = 0.1 * f64::from(n);
        for (camera, &place) in cameras.iter().enumerate() {
            let mut joints = seen(place, time, &mut noise);
            if camera == 2 && n == 59 {
                joints[4] += DVec3::new(0.6, 0.0, 0.0);
            }
            rig.observe(camera, time, &joints, SPREAD);
        }
    }
    let fused = rig.fused();
    assert_eq!(fused[4].cameras, 3);
    assert_eq!(fused[3].cameras, 4);
    let off = cameras[0]
        .transform_point3(fused[4].xyz_m)
        .distance(robot(5.9)[4]);
    assert!(off < 0.06, "{off}");
}

#[test]
fn the_robot_itself_may_be_the_first_camera() {
    let cameras = [0.4, 2.0].map(camera);
    let mut noise = Noise(7);
    let mut rig = Rig::new(3, RigOptions::default());
    for n in 0..100 {
        let time = 0.1 * f64::from(n);
        rig.observe(0, time, &robot(time), Spread::even(1e-3));
        for (number, &place) in (1..).zip(&cameras) {
            rig.observe(number, time, &seen(place, time, &mut noise), SPREAD);
        }
    }
    for (number, truth) in (1..).zip(cameras) {
        let pose = rig.pose(number).unwrap();
        let off = pose
            .first_from_camera
            .translation
            .distance(truth.translation);
        assert!(off < 0.05, "{off}");
    }
}

#[test]
fn a_rig_passes_over_what_cannot_be() {
    let mut rig = Rig::new(2, RigOptions::default());
    let joints = robot(0.0);
    rig.observe(2, 1.0, &joints, SPREAD);
    rig.observe(0, f64::NAN, &joints, SPREAD);
    rig.observe(0, 1.0, &[DVec3::NAN], SPREAD);
    assert!(rig.fused().is_empty() && rig.pose(1).is_none() && rig.pose(9).is_none());
    rig.observe(0, 1.0, &joints, SPREAD);
    rig.observe(0, 0.5, &robot(1.0), SPREAD);
    assert!(rig.fused()[2].xyz_m.distance(joints[2]) < 1e-12);
    // Too far apart in time to be of one instant.
    rig.observe(1, 1.2, &joints, SPREAD);
    assert!(rig.pose(1).is_none());
    rig.observe(0, 1.21, &joints, SPREAD);
    assert!(rig.pose(1).is_some());
}
