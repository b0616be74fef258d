//! A robot from its URDF: links, joints, meshes, forward kinematics.

use std::collections::{BTreeMap, HashMap};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{Affine3A, DAffine3, DMat3, DQuat, DVec3, Vec3};
use urdf_rs::{Geometry, JointType};

use super::RobotError;
use super::mesh::Mesh;

/// A link's meshes, in the link's own frame.
#[derive(Debug)]
pub struct Link {
    /// The link's name in the URDF.
    pub name: String,
    /// What it looks like: one mesh a material.
    pub visual: Vec<Mesh>,
    /// What it collides with; the visual meshes where the URDF gives no others.
    pub collision: Vec<Mesh>,
    /// The link it hangs on; `None` for the root.
    pub parent: Option<usize>,
}

/// A joint that moves.
#[derive(Debug)]
pub struct Joint {
    /// The joint's name without a trailing `_joint`.
    pub name: String,
    /// Range of the joint's angle, radians.
    pub range: [f64; 2],
    /// The link that the joint moves: its frame is the joint's frame.
    pub child: usize,
    /// The link that the joint hangs on.
    pub parent: usize,
    /// The unit vector that the joint turns about, in its own frame.
    pub axis: DVec3,
    /// Where on its axis the joint's point is, metres from the frame's origin; see [`Frames`].
    pub offset: f64,
}

/// How the frames of a URDF become those of another one for the same arm. A joint's frame may lie
/// anywhere along the joint's axis, and URDFs differ in where: this moves the joints' points along the
/// axes, and says which link's frame is the base frame.
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Frames {
    /// The link whose frame is the robot's base frame.
    pub base_link: String,
    /// For each joint, by its name without `_joint`: where its point is along its axis, metres from the
    /// origin of the URDF's frame.
    pub offsets_m: BTreeMap<String, f64>,
}

impl Frames {
    /// Reads a JSON file with the fields of this type.
    ///
    /// # Errors
    /// The file cannot be read, or is no such JSON (the error names the line).
    pub fn read(path: &Path) -> Result<Frames, RobotError> {
        let text = std::fs::read_to_string(path).map_err(RobotError::io(path))?;
        serde_json::from_str(&text).map_err(|cause| RobotError::Frames {
            path: path.to_owned(),
            message: cause.to_string(),
        })
    }
}

/// A step of the way from the root to all links, parents first.
#[derive(Debug)]
struct Step {
    parent: usize,
    child: usize,
    origin: DAffine3,
    /// The rotation axis in the child's frame, and which moving joint turns it.
    moved_by: Option<(DVec3, usize)>,
}

/// A robot: what a URDF file and its meshes say. Revolute and continuous joints move, each on its own
/// (`mimic` is ignored); all others stay at zero.
#[derive(Debug)]
pub struct Robot {
    /// All links.
    pub links: Vec<Link>,
    /// The joints that move, base first.
    pub joints: Vec<Joint>,
    steps: Vec<Step>,
    /// The link that carries the first joint.
    base: usize,
    /// The link whose frame is the base frame.
    frame: usize,
}

impl Robot {
    /// Reads a URDF and all its meshes. `packages` says where `package://NAME/` is; a package that is
    /// not listed is searched for upwards from the URDF.
    ///
    /// # Errors
    /// A file is missing or unreadable (the error names it), or the URDF has no revolute joint, or its
    /// joints do not form a tree.
    pub fn load(urdf: &Path, packages: &[(String, PathBuf)]) -> Result<Robot, RobotError> {
        Self::read(urdf, Some(packages))
    }

    /// Reads a URDF without its meshes: enough for kinematics.
    ///
    /// # Errors
    /// As [`Robot::load`], but for meshes.
    pub fn kinematics(urdf: &Path) -> Result<Robot, RobotError> {
        Self::read(urdf, None)
    }

