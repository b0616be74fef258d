use std::array;

use glam::{Vec3, Vec4};

use crate::network::{Arm, Links};

/// Steps of the fit: three bring it to a millimetre for all but arms that are grossly wrong.
const STEPS: usize = 4;
/// Share by which the normal equations' diagonal is raised, so that none is singular.
const DAMPING: f32 = 0.01;
/// What a body can change: the first joint's place (3), the turn of all about it (3), and the turns of the forearm and of the
/// wrist about the common axis.
const FREEDOMS: usize = 8;
/// No joint is nearer along the line of sight, in metres.
const NEAREST: f32 = 0.01;

/// The place and the posture of a body.
#[derive(Debug, Clone, Copy)]
struct Posture {
    /// The first joint, in metres.
    origin: Vec3,
    /// The common axis, a unit vector.
    axis: Vec3,
    /// The directions of upper arm, forearm and wrist: unit vectors at a right angle to the axis.
    upper_arm: Vec3,
    forearm: Vec3,
    wrist: Vec3,
}

/// Moves `joints`, six of `x, y, z` in a camera's frame, to the most probable place where the `arm` can have them: what the
/// joint network says is taken as measured with the errors that it makes, joint by joint and together, and the eight numbers
/// that say where such an arm is are fitted to it (Gauss and Newton's steps, slightly damped). Any camera's frame will do: errors are
/// across or along the line of sight to the arm.
///
/// Joints that are not finite or not in front of the camera stay as they are.
pub fn kinematic_fit(joints: &[f32], arm: &Arm) -> Vec<f32> {
    let (points, rest) = joints.as_chunks::<3>();
    let Ok(seen) = <[_; Arm::JOINTS]>::try_from(points) else {
        return joints.to_vec();
    };
    let seen = seen.map(Vec3::from_array);
    let sight = seen.iter().sum::<Vec3>().normalize_or_zero();
    let depths = seen.map(|joint| joint.dot(sight));
    // Written so that what is no number does not pass.
    if !rest.is_empty()
        || !depths
            .iter()
            .all(|depth| *depth >= NEAREST && *depth <= 1e6)
    {
        return joints.to_vec();
    }
    let depth = depths.iter().sum::<f32>() / Arm::JOINTS as f32;
    let view = View { seen, sight, depth };
    let mut best = (f32::MAX, seen);
    for links in &arm.bodies {
        let mut posture = Posture::near(&seen, links);
        for _ in 0..STEPS {
            let joints = posture.joints(links);
            let errors = view.errors(&joints, arm);
            let columns = view.columns(&posture, &joints, links, arm);
            posture = posture.moved(solve(&columns, &errors));
        }
        let joints = posture.joints(links);
        let errors = view.errors(&joints, arm);
        let cost = errors.iter().map(|error| error.length_squared()).sum();
        if cost < best.0 {
            best = (cost, joints);
        }
    }
    best.1.iter().flat_map(Vec3::to_array).collect()
}

impl Posture {
    /// One whose joints are near those `seen`.
    fn near(seen: &[Vec3; Arm::JOINTS], links: &Links) -> Self {
        let [pan, lift, elbow, wrist_1, wrist_2, wrist_3] = *seen;
        // Two links lie along the axis; two others at a right angle to it, which say the more the less they are in line.
        let along = links.shoulder_offset * (lift - pan) + links.wrist_offset * (wrist_2 - wrist_1);
        let along = along.normalize_or_zero();
        let upper_arm = elbow - lift - links.elbow_offset * along;
        let forearm = wrist_1 - elbow;
        let across = upper_arm.cross(forearm) / (upper_arm.length() * forearm.length()).max(1e-12);
        let across = if across.dot(along) < 0.0 {
            -across
        } else {
            across
        };
        let axis = (along + across).normalize_or_zero();
        let posture = Self {
            origin: Vec3::ZERO,
            axis,
            upper_arm: level(upper_arm, axis),
            forearm: level(forearm, axis),
            wrist: level(wrist_3 - wrist_2, axis),
        };
        let off = seen.iter().sum::<Vec3>() - posture.joints(links).iter().sum::<Vec3>();
        Self {
            origin: off / Arm::JOINTS as f32,
            ..posture
        }
    }

    /// The joints of a body with these `links`.
    fn joints(&self, links: &Links) -> [Vec3; Arm::JOINTS] {
        let pan = self.origin;
        let lift = pan + links.shoulder_offset * self.axis;
        let elbow = lift + links.upper_arm * self.upper_arm + links.elbow_offset * self.axis;
        let wrist_1 = elbow + links.forearm * self.forearm;
        let wrist_2 = wrist_1 + links.wrist_offset * self.axis;
        let wrist_3 = wrist_2 + links.wrist * self.wrist;
        [pan, lift, elbow, wrist_1, wrist_2, wrist_3]
    }

