//! Live cameras that see one robot together.
#![cfg(feature = "live")]

use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, UNIX_EPOCH};

use glam::{DAffine3, DQuat, DVec3};
use whereabot::calibration::RigOptions;
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Joint, Status};
use whereabot::live::{Fused, Fusion, Observation, Sink};

static START: OnceLock<Instant> = OnceLock::new();

/// At so many milliseconds, where the wall clock is `back` by then.
fn observation(
    camera: usize,
    (milliseconds, back): (u64, Duration),
    status: Status,
    joints: &[DVec3],
) -> Observation {
    let joint = |&xyz: &DVec3| Joint {
        name: "joint".into(),
        xyz_m: xyz.to_array(),
        px: [0.0, 0.0],
    };
    Observation {
        file: None,
        camera,
        frame: 0,
        acquired: UNIX_EPOCH + Duration::from_millis(1_000_000 + milliseconds) - back,
        acquired_at: *START.get_or_init(Instant::now) + Duration::from_millis(milliseconds),
        answered_at: Instant::now(),
        image: Arc::default(),
        view: Camera::assumed(64, 48),
        estimate: Estimate {
            status,
            coverage: 0.1,
            bbox_px: None,
            field: 1.0,
            joints: joints.iter().map(joint).collect(),
            mask: None,
        },
    }
}

#[test]
fn two_cameras_of_a_robot_become_one_view() {
    let second_from_first =
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(1.0), DVec3::new(1.0, 0.0, 1.0));
    let run = |smoothing_s, cameras: [usize; 2], back: Duration| {
        let mut all = Vec::new();
        let mut sink = Fusion::new(0, &cameras, RigOptions::default(), smoothing_s, |f| {
            all.push(f)
        });
        for n in 0..20_u64 {
            let at = |later| (100 * n + later, if n < 10 { Duration::ZERO } else { back });
            let turn = DQuat::from_rotation_z(0.1 * n as f64);
            let joints: Vec<DVec3> = (0..6)
                .map(|j| {
                    turn * (0.3 * DVec3::new(f64::from(j), f64::from(j * j % 4), 0.5))
                        + 2.0 * DVec3::Z
                })
                .collect();
            let other = joints
                .iter()
                .map(|&j| second_from_first.transform_point3(j));
            sink.observation(&observation(3, at(0), Status::Found, &joints));
            // Of another robot, and not found.
            sink.observation(&observation(2, at(0), Status::Found, &joints));
            sink.observation(&observation(1, at(9), Status::NotFound, &[]));
            sink.observation(&observation(
                1,
                at(10),
                Status::Found,
                &other.collect::<Vec<_>>(),
            ));
        }
        drop(sink);
        all
    };
    let all = run(None, [3, 1], Duration::ZERO);
    assert_eq!(all.len(), 40);
    let last = all.last().unwrap();
    assert!((last.time_s - 1001.91).abs() < 1e-9);
    assert!(last.joints.len() == 6 && last.joints.iter().all(|joint| joint.cameras == 2));
    let off = |fused: &Fused| {
        let pose = fused.poses[1].unwrap().first_from_camera;
        pose.translation
            .distance(second_from_first.inverse().translation)
    };
    assert!(off(last) < 1e-6, "{}", off(last));
    // From the other camera it is the way back.
    assert!(off(run(None, [1, 3], Duration::ZERO).last().unwrap()) > 0.1);
    let smooth = run(Some(1.0), [3, 1], Duration::ZERO);
    assert!(
        smooth.last().unwrap().joints[5]
            .xyz_m
            .distance(last.joints[5].xyz_m)
            > 0.01
    );
    // A wall clock that is set back changes what is said of the time, and nothing else.
    let back = run(Some(1.0), [3, 1], Duration::from_secs(600));
    let (back, smooth) = (back.last().unwrap(), smooth.last().unwrap());
    assert!((back.time_s - 401.91).abs() < 1e-9);
    let same = back.joints.iter().zip(&smooth.joints);
    assert!(
        same.clone()
            .all(|(a, b)| a.xyz_m == b.xyz_m && a.cameras == 2)
    );
    assert_eq!(same.count(), 6);
}
