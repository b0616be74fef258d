use std::collections::VecDeque;

use glam::{DAffine3, DMat3, DVec3};

use super::eigen::inverse;
use super::registration::{P99_CHI_3, carried, is_same_pose, jacobian, trace};
use super::{Pair, Registration, register};

/// How far a joint's estimate may be off: standard deviations, metres. Depth is what a single image tells least of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Across the ray from the camera to the joint, along each of two axes.
    pub across_m: f64,
    /// Along the ray.
    pub along_m: f64,
}

impl Spread {
    /// The same in all directions.
    pub fn even(sigma_m: f64) -> Self {
        Self {
            across_m: sigma_m,
            along_m: sigma_m,
        }
    }

    /// That of the shipped weights for a joint at `point`, camera optical frame: it grows with the distance, and is
    /// larger along the ray (`docs/calibration.md`).
    pub fn at(point: DVec3) -> Self {
        let distance = point.length();
        Self {
            across_m: 0.03 * distance,
            along_m: 0.09 * distance,
        }
    }

    /// The covariance of a joint's error, square metres; camera optical frame.
    pub fn covariance(&self, joint: DVec3) -> DMat3 {
        let ray = joint.normalize_or(DVec3::Z);
        let along = DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
        let (across, more) = (
            self.across_m * self.across_m,
            self.along_m * self.along_m - self.across_m * self.across_m,
        );
        DMat3::from_diagonal(DVec3::splat(across)) + along * more
    }
}

/// How a rig of cameras forgets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigOptions {
    /// In this time, seconds, what was seen loses weight by `e`; after three times this it is forgotten. Short for
    /// cameras that move, long for cameras that stand.
    pub memory_s: f64,
    /// Frames of two cameras are of one instant if they are no more seconds apart.
    pub simultaneous_s: f64,
}

impl Default for RigOptions {
    /// 5 s and 50 ms.
    fn default() -> Self {
        Self {
            memory_s: 5.0,
            simultaneous_s: 0.05,
        }
    }
}

/// Where a camera is, in the frame of the rig's first camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraPose {
    /// From the camera's optical frame to that of the first camera, metres.
    pub first_from_camera: DAffine3,
    /// As [`Registration::covariance`].
    pub covariance: [[f64; 6]; 6],
    /// Share of joints that agree with it, in [0, 1]; the least on the way where cameras between are needed.
    pub inlier_share: f64,
}

impl CameraPose {
    const FIRST: Self = Self {
        first_from_camera: DAffine3::IDENTITY,
        covariance: [[0.0; 6]; 6],
        inlier_share: 1.0,
    };

    /// Standard deviation of the rotation's angle, radians.
    pub fn rotation_sigma_rad(&self) -> f64 {
        trace(&self.covariance, 0).sqrt()
    }

    /// Standard deviation of the camera's place in space, metres.
    pub fn translation_sigma_m(&self) -> f64 {
        trace(&self.covariance, 3).sqrt()
    }

    /// `self`, then from there to a camera that is registered to this one.
    fn then(&self, next: &Registration) -> Self {
        let turn = self.first_from_camera.matrix3;
        let lever = turn * next.transform.translation;
        // The first rotation's error moves what is behind it, too.
        let mut of_first = [[0.0; 6]; 6];
        let mut of_next = [[0.0; 6]; 6];
        for (j, column) in jacobian(lever).into_iter().enumerate() {
            for i in 0..3 {
                of_first[i][j] = f64::from(u8::from(i == j));
                of_first[i + 3][j] = column[i];
                of_next[i][j] = if j < 3 { turn.col(j)[i] } else { 0.0 };
                of_next[i + 3][j] = if j < 3 { 0.0 } else { turn.col(j - 3)[i] };
            }
        }
        let first = carried(of_first, self.covariance);
        let next_part = carried(of_next, next.covariance);
        Self {
            first_from_camera: self.first_from_camera * next.transform,
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| first[i][j] + next_part[i][j])
            }),
            inlier_share: self.inlier_share.min(next.inlier_share()),
        }
    }

    /// The covariance that the pose's error gives to a point, given in the camera's frame.
    fn covariance_at(&self, point: DVec3) -> DMat3 {
        let jacobian = jacobian(self.first_from_camera.matrix3 * point);
        let mut covariance = DMat3::ZERO;
        for (a, row) in jacobian.into_iter().zip(self.covariance) {
            for (b, value) in jacobian.into_iter().zip(row) {
                covariance += DMat3::from_cols(a * b.x, a * b.y, a * b.z) * value;
            }
        }
        covariance
    }
}

