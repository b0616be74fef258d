//! Which poses of a robot touch themselves or the floor.

use glam::DAffine3;
use parry3d::math::{Pose, Rotation, Vector};
use parry3d::query::intersection_test;
use parry3d::shape::TriMesh;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::robot::Robot;

/// Finds poses that collide, on the links' collision meshes.
pub struct CollisionModel {
    shapes: Vec<Vec<TriMesh>>,
    pairs: Vec<(usize, usize)>,
    /// Links that may not reach below the floor.
    above_floor: Vec<usize>,
}

impl CollisionModel {
    /// Works out which pairs of links can collide: neighbours are left out, and so are pairs that touch
    /// in nearly every pose, which is how their meshes are made.
    pub fn new(robot: &Robot) -> CollisionModel {
        const PROBES: usize = 60;
        let shapes: Vec<Vec<TriMesh>> = robot
            .links
            .iter()
            .map(|link| {
                link.collision
                    .iter()
                    .filter_map(|mesh| {
                        let vertices = mesh.positions.iter().map(|&p| Vector::from(p)).collect();
                        TriMesh::new(vertices, mesh.indices.as_chunks::<3>().0.to_vec()).ok()
                    })
                    .collect()
            })
            .collect();
        let solid: Vec<usize> = (0..shapes.len())
            .filter(|&i| shapes.get(i).is_some_and(|s| !s.is_empty()))
            .collect();
        let parent = |link: usize| robot.links.get(link).and_then(|l| l.parent);
        let mut pairs: Vec<(usize, usize)> = Vec::new();
        for (n, &a) in solid.iter().enumerate() {
            for &b in solid.iter().skip(n + 1) {
                if parent(a) != Some(b) && parent(b) != Some(a) {
                    pairs.push((a, b));
                }
            }
        }
        let base = robot.base_link();
        let above_floor = solid.into_iter().filter(|&link| link != base).collect();
        let mut model = CollisionModel {
            shapes,
            pairs: Vec::new(),
            above_floor,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let probes: Vec<Vec<DAffine3>> = (0..PROBES)
            .map(|_| {
                let angles: Vec<f64> = robot
                    .joints
                    .iter()
                    .map(|j| rng.random_range(j.range[0]..=j.range[1]))
                    .collect();
                robot.link_poses(&angles)
            })
            .collect();
        pairs.retain(|&(a, b)| {
            let touching = probes
                .iter()
                .filter(|poses| model.touch(a, b, poses))
                .count();
            touching * 10 < PROBES * 9
        });
        model.pairs = pairs;
        model
    }

    /// Whether two links that should not touch do.
    pub fn self_collision(&self, link_poses: &[DAffine3]) -> bool {
        self.pairs
            .iter()
            .any(|&(a, b)| self.touch(a, b, link_poses))
    }

    /// Whether any link but the base reaches below the plane z = `floor` of the base frame.
    pub fn floor_collision(&self, link_poses: &[DAffine3], floor: f64) -> bool {
        self.above_floor.iter().any(|&link| {
            let Some(pose) = link_poses.get(link) else {
                return false;
            };
            let up = pose.matrix3.transpose().z_axis.as_vec3();
            let height = pose.translation.z as f32;
            let shapes = self.shapes.get(link).into_iter().flatten();
            shapes
                .flat_map(TriMesh::vertices)
                .any(|v| up.x * v.x + up.y * v.y + up.z * v.z + height < floor as f32)
        })
    }

    fn touch(&self, a: usize, b: usize, link_poses: &[DAffine3]) -> bool {
        let (Some(pose_a), Some(pose_b)) = (link_poses.get(a), link_poses.get(b)) else {
            return false;
        };
        let (pose_a, pose_b) = (to_parry(pose_a), to_parry(pose_b));
        self.shapes.get(a).into_iter().flatten().any(|shape_a| {
            self.shapes.get(b).into_iter().flatten().any(|shape_b| {
                intersection_test(&pose_a, shape_a, &pose_b, shape_b)
                    .is_ok_and(|result| result.intersecting)
            })
        })
    }
}

fn to_parry(pose: &DAffine3) -> Pose {
    let (_, rotation, translation) = pose.to_scale_rotation_translation();
    let [x, y, z, w] = rotation.as_quat().to_array();
    let [tx, ty, tz] = translation.as_vec3().to_array();
    Pose::from_parts(Vector::new(tx, ty, tz), Rotation::from_xyzw(x, y, z, w))
}