    /// This one after a step of the fit.
    fn moved(&self, by: [f32; FREEDOMS]) -> Self {
        let [x, y, z, turn_x, turn_y, turn_z, forearm, wrist] = by;
        let turn = Vec3::new(turn_x, turn_y, turn_z);
        let axis = turned(self.axis, turn).normalize_or_zero();
        Self {
            origin: self.origin + Vec3::new(x, y, z),
            axis,
            upper_arm: level(turned(self.upper_arm, turn), axis),
            forearm: level(turned(turned(self.forearm, turn), forearm * axis), axis),
            wrist: level(turned(turned(self.wrist, turn), wrist * axis), axis),
        }
    }
}

/// The direction of a link at a right angle to the axis.
fn level(link: Vec3, axis: Vec3) -> Vec3 {
    (link - link.dot(axis) * axis).normalize_or_zero()
}

/// `vector` turned about `turn`, by its length in radians (Rodrigues).
fn turned(vector: Vec3, turn: Vec3) -> Vec3 {
    let angle = turn.length();
    let axis = turn / angle.max(1e-12);
    vector * angle.cos()
        + axis.cross(vector) * angle.sin()
        + axis * (axis.dot(vector) * (1.0 - angle.cos()))
}

/// What the joint network sees, and from where.
struct View {
    /// The joints, in metres.
    seen: [Vec3; Arm::JOINTS],
    /// The line of sight to the arm, a unit vector.
    sight: Vec3,
    /// Mean depth along it, in metres.
    depth: f32,
}

impl View {
    /// How far `joints` are from those seen, whitened: across the line of sight in x, y and z, along it in w.
    fn errors(&self, joints: &[Vec3; Arm::JOINTS], arm: &Arm) -> [Vec4; Arm::JOINTS] {
        let errors = array::from_fn(|j| {
            let (joint, seen) = (joints[j], self.seen[j]);
            let (depth, seen_depth) = (self.depth_of(joint), self.depth_of(seen));
            let across = self.depth * (joint / depth - seen / seen_depth);
            across.extend((depth / seen_depth).ln())
        });
        whitened(&errors, arm)
    }

    /// How those errors change with each freedom of `posture`, whose joints are `joints`.
    fn columns(
        &self,
        posture: &Posture,
        joints: &[Vec3; Arm::JOINTS],
        links: &Links,
        arm: &Arm,
    ) -> [[Vec4; Arm::JOINTS]; FREEDOMS] {
        let forearm = links.forearm * posture.axis.cross(posture.forearm);
        let wrist = links.wrist * posture.axis.cross(posture.wrist);
        array::from_fn(|freedom| {
            let changes = array::from_fn(|j| {
                let joint = joints[j];
                let moved = match freedom {
                    0..3 => Vec3::AXES[freedom],
                    3..6 => Vec3::AXES[freedom - 3].cross(joint - posture.origin),
                    6 if j >= 3 => forearm,
                    7 if j == 5 => wrist,
                    _ => Vec3::ZERO,
                };
                let depth = self.depth_of(joint);
                let nearer = self.sight.dot(moved) / depth;
                let across = self.depth / depth * (moved - nearer * joint);
                across.extend(nearer)
            });
            whitened(&changes, arm)
        })
    }

    fn depth_of(&self, joint: Vec3) -> f32 {
        joint.dot(self.sight).max(NEAREST)
    }
}

/// Errors of variance 1 that are independent of each other.
fn whitened(errors: &[Vec4; Arm::JOINTS], arm: &Arm) -> [Vec4; Arm::JOINTS] {
    array::from_fn(|i| {
        (0..Arm::JOINTS)
            .map(|j| Vec3::splat(arm.across[i][j]).extend(arm.along[i][j]) * errors[j])
            .sum()
    })
}

/// The step that leaves the least errors, were they to change by `columns`: the damped normal equations, by Gauss's elimination.
fn solve(
    columns: &[[Vec4; Arm::JOINTS]; FREEDOMS],
    errors: &[Vec4; Arm::JOINTS],
) -> [f32; FREEDOMS] {
    let dot = |a: &[Vec4; Arm::JOINTS], b: &[Vec4; Arm::JOINTS]| -> f32 {
        a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum()
    };
    let mut rows: [[f32; FREEDOMS + 1]; FREEDOMS] = array::from_fn(|i| {
        array::from_fn(|j| match columns.get(j) {
            Some(column) if i == j => (1.0 + DAMPING) * dot(column, column),
            Some(column) => dot(&columns[i], column),
            None => -dot(&columns[i], errors),
        })
    });
    for i in 0..FREEDOMS {
        let pivot = rows[i];
        for row in rows.iter_mut().skip(i + 1) {
            let factor = row[i] / pivot[i];
            for (value, above) in row.iter_mut().zip(pivot).skip(i) {
                *value -= factor * above;
            }
        }
    }
    let mut solution = [0.0; FREEDOMS];
    for i in (0..FREEDOMS).rev() {
        let known: f32 = (i + 1..FREEDOMS).map(|j| rows[i][j] * solution[j]).sum();
        solution[i] = (rows[i][FREEDOMS] - known) / rows[i][i];
    }
    solution
}