    /// Without `packages` meshes are left alone.
    fn read(urdf: &Path, packages: Option<&[(String, PathBuf)]>) -> Result<Robot, RobotError> {
        let mut text = std::fs::read_to_string(urdf).map_err(RobotError::io(urdf))?;
        // Drake's attributes mostly come without the declaration that XML wants.
        if text.contains(" drake:") && !text.contains("xmlns:drake") {
            text = text.replacen(
                "<robot ",
                "<robot xmlns:drake=\"https://drake.mit.edu\" ",
                1,
            );
        }
        let fail = |message: String| RobotError::Urdf {
            path: urdf.to_owned(),
            message,
        };
        let description =
            urdf_rs::read_from_string(&text).map_err(|e| fail(format!("not a URDF: {e}")))?;

        let mut links = Vec::new();
        let mut index = HashMap::new();
        for link in &description.links {
            let files = Files {
                urdf,
                packages: packages.unwrap_or_default(),
                link: &link.name,
            };
            let (seen, solid) = match packages {
                Some(_) => (link.visual.as_slice(), link.collision.as_slice()),
                None => Default::default(),
            };
            let mut visual = Vec::new();
            for part in seen {
                let mut meshes = files.geometry(&part.geometry, &part.origin)?;
                let colour = part.material.as_ref().and_then(|m| {
                    let named = description.materials.iter().find(|d| d.name == m.name);
                    m.color
                        .as_ref()
                        .or_else(|| named.and_then(|d| d.color.as_ref()))
                });
                if let Some(colour) = colour {
                    let [r, g, b, _] = *colour.rgba;
                    meshes
                        .iter_mut()
                        .for_each(|m| m.diffuse = Some([r as f32, g as f32, b as f32]));
                }
                visual.append(&mut meshes);
            }
            let mut collision = Vec::new();
            for part in solid {
                collision.append(&mut files.geometry(&part.geometry, &part.origin)?);
            }
            if collision.is_empty() {
                collision.clone_from(&visual);
            }
            index.insert(link.name.as_str(), links.len());
            links.push(Link {
                name: link.name.clone(),
                visual,
                collision,
                parent: None,
            });
        }

        let find = |name: &str, joint: &str| {
            index.get(name).copied().ok_or_else(|| {
                fail(format!(
                    "joint \"{joint}\" names the link \"{name}\", which does not exist"
                ))
            })
        };
        let mut hanging: HashMap<usize, Vec<(&urdf_rs::Joint, usize)>> = HashMap::new();
        for joint in &description.joints {
            let parent = find(&joint.parent.link, &joint.name)?;
            let child = find(&joint.child.link, &joint.name)?;
            let slot = links.get_mut(child).map(|l| &mut l.parent);
            if let Some(Some(_)) = slot {
                let name = &joint.child.link;
                return Err(fail(format!(
                    "the link \"{name}\" hangs on more than one joint"
                )));
            }
            if let Some(slot) = slot {
                *slot = Some(parent);
            }
            hanging.entry(parent).or_default().push((joint, child));
        }

        let mut joints: Vec<Joint> = Vec::new();
        let mut steps = Vec::new();
        let mut open: Vec<usize> = (0..links.len())
            .filter(|&i| links.get(i).is_some_and(|l| l.parent.is_none()))
            .collect();
        while let Some(parent) = open.pop() {
            for &(joint, child) in hanging.get(&parent).into_iter().flatten() {
                let turns = matches!(
                    joint.joint_type,
                    JointType::Revolute | JointType::Continuous
                );
                let moved_by = turns.then(|| {
                    let range = match joint.joint_type {
                        // Limits left out read as infinite.
                        JointType::Revolute if joint.limit.upper < f64::INFINITY => {
                            [joint.limit.lower, joint.limit.upper]
                        }
                        _ => [-PI, PI],
                    };
                    let name = joint
                        .name
                        .strip_suffix("_joint")
                        .unwrap_or(&joint.name)
                        .to_owned();
                    let axis = DVec3::from(*joint.axis.xyz).normalize_or(DVec3::X);
                    joints.push(Joint {
                        name,
                        range,
                        child,
                        parent,
                        axis,
                        offset: 0.0,
                    });
                    (axis, joints.len() - 1)
                });
                steps.push(Step {
                    parent,
                    child,
                    origin: pose(&joint.origin),
                    moved_by,
                });
                open.push(child);
            }
        }
        if steps.len() != description.joints.len() {
            return Err(fail(
                "expected the joints to form a tree, found a loop".into(),
            ));
        }
        let Some(first) = joints.first() else {
            return Err(fail(
                "expected at least one revolute joint, found none".into(),
            ));
        };
        if let Some(bad) = joints
            .iter()
            .find(|j| !(0.0..f64::INFINITY).contains(&(j.range[1] - j.range[0])))
        {
            let ([lower, upper], name) = (bad.range, &bad.name);
            return Err(fail(format!(
                "joint \"{name}\": expected a finite range, found {lower} to {upper}"
            )));
        }
        let base = first.parent;
        Ok(Robot {
            links,
            joints,
            steps,
            base,
            frame: base,
        })
    }

    /// Replaces the base frame and the joints' points.
    ///
    /// # Errors
    /// The robot lacks the base link or a joint that is named; the message says which.
    pub fn set_frames(&mut self, frames: &Frames) -> Result<(), String> {
        let link = &frames.base_link;
        self.frame = self
            .find_link(link)
            .ok_or_else(|| format!("expected a link \"{link}\", found none"))?;
        for (name, &offset) in &frames.offsets_m {
            let joint = self.joints.iter_mut().find(|j| j.name == *name);
            let joint =
                joint.ok_or_else(|| format!("expected a moving joint \"{name}\", found none"))?;
            joint.offset = offset;
        }
        Ok(())
    }

