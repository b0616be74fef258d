use std::fmt;
use std::time::{Instant, UNIX_EPOCH};

use glam::DVec3;

use super::{Event, Observation, Sink, Statistics};
use crate::calibration::{CameraPose, FusedJoint, Rig, RigOptions, Smoother, Spread};
use crate::cascade::Status;

/// The robot's joints as all cameras together see them, after a frame of one of them that is of the newest instant.
#[derive(Debug, Clone)]
pub struct Fused {
    /// The rig's place in the configuration.
    pub rig: usize,
    /// When the newest frame of any of the cameras was taken, seconds since 1970 by the wall clock.
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
    number: usize,
    /// Each camera's place in the rig, by its place in the configuration.
    places: Vec<Option<usize>>,
    rig: Rig,
    simultaneous_s: f64,
    /// When the newest frame was taken, seconds after the first one, and by the wall clock.
    newest: Option<[f64; 2]>,
    /// When the first frame was taken. The wall clock may be set back, and would have the rig wait until it is where it was.
    started: Option<Instant>,
    smoother: Option<Smoother>,
    fused: F,
}

impl<F> fmt::Debug for Fusion<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Fusion")
            .field("number", &self.number)
            .field("rig", &self.rig)
            .finish_non_exhaustive()
    }
}

impl<F: FnMut(Fused) + Send> Fusion<F> {
    /// `number`: the rig's place in the configuration. `cameras`: the places in the configuration of those that watch this robot, the one whose frame all is in first.
    /// `smoothing_s`: a time constant and lag, none by default ([`Smoother`]). `fused` hears what comes out.
    pub fn new(
        number: usize,
        cameras: &[usize],
        options: RigOptions,
        smoothing_s: Option<f64>,
        fused: F,
    ) -> Self {
        let most = cameras.iter().max().map_or(0, |most| most + 1);
        let place = |camera| cameras.iter().position(|&c| c == camera);
        Self {
            number,
            places: (0..most).map(place).collect(),
            rig: Rig::new(cameras.len(), options),
            simultaneous_s: options.simultaneous_s,
            newest: None,
            started: None,
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
        let at = observation.acquired_at;
        let started = *self.started.get_or_insert(at);
        let since = at.saturating_duration_since(started).as_secs_f64()
            - started.saturating_duration_since(at).as_secs_f64();
        self.rig.observe(place, since, &joints, Spread::at(middle));
        let newest = self.newest.get_or_insert([since, time_s]);
        if since > newest[0] {
            *newest = [since, time_s];
        }
        let [newest, time_s] = *newest;
        // Behind what was said already.
        if newest - since > self.simultaneous_s {
            return;
        }
        let mut joints = self.rig.fused();
        if let Some(smoother) = &mut self.smoother {
            let points: Vec<DVec3> = joints.iter().map(|joint| joint.xyz_m).collect();
            for (joint, smooth) in joints.iter_mut().zip(smoother.step(newest, &points)) {
                joint.xyz_m = smooth;
            }
        }
        (self.fused)(Fused {
            rig: self.number,
            time_s,
            joints,
            poses: self.rig.poses(),
        });
    }

    fn event(&mut self, _: &Event) {}

    fn statistics(&mut self, _: &Statistics) {}
}
