use glam::{DAffine3, DQuat, DVec3};
use serde::Serialize;

use super::Summary;
use crate::calibration::{Pair, Rig, RigOptions, Spread, register};

/// What one camera saw at one instant, and the truth.
#[derive(Debug, Clone, PartialEq)]
pub struct RigFrame {
    /// The joints as they were found, camera optical frame, metres; empty where they were not.
    pub found: Vec<DVec3>,
    /// The true ones; empty without a robot.
    pub truth: Vec<DVec3>,
    /// From the base frame to the camera's; `None` without a robot.
    pub camera_from_base: Option<DAffine3>,
}

impl RigFrame {
    /// The true joints in the base frame.
    fn in_base(&self) -> Vec<DVec3> {
        let base = self.camera_from_base.map(|camera| camera.inverse());
        let joints = self.truth.iter();
        joints
            .filter_map(|&joint| Some(base?.transform_point3(joint)))
            .collect()
    }
}

/// How well the robot tells where cameras are, and how good joints of several cameras are together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RigFigures {
    /// How many instants there are.
    pub instants: usize,
    /// In how many each camera found the robot.
    pub found: Vec<usize>,
    /// By the number of frames that a pose was told by.
    pub poses: Vec<PoseFigures>,
    /// By the number of cameras.
    pub together: Vec<TogetherFigures>,
}

/// How far poses of cameras, each told by the joints of some frames and the robot's joint angles, are off.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseFigures {
    /// So many frames; `None` for all in which the robot was found.
    pub frames: Option<usize>,
    /// Poses: up to twenty a camera, no frame in two of them.
    pub tries: usize,
    /// Those that the joints left open: they count no further.
    pub undetermined: usize,
    /// The camera's place, centimetres.
    pub place_cm: Option<Summary>,
    /// The standard deviation that was stated for it.
    pub place_sigma_cm: Option<Summary>,
    /// The camera's rotation, degrees.
    pub turn_deg: Option<Summary>,
    /// The standard deviation that was stated for it.
    pub turn_sigma_deg: Option<Summary>,
}

/// How far joints are off, averaged over the joints of an instant, centimetres; over up to twenty choices of so many
/// cameras, and the second half of the instants.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TogetherFigures {
    /// So many.
    pub cameras: usize,
    /// In the frame of one of them. Where the others are is told by the joints alone.
    pub first_camera_cm: Option<Summary>,
    /// In the base frame. Where the cameras are is told by the joints and the joint angles of the first half.
    pub base_cm: Option<Summary>,
}

impl RigFigures {
    /// Of cameras that stand still: for each its frames, the same instants in the same order.
    pub fn new(cameras: &[Vec<RigFrame>]) -> Self {
        let found = |frames: &Vec<RigFrame>| usable(frames).count();
        let choices = |count: usize| -> Vec<u32> {
            (1..1_u32 << cameras.len().min(16))
                .filter(|choice| choice.count_ones() as usize == count)
                .collect()
        };
        Self {
            instants: cameras.iter().map(Vec::len).min().unwrap_or_default(),
            found: cameras.iter().map(found).collect(),
            poses: [Some(1), Some(5), Some(20), None]
                .into_iter()
                .map(|count| PoseFigures::new(cameras, count))
                .collect(),
            together: (1..=cameras.len())
                .map(|count| TogetherFigures::new(cameras, count, &choices(count)))
                .collect(),
        }
    }
}

fn usable(frames: &[RigFrame]) -> impl Iterator<Item = &RigFrame> {
    let both = |frame: &&RigFrame| !frame.found.is_empty() && !frame.truth.is_empty();
    frames.iter().filter(both)
}

impl PoseFigures {
    /// Poses of one camera that are tried.
    const TRIES: usize = 20;

