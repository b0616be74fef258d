use std::time::UNIX_EPOCH;

use glam::DVec3;

use super::{Event, Observation, Sink, Statistics};
use crate::calibration::{CameraPose, FusedJoint, Rig, RigOptions, Smoother, Spread};
use crate::cascade::Status;

/// The robot's joints as all cameras together see them, after a frame of one of them.
#[derive(Debug, Clone)]
pub struct Fused {
    /// When the frame was taken, seconds since 1970 by the wall clock.
    pub time_s: f64,
    /// The robot's joints, in the model's order and in the first camera's optical frame; smoothed where that is asked
    /// for.
    pub joints: Vec<FusedJoint>,
    /// Where the cameras are; `None` where nothing says so yet.
    pub poses: Vec<Option<CameraPose>>,
}

/// A sink that puts together what cameras see of one robot.
///
/// It costs some milliseconds now and then, when it looks for the cameras' places anew.
pub struct Fusion<F> {
    /// Each camera's place in the rig, by its place in the configuration.
    places: Vec<Option<usize>>,
    rig: Rig,
    smoother: Option<Smoother>,
    fused: F,
}

impl<F: FnMut(Fused) + Send> Fusion<F> {
    /// `cameras`: the places in the configuration of those that watch this robot, the one whose frame all is in first.
    /// `smoothing_s`: a time constant and lag, none by default ([`Smoother`]). `fused` hears what comes out.
    pub fn new(cameras: &[usize], options: RigOptions, smoothing_s: Option<f64>, fused: F) -> Self {
        let most = cameras.iter().max().map_or(0, |most| most + 1);
        let place = |camera| cameras.iter().position(|&c| c == camera);
        Self {
            places: (0..most).map(place).collect(),
            rig: Rig::new(cameras.len(), options),
            smoother: smoothing_s.map(Smoother::new),
            fused,
        }
    }
}

impl<F: FnMut(Fused) + Send> Sink for Fusion<F> {
    fn observation(&mut self, observation: &Observation) {
        let place = self.places.get(observation.camera).copied().flatten();
        let estimate = &observation.estimate;
        let (Some(place), Status::Found) = (place, estimate.status) else {
            return;
        };
        // Clocks of before 1970 are not set.
        let Ok(time) = observation.acquired.duration_since(UNIX_EPOCH) else {
            return;
        };
        let time_s = time.as_secs_f64();
        let joints = estimate.joints.iter().map(|joint| DVec3::from(joint.xyz_m));
        let joints: Vec<DVec3> = joints.collect();
        let Some(&middle) = joints.get(joints.len() / 2) else {
            return;
        };
        self.rig.observe(place, time_s, &joints, Spread::at(middle));
        let mut joints = self.rig.fused();
        if let Some(smoother) = &mut self.smoother {
            let points: Vec<DVec3> = joints.iter().map(|joint| joint.xyz_m).collect();
            for (joint, smooth) in joints.iter_mut().zip(smoother.step(time_s, &points)) {
                joint.xyz_m = smooth;
            }
        }
        (self.fused)(Fused {
            time_s,
            joints,
            poses: self.rig.poses(),
        });
    }

    fn event(&mut self, _: &Event) {}

    fn statistics(&mut self, _: &Statistics) {}
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    use glam::{DAffine3, DQuat};

    use super::*;
    use crate::camera::Camera;
    use crate::cascade::{Estimate, Joint};

    fn observation(
        camera: usize,
        milliseconds: u64,
        status: Status,
        joints: &[DVec3],
    ) -> Observation {
        let joint = |&xyz: &DVec3| Joint {
            name: "joint".into(),
            xyz_m: xyz.to_array(),
            px: [0.0, 0.0],
        };
        Observation {
            camera,
            frame: 0,
            acquired: UNIX_EPOCH + Duration::from_millis(1_000_000 + milliseconds),
            acquired_at: Instant::now(),
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
        let second_from_first = DAffine3::from_rotation_translation(
            DQuat::from_rotation_y(1.0),
            DVec3::new(1.0, 0.0, 1.0),
        );
        let run = |smoothing_s, cameras: [usize; 2]| {
            let mut all = Vec::new();
            let mut sink = Fusion::new(&cameras, RigOptions::default(), smoothing_s, |f| {
                all.push(f)
            });
            for n in 0..20_u64 {
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
                sink.observation(&observation(3, 100 * n, Status::Found, &joints));
                // Of another robot, and not found.
                sink.observation(&observation(2, 100 * n, Status::Found, &joints));
                sink.observation(&observation(1, 100 * n + 9, Status::NotFound, &[]));
                sink.observation(&observation(
                    1,
                    100 * n + 10,
                    Status::Found,
                    &other.collect::<Vec<_>>(),
                ));
            }
            drop(sink);
            all
        };
        let all = run(None, [3, 1]);
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
        assert!(off(run(None, [1, 3]).last().unwrap()) > 0.1);
        let smooth = run(Some(1.0), [3, 1]);
        assert!(
            smooth.last().unwrap().joints[5]
                .xyz_m
                .distance(last.joints[5].xyz_m)
                > 0.01
        );
    }
}
