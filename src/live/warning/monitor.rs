use std::time::{Duration, Instant};

use super::config::{Config, ConfigError, Expect, Observer, Policy, Protect, Rule};
use super::geometry::{Pose, Zone, distance};
use super::judge::{Judge, Level};
use super::{State, Warning, Why};
use crate::cascade::{Estimate, Status};
use crate::live::EventKind;

/// A warning, and the place in the configuration of the camera that it comes from.
pub type Told = (Option<usize>, Warning);

/// Judges what all cameras find by all rules. It has no clock and does nothing: callers say when it is, and get what
/// changed.
#[derive(Debug)]
pub struct Monitor {
    rules: Vec<RuleMonitor>,
}

#[derive(Debug)]
struct RuleMonitor {
    name: String,
    policy: Policy,
    expect: Expect,
    zones: Vec<Zone>,
    views: Vec<View>,
    told: Option<State>,
}

/// A camera under a rule.
#[derive(Debug)]
struct View {
    camera: usize,
    /// Into the frame that the rule's zones are in.
    pose: Pose,
    uncertainty_m: f64,
    judge: Judge,
}

/// What makes a rule be judged again.
#[derive(Clone, Copy)]
struct Cause {
    camera: usize,
    frame: Option<u64>,
    latency: Option<Duration>,
}

impl Monitor {
    /// All rules are unknown. `cameras` are in the order of
    /// [`Observation::camera`](crate::live::Observation::camera).
    ///
    /// # Errors
    /// What [`Config::check`] finds.
    pub fn new(config: &Config, cameras: &[Observer]) -> Result<Self, ConfigError> {
        config.check(cameras)?;
        Ok(Self {
            rules: config
                .rules
                .iter()
                .map(|rule| RuleMonitor::new(rule, cameras))
                .collect(),
        })
    }

    /// Camera `camera` took frame `frame` at `acquired_at`, and this was found in it. What changed.
    pub fn frame(
        &mut self,
        camera: usize,
        frame: u64,
        acquired_at: Instant,
        estimate: &Estimate,
        now: Instant,
    ) -> Vec<Told> {
        let cause = Cause {
            camera,
            frame: Some(frame),
            latency: Some(now.saturating_duration_since(acquired_at)),
        };
        self.judge(Some(cause), |rule| {
            let RuleMonitor { zones, views, .. } = rule;
            for view in views {
                if view.camera == camera {
                    let found = view.distance_m(estimate, zones);
                    view.judge.frame(acquired_at, found, now);
                } else {
                    view.judge.tick(now);
                }
            }
        })
    }

    /// Something happened to a camera, or to all. What changed.
    pub fn event(&mut self, camera: Option<usize>, kind: &EventKind, now: Instant) -> Vec<Told> {
        let why = match kind {
            EventKind::Stale => Why::Stale,
            EventKind::Failed { .. } => Why::Failed,
            EventKind::Ended => Why::Ended,
            EventKind::DeviceLost { .. } => Why::DeviceLost,
            _ => return Vec::new(),
        };
        let cause = camera.map(|camera| Cause {
            camera,
            frame: None,
            latency: None,
        });
        self.judge(cause, |rule| {
            for view in &mut rule.views {
                if camera.is_none_or(|camera| camera == view.camera) {
                    view.judge.lost(why, now);
                }
            }
        })
    }

    /// Time passes. What changed; every rule's state where none was told yet.
    pub fn tick(&mut self, now: Instant) -> Vec<Told> {
        self.judge(None, |rule| {
            for view in &mut rule.views {
                view.judge.tick(now);
            }
        })
    }

    fn judge(
        &mut self,
        cause: Option<Cause>,
        mut judge: impl FnMut(&mut RuleMonitor),
    ) -> Vec<Told> {
        let judged = |rule: &mut RuleMonitor| {
            judge(rule);
            rule.tell(cause)
        };
        self.rules.iter_mut().filter_map(judged).collect()
    }
}