/// A joint as all cameras together see it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusedJoint {
    /// In the optical frame of the rig's first camera, metres.
    pub xyz_m: DVec3,
    /// Of its error, square metres, from the cameras' spreads and the poses' covariances.
    pub covariance: DMat3,
    /// How many cameras say so; one that disagrees with the others is left out.
    pub cameras: usize,
}

/// What a camera saw last.
#[derive(Debug, Clone)]
struct Seen {
    time_s: f64,
    joints: Vec<DVec3>,
    spread: Spread,
}

/// Two cameras that saw the robot at the same time.
#[derive(Debug, Clone, Default)]
struct Link {
    instants: VecDeque<Instant>,
    /// Poses of the robot so far.
    poses: usize,
    /// When it was last found, and the way to the camera of the lower number and back.
    found: Option<(f64, Registration, Registration)>,
}

/// What two cameras saw at the same time.
#[derive(Debug, Clone)]
struct Instant {
    time_s: f64,
    /// From the camera of the higher number to that of the lower, in a group that is the robot's pose.
    pairs: Vec<Pair>,
}

/// Cameras that see the same robot: where each is by the joints that two see at the same time, and where the joints are
/// by all of them. Cameras may move, and nothing is known of them before.
///
/// All is in the optical frame of the first camera, which may move too. Where the robot's joint angles are known, let
/// the first camera be the robot itself: its joints by its kinematics, in its base frame, with a spread of millimetres;
/// all is then in the base frame.
#[derive(Debug, Clone)]
pub struct Rig {
    options: RigOptions,
    seen: Vec<Option<Seen>>,
    /// Of cameras `a < b`, at `b (b - 1) / 2 + a`.
    links: Vec<Link>,
}

/// Instants that two cameras' memory holds at most: more would cost more and say no more.
const INSTANTS: usize = 40;

impl Rig {
    /// For so many cameras.
    pub fn new(cameras: usize, options: RigOptions) -> Self {
        Self {
            options,
            seen: vec![None; cameras],
            links: vec![Link::default(); cameras * cameras.saturating_sub(1) / 2],
        }
    }

    /// Takes what `camera` saw at `time_s`, on a clock that all cameras share: the robot's joints, the same ones in the
    /// same order for every camera, in its optical frame, metres. Frames of one camera come in order; an earlier
    /// one, a camera that the rig does not have, and joints that are not finite are passed over.
    pub fn observe(&mut self, camera: usize, time_s: f64, joints: &[DVec3], spread: Spread) {
        let finite = time_s.is_finite() && joints.iter().all(|joint| joint.is_finite());
        let Some(slot) = self.seen.get_mut(camera).filter(|_| finite) else {
            return;
        };
        if slot.as_ref().is_some_and(|seen| seen.time_s >= time_s) {
            return;
        }
        let new = slot.insert(Seen {
            time_s,
            joints: joints.to_vec(),
            spread,
        });
        let new = new.clone();
        for other in (0..self.seen.len()).filter(|&other| other != camera) {
            let Some(Some(seen)) = self.seen.get(other) else {
                continue;
            };
            if (seen.time_s - time_s).abs() > self.options.simultaneous_s {
                continue;
            }
            let (low, high) = if other < camera {
                (seen, &new)
            } else {
                (&new, seen)
            };
            let index = place(camera.min(other), camera.max(other));
            if let Some(link) = self.links.get_mut(index) {
                link.add(time_s, low, high, &self.options);
            }
        }
    }

