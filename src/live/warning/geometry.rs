use glam::{DQuat, DVec3};
use serde::Deserialize;

/// Where a camera is: from its optical frame (REP 103: x right, y down, z forward) to the common frame.
/// `p_world = rotation * p_camera + translation`, as in ROS's `geometry_msgs/Transform`.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "PoseTable")]
pub struct Pose {
    translation: DVec3,
    rotation: DQuat,
}

/// A pose as cameras.toml has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseTable {
    translation_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

impl Pose {
    /// The common frame is the camera's.
    pub const IDENTITY: Self = Self {
        translation: DVec3::ZERO,
        rotation: DQuat::IDENTITY,
    };

    /// Of a translation in metres and a unit quaternion `[x, y, z, w]`.
    ///
    /// # Errors
    /// What was expected and found, where a value is not finite or the quaternion is not of length 1 within 1 %.
    pub fn new(translation_m: [f64; 3], rotation_xyzw: [f64; 4]) -> Result<Self, String> {
        let translation = DVec3::from(translation_m);
        if !translation.is_finite() {
            return Err(format!(
                "translation_m: expected finite metres, found {translation_m:?}"
            ));
        }
        let rotation = DQuat::from_array(rotation_xyzw);
        // Printed quaternions are rounded. What is far from a unit is something else, such as angles.
        if !(0.99..=1.01).contains(&rotation.length()) {
            return Err(format!(
                "rotation_xyzw: expected a quaternion of length 1, found {rotation_xyzw:?}"
            ));
        }
        Ok(Self {
            translation,
            rotation: rotation.normalize(),
        })
    }

    /// A point of the camera's frame in the common frame, in metres.
    pub fn world_from_camera(&self, point: [f64; 3]) -> [f64; 3] {
        (self.rotation * DVec3::from(point) + self.translation).to_array()
    }

    /// The translation, in metres.
    pub fn translation_m(&self) -> [f64; 3] {
        self.translation.to_array()
    }

    /// The rotation as a unit quaternion `[x, y, z, w]`.
    pub fn rotation_xyzw(&self) -> [f64; 4] {
        self.rotation.to_array()
    }
}

impl TryFrom<PoseTable> for Pose {
    type Error = String;

    fn try_from(table: PoseTable) -> Result<Self, String> {
        Self::new(table.translation_m, table.rotation_xyzw)
    }
}

/// A box along the axes of its frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "ZoneTable")]
pub struct Zone {
    min: DVec3,
    max: DVec3,
}

/// A box as cameras.toml has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ZoneTable {
    min: [f64; 3],
    max: [f64; 3],
}

impl TryFrom<ZoneTable> for Zone {
    type Error = String;

    fn try_from(ZoneTable { min, max }: ZoneTable) -> Result<Self, String> {
        Self::new(min, max)
    }
}

impl Zone {
    /// From the least to the greatest coordinates; a point where they are the same.
    ///
    /// # Errors
    /// What was expected and found, where a value is not finite or `min` is beyond `max`.
    pub fn new(min: [f64; 3], max: [f64; 3]) -> Result<Self, String> {
        let finite = min.iter().chain(&max).all(|v| v.is_finite());
        if finite && min.iter().zip(&max).all(|(min, max)| min <= max) {
            Ok(Self {
                min: min.into(),
                max: max.into(),
            })
        } else {
            Err(format!(
                "expected finite metres, min no greater than max, found min {min:?}, max {max:?}"
            ))
        }
    }

    /// The origin of the frame.
    pub const ORIGIN: Self = Self::point_at(DVec3::ZERO);

    /// A single point, in metres.
    pub fn point(at: [f64; 3]) -> Self {
        Self::point_at(at.into())
    }

    const fn point_at(at: DVec3) -> Self {
        Self { min: at, max: at }
    }

    /// To a point from the nearest point of the box: zero within it.
    fn offset(&self, point: DVec3) -> DVec3 {
        point - point.clamp(self.min, self.max)
    }

    /// The shortest distance from the segment between two points.
    fn distance_to_segment(&self, from: DVec3, to: DVec3) -> f64 {
        let way = to - from;
        // Along the segment the squared distance is convex: its slope, `2 offset . way`, rises, and its zero is found
        // by halving until f64 has no number in between.
        let (mut before, mut beyond) = (0.0, 1.0);
        for _ in 0..54 {
            let middle = 0.5 * (before + beyond);
            if self.offset(from + middle * way).dot(way) > 0.0 {
                beyond = middle;
            } else {
                before = middle;
            }
        }
        [0.0, before, 1.0]
            .map(|along| self.offset(from + along * way).length())
            .into_iter()
            .fold(f64::INFINITY, f64::min)
    }
}

/// The shortest distance, in metres, from any of the zones to the arm: to the straight lines that join consecutive
/// joints. All are in one frame. `None` without joints or zones, and where a coordinate is not finite.
pub fn distance(joints: &[[f64; 3]], zones: &[Zone]) -> Option<f64> {
    let finite = joints.iter().flatten().all(|v| v.is_finite());
    let single = joints.first().filter(|_| joints.len() == 1);
    let links = joints
        .windows(2)
        .filter_map(|pair| Some((pair.first()?, pair.get(1)?)))
        .chain(single.map(|joint| (joint, joint)));
    links
        .filter(|_| finite)
        .flat_map(|(&from, &to)| {
            zones
                .iter()
                .map(move |zone| zone.distance_to_segment(from.into(), to.into()))
        })
        .min_by(f64::total_cmp)
}