impl RuleMonitor {
    fn new(rule: &Rule, cameras: &[Observer]) -> Self {
        let (zones, worn) = match rule.protect.get_ref() {
            Protect::Camera(_) => (vec![Zone::ORIGIN], true),
            Protect::Places(places) => {
                let points = places.points_m.iter().copied().map(Zone::point);
                (
                    points.chain(places.boxes_m.iter().copied()).collect(),
                    false,
                )
            }
        };
        let views = cameras
            .iter()
            .enumerate()
            .filter(|(_, camera)| {
                let names = rule.cameras.get_ref();
                names.iter().any(|name| *name.get_ref() == camera.name)
            })
            .map(|(index, camera)| View {
                camera: index,
                pose: camera
                    .world_from_camera
                    .filter(|_| !worn)
                    .unwrap_or(Pose::IDENTITY),
                // The check saw one; without, nothing would be clear.
                uncertainty_m: rule.uncertainty_m(camera).unwrap_or(f64::INFINITY),
                judge: Judge::new(rule.limits()),
            })
            .collect();
        Self {
            name: rule.name.get_ref().clone(),
            policy: rule.unknown,
            expect: rule.expect,
            zones,
            views,
            told: None,
        }
    }

    /// The camera that says the most dangerous, as far as unknown counts.
    fn worst(&self) -> Option<&View> {
        let known = |view: &&View| view.judge.judged().is_ok();
        let any_known = self.views.iter().any(|view| known(&view));
        let counts = |view: &&View| match self.expect {
            Expect::All => true,
            Expect::Any => known(view) || !any_known,
        };
        // Of the same danger, the nearer one.
        let nearer = |a: &View, b: &View| {
            let [a, b] = [a, b].map(|view| view.judge.distance_m().unwrap_or(f64::INFINITY));
            b.total_cmp(&a)
        };
        self.views.iter().filter(counts).max_by(|a, b| {
            let [rank_a, rank_b] = [a, b].map(|view| rank(view.judge.judged(), self.policy));
            rank_a.cmp(&rank_b).then_with(|| nearer(a, b))
        })
    }

    fn tell(&mut self, cause: Option<Cause>) -> Option<Told> {
        let worst = self.worst()?;
        let judged = worst.judge.judged();
        let state = judged.map_or(State::Unknown, State::from);
        if self.told == Some(state) {
            return None;
        }
        // Another camera's state may come to the fore, as time passes for all.
        let cause = cause.filter(|cause| cause.camera == worst.camera);
        let warning = Warning {
            rule: self.name.clone(),
            state,
            before: self.told,
            acted_as: self.told.map(|before| acts_as(before, self.policy)),
            acts_as: acts_as(state, self.policy),
            distance_m: worst
                .judge
                .distance_m()
                .map(|m| rounded(m + worst.uncertainty_m, 1e5)),
            uncertainty_m: judged.ok().map(|_| worst.uncertainty_m),
            why: judged.err(),
            frame: cause.and_then(|cause| cause.frame),
            latency_ms: cause
                .and_then(|cause| cause.latency)
                .map(|latency| rounded(1e3 * latency.as_secs_f64(), 1e2)),
        };
        let told = (Some(worst.camera), warning);
        self.told = Some(state);
        Some(told)
    }
}

impl View {
    /// The distance in metres, less the uncertainty.
    fn distance_m(&self, estimate: &Estimate, zones: &[Zone]) -> Result<f64, Why> {
        match estimate.status {
            Status::Found => {
                let place =
                    |joint: &crate::cascade::Joint| self.pose.world_from_camera(joint.xyz_m);
                let joints: Vec<_> = estimate.joints.iter().map(place).collect();
                let measured_m = distance(&joints, zones).ok_or(Why::Invalid)?;
                Ok(measured_m - self.uncertainty_m)
            }
            Status::NotFound => Err(Why::NotFound),
            Status::Invalid => Err(Why::Invalid),
        }
    }
}

/// To whole parts, so many a unit: what is printed says no more than is known.
fn rounded(value: f64, parts: f64) -> f64 {
    (value * parts).round() / parts
}

/// What a state counts as.
fn acts_as(state: State, policy: Policy) -> State {
    match (state, policy) {
        (State::Unknown, Policy::Warn) => State::Warn,
        (State::Unknown, Policy::Stop) => State::Stop,
        (state, _) => state,
    }
}

/// The order of danger. What is known goes before the unknown that counts as much; unknown goes before clear always.
fn rank(judged: Result<Level, Why>, policy: Policy) -> u8 {
    match (judged, policy) {
        (Ok(Level::Clear), _) => 0,
        (Err(_), Policy::Ignore) => 1,
        (Err(_), Policy::Warn) => 2,
        (Ok(Level::Warn), _) => 3,
        (Err(_), Policy::Stop) => 4,
        (Ok(Level::Stop), _) => 5,
    }
}