    /// Where `camera` is; `None` as long as too little says so, or what says so is forgotten.
    pub fn pose(&self, camera: usize) -> Option<CameraPose> {
        self.poses().get(camera).copied().flatten()
    }

    /// Where all cameras are: over the surest way from the first camera, by those that see the robot with it.
    pub fn poses(&self) -> Vec<Option<CameraPose>> {
        let cameras = self.seen.len();
        let mut poses: Vec<Option<CameraPose>> = vec![None; cameras];
        let mut done = vec![false; cameras];
        if let Some(first) = poses.first_mut() {
            *first = Some(CameraPose::FIRST);
        }
        // Dijkstra's way, by the place's variance, which only grows.
        loop {
            let open = (0..cameras).filter(|&c| !done.get(c).is_some_and(|&d| d));
            let open = open.filter_map(|c| Some((c, poses.get(c).copied().flatten()?)));
            let variance = |pose: &CameraPose| trace(&pose.covariance, 3);
            let next = open.min_by(|(_, a), (_, b)| variance(a).total_cmp(&variance(b)));
            let Some((camera, pose)) = next else {
                return poses;
            };
            if let Some(done) = done.get_mut(camera) {
                *done = true;
            }
            for (other, slot) in poses.iter_mut().enumerate() {
                let Some(step) = self.registration(camera, other) else {
                    continue;
                };
                let there = pose.then(step);
                if slot.is_none_or(|slot| variance(&there) < variance(&slot)) {
                    *slot = Some(there);
                }
            }
        }
    }

    /// From camera `from` to camera `to`, where they see the robot together.
    fn registration(&self, to: usize, from: usize) -> Option<&Registration> {
        if to == from {
            return None;
        }
        let link = self.links.get(place(to.min(from), to.max(from)))?;
        let (_, down, up) = link.found.as_ref()?;
        let last = link.instants.back()?;
        let remembered = self.newest() - last.time_s <= 3.0 * self.options.memory_s;
        remembered.then_some(if to < from { down } else { up })
    }

    /// When any camera saw the robot last.
    fn newest(&self) -> f64 {
        let times = self.seen.iter().flatten().map(|seen| seen.time_s);
        times.fold(f64::NEG_INFINITY, f64::max)
    }

    /// The joints at the newest instant, by all cameras that saw the robot then and whose place is known. Empty as long
    /// as there is none.
    ///
    /// Each camera's joint counts by the inverse of its covariance. Of three or more, one that is farther from the one
    /// that agrees best with the rest than 99 % of such errors is left out.
    pub fn fused(&self) -> Vec<FusedJoint> {
        let seen = self.seen.iter().zip(self.poses());
        let seen = seen.filter_map(|(seen, pose)| Some((seen.as_ref()?, pose?)));
        let seen: Vec<(&Seen, CameraPose)> = seen.collect();
        // What a camera of unknown place sees is newer than what others saw before.
        let newest = self.newest();
        let now = seen
            .iter()
            .filter(|(seen, _)| newest - seen.time_s <= self.options.simultaneous_s);
        let joints = now.clone().map(|(seen, _)| seen.joints.len()).max();
        (0..joints.unwrap_or_default())
            .filter_map(|joint| {
                let views = now.clone().filter_map(|(seen, pose)| {
                    let point = *seen.joints.get(joint)?;
                    let turn = pose.first_from_camera.matrix3;
                    let covariance = turn * seen.spread.covariance(point) * turn.transpose()
                        + pose.covariance_at(point);
                    Some((pose.first_from_camera.transform_point3(point), covariance))
                });
                fuse(&views.collect::<Vec<_>>())
            })
            .collect()
    }
}