    /// Poses of all links in the base frame (the frame of the first joint's parent link, or that which
    /// [`Frames`] name), in the order of `links`. `angles`: one a moving joint, radians; missing ones count as zero.
    pub fn link_poses(&self, angles: &[f64]) -> Vec<DAffine3> {
        let mut poses = vec![DAffine3::IDENTITY; self.links.len()];
        for step in &self.steps {
            let turn = step.moved_by.map_or(DQuat::IDENTITY, |(axis, joint)| {
                DQuat::from_axis_angle(axis, angles.get(joint).copied().unwrap_or(0.0))
            });
            let pose = poses.get(step.parent).copied().unwrap_or_default()
                * step.origin
                * DAffine3::from_quat(turn);
            if let Some(slot) = poses.get_mut(step.child) {
                *slot = pose;
            }
        }
        let to_base = poses.get(self.frame).copied().unwrap_or_default().inverse();
        poses.iter().map(|&pose| to_base * pose).collect()
    }

    /// Points of the moving joints in the base frame, metres, from link poses: the origins of their
    /// frames, or where [`Frames`] put them.
    pub fn joint_origins(&self, link_poses: &[DAffine3]) -> Vec<DVec3> {
        self.axes(link_poses).map(|(point, _)| point).collect()
    }

    /// The arm as a line through its links' middles, base first: from each joint's point to the nearest
    /// point of the next one's axis, then along that axis.
    pub(crate) fn spine(&self, link_poses: &[DAffine3]) -> Vec<DVec3> {
        let base = link_poses.get(self.base).copied().unwrap_or_default();
        let mut at = base.translation;
        let mut spine = vec![at];
        for (point, axis) in self.axes(link_poses) {
            spine.push(point + axis * (at - point).dot(axis));
            spine.push(point);
            at = point;
        }
        spine
    }

    /// Points and directions of the joints' axes in the base frame.
    fn axes(&self, link_poses: &[DAffine3]) -> impl Iterator<Item = (DVec3, DVec3)> {
        self.joints.iter().map(|joint| {
            let pose = link_poses.get(joint.child).copied().unwrap_or_default();
            let point = pose.transform_point3(joint.axis * joint.offset);
            (point, pose.transform_vector3(joint.axis))
        })
    }

    /// The link whose frame is the base frame.
    pub fn base_frame(&self) -> &str {
        self.links.get(self.frame).map_or("", |link| &link.name)
    }

    /// The link that carries the first moving joint.
    pub fn base_link(&self) -> usize {
        self.base
    }

    /// The index of the link with this name.
    pub fn find_link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|l| l.name == name)
    }
}

fn pose(pose: &urdf_rs::Pose) -> DAffine3 {
    let [roll, pitch, yaw] = *pose.rpy;
    let rotation =
        DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(pitch) * DMat3::from_rotation_x(roll);
    DAffine3::from_mat3_translation(rotation, DVec3::from(*pose.xyz))
}

struct Files<'a> {
    urdf: &'a Path,
    packages: &'a [(String, PathBuf)],
    link: &'a str,
}

impl Files<'_> {
    fn geometry(
        &self,
        geometry: &Geometry,
        origin: &urdf_rs::Pose,
    ) -> Result<Vec<Mesh>, RobotError> {
        let size = |v: [f64; 3]| Affine3A::from_scale(Vec3::from(v.map(|c| c as f32)));
        let (mut meshes, scale) = match geometry {
            Geometry::Box { size: edges } => (vec![Mesh::cuboid()], size(**edges)),
            Geometry::Cylinder { radius, length } | Geometry::Capsule { radius, length } => (
                vec![Mesh::cylinder()],
                size([2.0 * radius, 2.0 * radius, *length]),
            ),
            Geometry::Sphere { radius } => (vec![Mesh::sphere()], size([2.0 * radius; 3])),
            Geometry::Mesh { filename, scale } => (
                Mesh::read(&self.find(filename)?)?,
                size(scale.map_or([1.0; 3], |s| *s)),
            ),
        };
        let origin = pose(origin);
        let placed =
            Affine3A::from_mat3_translation(origin.matrix3.as_mat3(), origin.translation.as_vec3());
        meshes.iter_mut().for_each(|m| m.transform(placed * scale));
        Ok(meshes)
    }

    /// The file that a URDF's mesh name means.
    fn find(&self, name: &str) -> Result<PathBuf, RobotError> {
        let folder = self.urdf.parent().unwrap_or(Path::new(""));
        let missing = |looked_for: PathBuf| RobotError::MissingMesh {
            urdf: self.urdf.to_owned(),
            link: self.link.to_owned(),
            name: name.to_owned(),
            looked_for,
        };
        let Some(inside) = name.strip_prefix("package://") else {
            let path = folder.join(name.strip_prefix("file://").unwrap_or(name));
            return if path.is_file() {
                Ok(path)
            } else {
                Err(missing(path))
            };
        };
        let (package, rest) = inside.split_once('/').unwrap_or((inside, ""));
        if let Some((_, root)) = self.packages.iter().find(|(n, _)| n == package) {
            let path = root.join(rest);
            return if path.is_file() {
                Ok(path)
            } else {
                Err(missing(path))
            };
        }
        let absolute = std::path::absolute(folder).map_err(RobotError::io(folder))?;
        absolute
            .ancestors()
            .flat_map(|up| [up.join(rest), up.join(inside)])
            .find(|path| path.is_file())
            .ok_or_else(|| missing(folder.join(rest)))
    }
}