    fn new(cameras: &[Vec<RigFrame>], count: Option<usize>) -> Self {
        let (mut tries, mut undetermined) = (0, 0);
        let (mut place, mut turn) = (Vec::new(), Vec::new());
        let (mut place_sigma, mut turn_sigma) = (Vec::new(), Vec::new());
        for frames in cameras {
            let frames: Vec<&RigFrame> = usable(frames).collect();
            let most = count.unwrap_or(frames.len());
            if most == 0 || most > frames.len() {
                continue;
            }
            let tries_here = (frames.len() / most).min(Self::TRIES);
            let stride = stride(frames.len());
            for start in 0..tries_here {
                let chosen = (start * most..(start + 1) * most)
                    .filter_map(|n| frames.get(n * stride % frames.len()));
                let images: Vec<(&[DVec3], Vec<DVec3>)> = chosen
                    .map(|frame| (frame.found.as_slice(), frame.in_base()))
                    .collect();
                let images = images.iter().map(|(found, base)| (*found, base.as_slice()));
                tries += 1;
                let truth = frames.first().and_then(|frame| frame.camera_from_base);
                let found = register(&Pair::of_images(images));
                let (Ok(found), Some(truth)) = (found, truth) else {
                    undetermined += 1;
                    continue;
                };
                let truth = truth.inverse();
                let off = found.transform.translation.distance(truth.translation);
                place.push(100.0 * off);
                turn.push(angle(found.transform, truth).to_degrees());
                place_sigma.push(100.0 * found.translation_sigma_m());
                turn_sigma.push(found.rotation_sigma_rad().to_degrees());
            }
        }
        Self {
            frames: count,
            tries,
            undetermined,
            place_cm: Summary::of(place),
            place_sigma_cm: Summary::of(place_sigma),
            turn_deg: Summary::of(turn),
            turn_sigma_deg: Summary::of(turn_sigma),
        }
    }
}

/// Steps that visit each of so many frames once, each far from the one before: a recording's neighbours are alike.
fn stride(frames: usize) -> usize {
    let common = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let golden = (0.618 * frames as f64) as usize;
    let mut strides = (1..=golden).rev();
    strides.find(|&step| common(step, frames) == 1).unwrap_or(1)
}

/// Between two rotations, radians.
fn angle(a: DAffine3, b: DAffine3) -> f64 {
    let between = DQuat::from_mat3(&(a.matrix3 * b.matrix3.transpose()));
    2.0 * between.xyz().length().atan2(between.w.abs())
}

impl TogetherFigures {
    /// Choices of cameras that are tried.
    const CHOICES: usize = 20;

    /// Of `choices` each has a bit set for each of its cameras.
    fn new(cameras: &[Vec<RigFrame>], count: usize, choices: &[u32]) -> Self {
        let (mut first_camera, mut base) = (Vec::new(), Vec::new());
        for choice in choices
            .iter()
            .step_by(choices.len().div_ceil(Self::CHOICES).max(1))
        {
            let chosen = cameras.iter().enumerate();
            let chosen = chosen.filter(|(index, _)| choice >> index & 1 == 1);
            let mut chosen: Vec<&[RigFrame]> =
                chosen.map(|(_, frames)| frames.as_slice()).collect();
            base.extend(errors(&chosen, true));
            for _ in 0..chosen.len() {
                first_camera.extend(errors(&chosen, false));
                chosen.rotate_left(1);
            }
        }
        Self {
            cameras: count,
            first_camera_cm: Summary::of(first_camera),
            base_cm: Summary::of(base),
        }
    }
}

/// How far fused joints are off, an instant of the second half each, centimetres: in the base frame if the cameras are
/// to be calibrated in the first half, else in the first camera's.
fn errors(cameras: &[&[RigFrame]], calibrated: bool) -> Vec<f64> {
    // The cameras stand still, and the robot's poses are not a motion.
    let options = RigOptions {
        memory_s: 1e4,
        simultaneous_s: 0.5,
    };
    let robot = usize::from(calibrated);
    let mut rig = Rig::new(robot + cameras.len(), options);
    let instants = cameras.iter().map(|frames| frames.len()).min();
    let instants = instants.unwrap_or_default();
    let mut errors = Vec::new();
    for instant in 0..instants {
        let time = instant as f64;
        let frames = cameras.iter().filter_map(|frames| frames.get(instant));
        let learning = instant < instants / 2;
        let Some(first) = frames.clone().next() else {
            continue;
        };
        let truth = if calibrated {
            first.in_base()
        } else {
            first.truth.clone()
        };
        if calibrated && learning {
            rig.observe(0, time, &truth, Spread::even(1e-3));
        }
        let mut seen = false;
        for (camera, frame) in (robot..).zip(frames) {
            if let Some(&middle) = frame.found.get(frame.found.len() / 2) {
                rig.observe(camera, time, &frame.found, Spread::at(middle));
                seen = true;
            }
        }
        if learning || !seen || truth.is_empty() {
            continue;
        }
        let fused = rig.fused();
        let off = fused.iter().zip(&truth);
        let off: f64 = off.map(|(joint, truth)| joint.xyz_m.distance(*truth)).sum();
        if !fused.is_empty() {
            errors.push(100.0 * off / fused.len() as f64);
        }
    }
    errors
}