/// Where the link of two cameras is kept.
fn place(low: usize, high: usize) -> usize {
    high * high.saturating_sub(1) / 2 + low
}

impl Link {
    fn add(&mut self, time_s: f64, low: &Seen, high: &Seen, options: &RigOptions) {
        let memory = options.memory_s;
        // While both cameras and the robot stand, the networks err alike.
        let same = |instant: &&Instant| {
            let [from, to]: [Vec<DVec3>; 2] = [
                instant.pairs.iter().map(|pair| pair.from).collect(),
                instant.pairs.iter().map(|pair| pair.to).collect(),
            ];
            is_same_pose(&from, &high.joints) && is_same_pose(&to, &low.joints)
        };
        let kept = self.instants.iter().rfind(same);
        let pose = kept.and_then(|kept| kept.pairs.first());
        let group = pose.map_or(self.poses, |pair| pair.group);
        self.poses = self.poses.max(group + 1);
        let joints = high.joints.iter().zip(&low.joints);
        let pairs = joints.map(|(&from, &to)| Pair {
            from,
            from_covariance: high.spread.covariance(from),
            to,
            to_covariance: low.spread.covariance(to),
            weight: 1.0,
            group,
        });
        let pairs = pairs.collect();
        self.instants.push_back(Instant { time_s, pairs });
        while let Some(first) = self.instants.front()
            && time_s - first.time_s > 3.0 * memory
        {
            self.instants.pop_front();
        }
        if self.instants.len() > INSTANTS {
            self.thin();
        }
        // A twentieth of the memory changes little.
        let often = (0.05 * memory).min(1.0);
        if self
            .found
            .as_ref()
            .is_some_and(|(then, ..)| time_s - then < often)
        {
            return;
        }
        let weighed = self.instants.iter().flat_map(|instant| {
            let weight = ((instant.time_s - time_s) / memory).exp();
            let pairs = instant.pairs.iter();
            pairs.map(move |&pair| Pair { weight, ..pair })
        });
        if let Ok(found) = register(&weighed.collect::<Vec<_>>()) {
            let back = found.inverse();
            self.found = Some((time_s, found, back));
        }
    }

    /// Leaves out the instant that is closest to its neighbours, neither the oldest nor the newest.
    fn thin(&mut self) {
        let times: Vec<f64> = self.instants.iter().map(|i| i.time_s).collect();
        let gaps = times.windows(3).map(|w| w[2] - w[0]).enumerate();
        if let Some((before, _)) = gaps.min_by(|a, b| a.1.total_cmp(&b.1)) {
            self.instants.remove(before + 1);
        }
    }
}

/// The mean of positions, each weighted by the inverse of its covariance.
fn fuse(views: &[(DVec3, DMat3)]) -> Option<FusedJoint> {
    let apart = |a: &(DVec3, DMat3), b: &(DVec3, DMat3)| {
        let between = a.0 - b.0;
        between.dot((a.1 + b.1).inverse() * between)
    };
    let centre = views.iter().min_by(|a, b| {
        let sum = |view| -> f64 { views.iter().map(|other| apart(view, other).sqrt()).sum() };
        sum(a).total_cmp(&sum(b))
    })?;
    let (mut information, mut weighted, mut cameras) = (DMat3::ZERO, DVec3::ZERO, 0);
    for view in views {
        // Of two, neither is known to be the wrong one.
        if views.len() > 2 && apart(view, centre) > P99_CHI_3 * P99_CHI_3 {
            continue;
        }
        let weight = view.1.inverse();
        information += weight;
        weighted += weight * view.0;
        cameras += 1;
    }
    let covariance = DMat3::from_cols_array_2d(&inverse(information.to_cols_array_2d())?);
    Some(FusedJoint {
        xyz_m: covariance * weighted,
        covariance,
        cameras,
    })
}
