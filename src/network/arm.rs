use serde::{Deserialize, Serialize};

/// What is known of an arm and of the joint network's errors: what the kinematic fit needs to move joints to where an arm can
/// have them ([`kinematic_fit`](crate::reference::kinematic_fit())).
///
/// Its joints are those of Universal Robots' arms: `shoulder_pan`, `shoulder_lift`, `elbow`, `wrist_1`, `wrist_2` and `wrist_3`,
/// of which the second, third and fourth turn about parallel axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// The links of each body that was trained on, as a series of a maker is not built like the next. The one that fits best is
    /// taken.
    pub bodies: Vec<Links>,
    /// Whitens errors across the line of sight, in metres at the arm's mean depth: by it, those of the six joints become
    /// independent and of variance 1.
    pub across: [[f32; Self::JOINTS]; Self::JOINTS],
    /// Whitens errors of the logarithm of depth, likewise.
    pub along: [[f32; Self::JOINTS]; Self::JOINTS],
}

/// Distances from joint to joint, in metres; along the axis that `shoulder_lift`, `elbow` and `wrist_1` have in common, or at a
/// right angle to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Links {
    /// From `shoulder_pan` to `shoulder_lift`, along the axis.
    pub shoulder_offset: f32,
    /// From `shoulder_lift` to `elbow`, at a right angle to the axis.
    pub upper_arm: f32,
    /// From `shoulder_lift` to `elbow`, along the axis; negative where it leads back.
    pub elbow_offset: f32,
    /// From `elbow` to `wrist_1`, at a right angle to the axis.
    pub forearm: f32,
    /// From `wrist_1` to `wrist_2`, along the axis.
    pub wrist_offset: f32,
    /// From `wrist_2` to `wrist_3`, at a right angle to the axis.
    pub wrist: f32,
}

impl Arm {
    /// Joints of the arms that are known.
    pub const JOINTS: usize = 6;

    /// Checks what the types do not say.
    pub(super) fn check(&self, joints: usize) -> Result<(), String> {
        if joints != Self::JOINTS {
            return Err(format!(
                "arm: expected {} joints, found {joints}",
                Self::JOINTS
            ));
        }
        if self.bodies.is_empty() {
            return Err("arm.bodies: expected at least one, found none".into());
        }
        for links in &self.bodies {
            let lengths = [links.upper_arm, links.forearm, links.wrist];
            let offsets = [
                links.shoulder_offset,
                links.elbow_offset,
                links.wrist_offset,
            ];
            let possible = lengths.iter().all(|v| (0.001..=100.0).contains(v))
                && offsets.iter().all(|v| v.abs() <= 100.0);
            if !possible {
                return Err(format!(
                    "arm.bodies: expected lengths of 0.001 to 100 m and offsets up to 100 m, found {links:?}"
                ));
            }
        }
        for (name, matrix) in [("across", &self.across), ("along", &self.along)] {
            let mut values = matrix.iter().flatten();
            if let Some(value) = values.find(|v| v.is_nan() || v.abs() > 1e6) {
                return Err(format!(
                    "arm.{name}: expected numbers up to a million, found {value}"
                ));
            }
        }
        Ok(())
    }
}

impl Links {
    /// In the order of the fields, as `shaders/kinematic_fit.wgsl` reads them.
    pub(crate) fn values(&self) -> [f32; 6] {
        [
            self.shoulder_offset,
            self.upper_arm,
            self.elbow_offset,
            self.forearm,
            self.wrist_offset,
            self.wrist,
        ]
    }
}
