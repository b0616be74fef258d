//! Random shots of a robot: its pose, the camera, and how it all looks.

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DQuat, DVec3};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::background::PhotoView;
use super::chance::{direction, grey, hsv, normal};
use super::collision::CollisionModel;
use super::effects::Effects;
use super::mesh::Mesh;
use super::props::{Builder, MATT, PRIMITIVES, Support, lighting};
use super::robot::Robot;
use super::scene::{Item, Kind, Material, Scene};
use super::sweep::Sweep;
use super::{HEIGHT, INTRINSICS, RecordingError, WIDTH};

/// The robot's part in a shot.
#[derive(Debug, Clone)]
pub struct Posed {
    /// Joint angles, radians.
    pub angles: Vec<f64>,
    /// Joint origins in the camera optical frame, metres.
    pub joints: Vec<DVec3>,
}

/// One random sample of a recording, before it is drawn.
#[derive(Debug, Clone)]
pub struct Shot {
    /// What is drawn.
    pub scene: Scene,
    /// The photo behind everything.
    pub background: PhotoView,
    /// The photo on textured surfaces, where there are any.
    pub texture: Option<PhotoView>,
    /// What the camera does to the picture.
    pub effects: Effects,
    /// The robot; `None` for a picture without one.
    pub robot: Option<Posed>,
}

/// A class of robot surface, told from the mesh's own colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Finish {
    Cap,
    Tube,
    Housing,
    Rubber,
}

impl Finish {
    fn of(mesh: &Mesh) -> Finish {
        let [r, g, b] = mesh.diffuse.unwrap_or([0.2; 3]);
        let spread = r.max(g).max(b) - r.min(g).min(b);
        match r.max(g).max(b) {
            _ if spread > 0.05 => Finish::Cap,
            v if v < 0.08 => Finish::Rubber,
            v if v > 0.3 => Finish::Tube,
            _ => Finish::Housing,
        }
    }
}

struct Part {
    link: usize,
    mesh: usize,
    finish: Finish,
}

/// A robot ready to be put into scenes.
pub struct Stage {
    robot: Robot,
    collision: CollisionModel,
    meshes: Vec<Mesh>,
    visual: Vec<Part>,
    shadow: Vec<(usize, usize)>,
    /// The farthest that a joint gets from the second joint, metres.
    reach: f64,
    /// The frame that grippers are put on, z outwards.
    tool: Option<usize>,
}

/// A recording with a fixed camera: what stays the same, and the robot's poses.
pub struct Station {
    camera_from_base: DAffine3,
    seed: u64,
    poses: Vec<Vec<f64>>,
}

impl Stage {
    /// Loads a robot and its meshes; see [`Robot::load`].
    ///
    /// # Errors
    /// As [`Robot::load`].
    pub fn load(urdf: &Path, packages: &[(String, PathBuf)]) -> Result<Stage, RecordingError> {
        let mut robot = Robot::load(urdf, packages)?;
        let collision = CollisionModel::new(&robot);
        let mut meshes: Vec<Mesh> = PRIMITIVES.iter().map(|make| make()).collect();
        let mut visual = Vec::new();
        let mut shadow = Vec::new();
        for (index, link) in robot.links.iter_mut().enumerate() {
            for mesh in link.visual.drain(..) {
                visual.push(Part {
                    link: index,
                    mesh: meshes.len(),
                    finish: Finish::of(&mesh),
                });
                meshes.push(mesh);
            }
            for mesh in link.collision.drain(..) {
                shadow.push((index, meshes.len()));
                meshes.push(mesh);
            }
        }
        let tool = robot.find_link("tool0");
        let mut stage = Stage {
            robot,
            collision,
            meshes,
            visual,
            shadow,
            reach: 0.0,
            tool,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..200 {
            let angles = stage.any_angles(&mut rng);
            let origins = stage.robot.joint_origins(&stage.robot.link_poses(&angles));
            let centre = origins
                .get(1)
                .or(origins.first())
                .copied()
                .unwrap_or_default();
            let farthest = origins
                .iter()
                .map(|o| o.distance(centre))
                .fold(0.1, f64::max);
            stage.reach = stage.reach.max(farthest);
        }
        Ok(stage)
    }

    /// All meshes that scenes refer to.
    pub fn meshes(&self) -> &[Mesh] {
        &self.meshes
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    fn any_angles(&self, rng: &mut ChaCha8Rng) -> Vec<f64> {
        self.robot
            .joints
            .iter()
            .map(|j| rng.random_range(j.range[0]..=j.range[1]))
            .collect()
    }

    /// Joint angles: half anywhere in their ranges, half near working poses of arms whose joints carry
    /// the usual names. The caller rejects collisions.
    fn angles(&self, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let working = rng.random_bool(0.5);
        let side = if rng.random_bool(0.8) { 1.0 } else { -1.0 };
        let mut angles = Vec::with_capacity(self.robot.joints.len());
        for joint in &self.robot.joints {
            let [lower, upper] = joint.range;
            let mut within = |from: f64, to: f64| {
                let angle: f64 = rng.random_range(from..=to);
                angle.to_radians().clamp(lower, upper)
            };
            let angle = match (joint.name.as_str(), working) {
                ("shoulder_lift", true) => within(-140.0, -60.0),
                ("shoulder_lift", false) => within(-190.0, 10.0),
                ("elbow", true) => side * within(40.0, 140.0),
                ("wrist_1", true) if side > 0.0 => {
                    // Tools mostly point down.
                    let (a, b) = (within(-60.0, 60.0), within(-180.0, 180.0));
                    let lift_and_elbow: f64 = angles.iter().skip(1).take(2).sum();
                    if b > 0.0 {
                        a - PI / 2.0 - lift_and_elbow
                    } else {
                        b
                    }
                }
                _ => rng.random_range(lower..=upper),
            };
            angles.push(angle.clamp(lower, upper));
        }
        angles
    }

    fn free_angles(&self, rng: &mut ChaCha8Rng) -> Option<(Vec<f64>, Vec<DAffine3>)> {
        (0..200).find_map(|_| {
            let angles = self.angles(rng);
            let poses = self.robot.link_poses(&angles);
            let free = !self.collision.floor_collision(&poses, 0.0)
                && !self.collision.self_collision(&poses);
            free.then_some((angles, poses))
        })
    }

    /// Sample `id` of a recording with a free camera: the same for the same `seed` and `id`.
    /// `photos`: how many background photos there are.
    ///
    /// # Errors
    /// No pose and camera that keep the rules were found.
    pub fn free_shot(&self, seed: u64, id: u64, photos: usize) -> Result<Shot, RecordingError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(id);
        let mut look = ChaCha8Rng::from_rng(&mut rng);
        let support = Support::any(&mut look);
        if rng.random_bool(0.15) {
            return Ok(self.empty_shot(support, &mut look, &mut rng, photos));
        }
        for _ in 0..100 {
            let Some((angles, poses)) = self.free_angles(&mut rng) else {
                continue;
            };
            for _ in 0..8 {
                let camera = self.aim(&poses, &support, &mut rng);
                if let Some(camera_from_base) = camera {
                    let robot = (angles, poses);
                    return Ok(self.dress(
                        camera_from_base,
                        support,
                        Some(robot),
                        &mut look,
                        &mut rng,
                        photos,
                    ));
                }
            }
        }
        Err(RecordingError::NoScene { id })
    }

    /// Sample `id` of a recording with a fixed camera: the photo behind the robot and the light are the
    /// sample's own, all else is the station's.
    ///
    /// # Errors
    /// The station has fewer samples.
    pub fn fixed_shot(
        &self,
        station: &Station,
        id: u64,
        photos: usize,
    ) -> Result<Shot, RecordingError> {
        let pose = usize::try_from(id).ok().and_then(|i| station.poses.get(i));
        let Some(angles) = pose else {
            return Err(RecordingError::NoScene { id });
        };
        let poses = self.robot.link_poses(angles);
        let camera_from_base = station.camera_from_base;
        let mut rng = ChaCha8Rng::seed_from_u64(station.seed);
        rng.set_stream(id);
        let mut look = station_rng(station.seed);
        let support = Support::any(&mut look);
        let mut arm = self.robot.joint_origins(&poses);
        arm.insert(0, DVec3::ZERO);
        let centre = arm.iter().sum::<DVec3>() / arm.len() as f64;
        let mut build = Builder {
            items: Vec::new(),
            camera: camera_from_base.inverse().translation,
            arm,
        };
        support.build(&mut build, &mut look);
        self.add_robot(&mut build, &poses, &mut look);
        let texture = PhotoView::any(&mut look, photos, false);
        if let Some(tool) = self.tool.and_then(|t| poses.get(t)) {
            build.gripper(*tool, support.is_table(), &mut look);
        }
        let textured = build.items.iter().any(|item| item.material.photo > 0.0);
        Ok(Shot {
            scene: Scene {
                camera_from_base,
                items: build.items,
                lighting: lighting(&mut rng),
                centre,
            },
            background: PhotoView::any(&mut rng, photos, true),
            texture: textured.then_some(texture),
            effects: Effects::any(&mut rng),
            robot: Some(Posed {
                angles: angles.clone(),
                joints: self.seen_from(camera_from_base, &poses),
            }),
        })
    }

    /// The camera and the `samples` poses of a recording with a fixed camera (the paper, section 2): all
    /// joints are swept through their ranges in equal steps, in combination, and poses in which the robot
    /// meets itself or the floor, or has a joint outside the picture, are left out. The more samples,
    /// the finer the steps.
    ///
    /// The camera is one that shows the robot whole and on 6 to 17 % of the picture (the paper, section 3)
    /// in as many poses as possible.
    ///
    /// # Errors
    /// There are not as many such poses.
    pub fn station(&self, seed: u64, samples: usize) -> Result<Station, RecordingError> {
        let camera_from_base = self.station_camera(seed);
        let kept = |sweep: &Sweep| -> Vec<Vec<f64>> {
            let keep = |point: usize| {
                let angles = sweep.angles(point);
                let poses = self.robot.link_poses(&angles);
                let seen = self.in_view(camera_from_base, &poses, self.robot.joints.len());
                (seen && self.free(&poses)).then_some(angles)
            };
            (0..sweep.len()).into_par_iter().filter_map(keep).collect()
        };
        // So many points at most for each sample: more would say that hardly any pose can be seen.
        const POINTS: usize = 400;
        let mut sweep = Sweep::new(&self.robot, samples);
        let mut poses = kept(&sweep);
        while poses.len() < samples {
            // A coarse sweep may say little about how many poses a finer one has.
            let share = (poses.len() as f64 / sweep.len() as f64).max(0.125);
            let wanted = (samples as f64 / share) as usize;
            let finer = Sweep::new(&self.robot, wanted.max(sweep.len() + 1));
            // A robot whose joints cannot turn has no finer sweep.
            if sweep.len() > POINTS.saturating_mul(samples) || finer == sweep {
                return Err(RecordingError::TooFewPoses {
                    wanted: samples,
                    found: poses.len(),
                });
            }
            sweep = finer;
            poses = kept(&sweep);
        }
        log::debug!("{} of {} poses of the sweep kept", poses.len(), sweep.len());
        let evenly = |i: usize| poses.get(i * poses.len() / samples).cloned();
        Ok(Station {
            camera_from_base,
            seed,
            poses: (0..samples).filter_map(evenly).collect(),
        })
    }

    fn station_camera(&self, seed: u64) -> DAffine3 {
        const CAMERAS: usize = 100;
        const POSES: usize = 60;
        let mut rng = station_rng(seed);
        let support = Support::any(&mut rng.clone());
        let sweep = Sweep::new(&self.robot, 10 * POSES);
        let poses: Vec<Vec<DAffine3>> = (0..sweep.len())
            .step_by(sweep.len().div_ceil(5 * POSES))
            .map(|point| self.robot.link_poses(&sweep.angles(point)))
            .filter(|poses| self.free(poses))
            .take(POSES)
            .collect();
        let mut best = (-1.0, DAffine3::IDENTITY);
        for _ in 0..CAMERAS {
            let direction = direction(
                &mut rng,
                support.lowest_camera().max(5f64.to_radians()),
                PI / 4.0,
            );
            let distance = self.reach * rng.random_range(0.9..2.0);
            let aim = DVec3::new(0.0, 0.0, self.reach * rng.random_range(0.2..0.6));
            let pixel = [INTRINSICS.cx, INTRINSICS.cy + rng.random_range(-20.0..20.0)];
            let camera = look_at(aim, direction, distance, 0.0, pixel);
            // What is seen at another size counts against the camera.
            let score: f64 = poses
                .par_iter()
                .filter(|pose| self.in_view(camera, pose, self.robot.joints.len()))
                .map(|pose| match self.coverage(camera, pose) {
                    share if (0.06..0.17).contains(&share) => 1.0,
                    _ => -1.0,
                })
                .sum();
            if score > best.0 {
                best = (score, camera);
            }
        }
        best.1
    }

    /// Whether the robot meets neither itself nor the floor.
    fn free(&self, poses: &[DAffine3]) -> bool {
        !self.collision.floor_collision(poses, 0.0) && !self.collision.self_collision(poses)
    }

    fn seen_from(&self, camera_from_base: DAffine3, poses: &[DAffine3]) -> Vec<DVec3> {
        let joints = self.robot.joint_origins(poses);
        let seen = joints.into_iter();
        seen.map(|j| camera_from_base.transform_point3(j)).collect()
    }

    /// A camera that shows the robot at a random size, if the first try keeps the rules.
    fn aim(&self, poses: &[DAffine3], support: &Support, rng: &mut ChaCha8Rng) -> Option<DAffine3> {
        let wanted = (0.16f64.ln() + 0.5 * normal(rng)).exp().clamp(0.055, 0.43);
        let direction = direction(rng, support.lowest_camera(), PI / 3.0);
        let origins = self.robot.joint_origins(poses);
        let nearness: f64 = rng.random_range(0.0..1.0);
        let middle = origins.iter().sum::<DVec3>() / origins.len() as f64;
        let aim = middle.lerp(*origins.choose(rng)?, 0.7 * nearness);
        let roll = rng.random_range(-10f64..10.0).to_radians();
        let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
        let pixel = [
            INTRINSICS.cx + 0.13 * width * normal(rng),
            INTRINSICS.cy + 0.10 * height * normal(rng),
        ];
        let nearest = 0.55 * self.reach;
        let mut distance = self.reach / wanted.sqrt() * 0.36;
        let mut camera = look_at(aim, direction, distance.max(nearest), roll, pixel);
        for _ in 0..4 {
            let ratio = self.coverage(camera, poses) / wanted;
            distance = (distance * ratio.sqrt().clamp(0.6, 1.6)).clamp(nearest, 2.8 * self.reach);
            camera = look_at(aim, direction, distance, roll, pixel);
        }
        let coverage = self.coverage(camera, poses);
        let low = camera.inverse().translation.z < 0.08 && support.is_table();
        let fits = (0.05..0.45).contains(&coverage) && (0.6..1.6).contains(&(coverage / wanted));
        (fits && !low && self.in_view(camera, poses, 4)).then_some(camera)
    }

    /// Whether all joints are well before the camera, and at least `inside` of them in the picture.
    fn in_view(&self, camera_from_base: DAffine3, poses: &[DAffine3], inside: usize) -> bool {
        let joints = self.robot.joint_origins(poses);
        let seen = joints.iter().map(|&j| camera_from_base.transform_point3(j));
        let mut count = 0;
        for joint in seen {
            if joint.z < 0.2 {
                return false;
            }
            if let Some([u, v]) = INTRINSICS.project(joint.to_array()) {
                let inside = (0.0..f64::from(WIDTH - 1)).contains(&u)
                    && (0.0..f64::from(HEIGHT - 1)).contains(&v);
                count += usize::from(inside);
            }
        }
        count >= inside.min(joints.len())
    }

    /// The share of the picture that the robot covers, from its collision meshes at a quarter of the
    /// resolution.
    fn coverage(&self, camera_from_base: DAffine3, poses: &[DAffine3]) -> f64 {
        const STEP: f32 = 4.0;
        const COLUMNS: usize = (WIDTH / 4) as usize;
        const ROWS: usize = (HEIGHT / 4) as usize;
        let mut covered = vec![false; COLUMNS * ROWS];
        let k = INTRINSICS;
        let (f, cx, cy) = ((k.fx as f32) / STEP, k.cx as f32 / STEP, k.cy as f32 / STEP);
        for &(link, mesh) in &self.shadow {
            let (Some(&pose), Some(mesh)) = (poses.get(link), self.meshes.get(mesh)) else {
                continue;
            };
            let map = camera_from_base * pose;
            let (matrix, shift) = (map.matrix3.as_mat3(), map.translation.as_vec3());
            let pixels: Vec<Option<[f32; 2]>> = mesh
                .positions
                .iter()
                .map(|&p| {
                    let p = matrix * glam::Vec3::from(p) + shift;
                    (p.z > 0.05).then(|| [f * p.x / p.z + cx, f * p.y / p.z + cy])
                })
                .collect();
            let pixel = |i: u32| pixels.get(i as usize).copied().flatten();
            for &[a, b, c] in mesh.indices.as_chunks::<3>().0 {
                if let (Some(a), Some(b), Some(c)) = (pixel(a), pixel(b), pixel(c)) {
                    fill_triangle(&mut covered, COLUMNS, ROWS, [a, b, c]);
                }
            }
        }
        covered.iter().filter(|&&c| c).count() as f64 / covered.len() as f64
    }

    fn empty_shot(
        &self,
        support: Support,
        look: &mut ChaCha8Rng,
        rng: &mut ChaCha8Rng,
        photos: usize,
    ) -> Shot {
        let aim = DVec3::new(0.0, 0.0, rng.random_range(0.0..0.5));
        let direction = direction(rng, support.lowest_camera(), PI / 3.0);
        let roll = rng.random_range(-10f64..10.0).to_radians();
        let pixel = [
            INTRINSICS.cx + rng.random_range(-120.0..120.0),
            INTRINSICS.cy + rng.random_range(-100.0..100.0),
        ];
        let distance = self.reach * rng.random_range(0.7..2.2);
        let camera = look_at(aim, direction, distance, roll, pixel);
        self.dress(camera, support, None, look, rng, photos)
    }

    /// Puts everything into a shot. `look` draws what a recording with a fixed camera keeps: support, colours, tool.
    fn dress(
        &self,
        camera_from_base: DAffine3,
        support: Support,
        robot: Option<(Vec<f64>, Vec<DAffine3>)>,
        look: &mut ChaCha8Rng,
        rng: &mut ChaCha8Rng,
        photos: usize,
    ) -> Shot {
        let mut build = Builder {
            items: Vec::new(),
            camera: camera_from_base.inverse().translation,
            arm: Vec::new(),
        };
        let mut centre = DVec3::new(0.0, 0.0, 0.3);
        let bare = robot.is_none() && look.random_bool(0.4);
        let floor = if bare {
            None
        } else {
            support.build(&mut build, look)
        };
        if let Some((_, poses)) = &robot {
            build.arm = self.robot.joint_origins(poses);
            build.arm.insert(0, DVec3::ZERO);
            centre = build.arm.iter().sum::<DVec3>() / build.arm.len() as f64;
            self.add_robot(&mut build, poses, look);
            if let Some(tool) = self.tool.and_then(|t| poses.get(t)) {
                build.gripper(*tool, support.is_table(), look);
            }
            if rng.random_bool(0.3) {
                build.cables(rng);
            }
        }
        build.room(floor, rng);
        build.clutter(&support, floor, robot.is_none(), rng);
        if let Some((_, poses)) = &robot
            && rng.random_bool(0.25)
        {
            build.occluders(&self.robot.joint_origins(poses), rng);
        }
        let posed = robot.map(|(angles, poses)| Posed {
            angles,
            joints: self
                .robot
                .joint_origins(&poses)
                .into_iter()
                .map(|j| camera_from_base.transform_point3(j))
                .collect(),
        });
        let texture = PhotoView::any(rng, photos, false);
        let textured = build.items.iter().any(|item| item.material.photo > 0.0);
        Shot {
            scene: Scene {
                camera_from_base,
                items: build.items,
                lighting: lighting(rng),
                centre,
            },
            background: PhotoView::any(rng, photos, true),
            texture: textured.then_some(texture),
            effects: Effects::any(rng),
            robot: posed,
        }
    }

    fn add_robot(&self, build: &mut Builder, poses: &[DAffine3], rng: &mut ChaCha8Rng) {
        let cap = match rng.random_range(0.0..1.0) {
            p if p < 0.62 => hsv(
                rng.random_range(0.52..0.60),
                rng.random_range(0.18..0.5),
                rng.random_range(0.6..0.92),
            ),
            p if p < 0.87 => grey(rng, 0.38, 0.78),
            _ => grey(rng, 0.14, 0.36),
        };
        let tube = grey(rng, 0.62, 0.9);
        let housing = if rng.random_bool(0.8) {
            grey(rng, 0.4, 0.8)
        } else {
            grey(rng, 0.25, 0.45)
        };
        let rubber = grey(rng, 0.05, 0.3);
        let tube_metal = rng.random_range(0.15..0.9);
        let housing_metal = rng.random_range(0.0..0.65);
        let gloss = rng.random_range(0.0..1.0f32);
        for part in &self.visual {
            let Some(&pose) = poses.get(part.link) else {
                continue;
            };
            let (albedo, metal, specular, shininess) = match part.finish {
                Finish::Cap => (cap, 0.0, 0.05 + 0.25 * gloss, 8.0 + 60.0 * gloss),
                Finish::Tube => (tube, tube_metal, 0.1 + 0.4 * gloss, 12.0 + 40.0 * gloss),
                Finish::Housing => (
                    housing,
                    housing_metal,
                    0.05 + 0.3 * gloss,
                    10.0 + 40.0 * gloss,
                ),
                Finish::Rubber => (rubber, 0.0, 0.04, 8.0),
            };
            let shade = rng.random_range(0.93..1.07f32);
            let material = Material {
                albedo: albedo.map(|c| (c * shade).clamp(0.0, 1.0)),
                metal,
                specular,
                shininess,
                ..MATT
            };
            build.items.push(Item {
                mesh: part.mesh,
                base_from_mesh: pose,
                material,
                kind: Kind::Robot,
            });
        }
        for &(link, mesh) in &self.shadow {
            let Some(&pose) = poses.get(link) else {
                continue;
            };
            build.items.push(Item {
                mesh,
                base_from_mesh: pose,
                material: MATT,
                kind: Kind::Shadow,
            });
        }
    }
}

fn station_rng(seed: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(u64::MAX);
    rng
}

/// Marks the pixels whose centres are in a triangle.
fn fill_triangle(covered: &mut [bool], columns: usize, rows: usize, [a, b, c]: [[f32; 2]; 3]) {
    let low = |axis: usize| a[axis].min(b[axis]).min(c[axis]).ceil().max(0.0) as usize;
    let high = |axis: usize, end: usize| {
        (a[axis]
            .max(b[axis])
            .max(c[axis])
            .floor()
            .min(end as f32 - 1.0)
            + 1.0)
            .max(0.0) as usize
    };
    let edge = |p: [f32; 2], q: [f32; 2], x: f32, y: f32| {
        (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
    };
    let columns_in = low(0)..high(0, columns);
    for y in low(1)..high(1, rows) {
        let row = covered
            .get_mut(y * columns..(y + 1) * columns)
            .unwrap_or_default();
        for (x, slot) in row
            .iter_mut()
            .enumerate()
            .take(columns_in.end)
            .skip(columns_in.start)
        {
            let (fx, fy) = (x as f32, y as f32);
            let (e0, e1, e2) = (edge(a, b, fx, fy), edge(b, c, fx, fy), edge(c, a, fx, fy));
            let inside =
                (e0 >= 0.0 && e1 >= 0.0 && e2 >= 0.0) || (e0 <= 0.0 && e1 <= 0.0 && e2 <= 0.0);
            *slot |= inside;
        }
    }
}

/// A camera `distance` from `aim` along `direction`, which sees `aim` at `pixel`.
fn look_at(aim: DVec3, direction: DVec3, distance: f64, roll: f64, pixel: [f64; 2]) -> DAffine3 {
    let forward = -direction;
    let right = forward.cross(DVec3::Z).normalize_or(DVec3::X);
    let down = forward.cross(right);
    let k = INTRINSICS;
    let ray = DVec3::new((pixel[0] - k.cx) / k.fx, (pixel[1] - k.cy) / k.fy, 1.0).normalize();
    let rotation = DMat3::from_cols(right, down, forward)
        * DMat3::from_rotation_z(roll)
        * DMat3::from_quat(DQuat::from_rotation_arc(ray, DVec3::Z));
    DAffine3::from_mat3_translation(rotation, aim + direction * distance).inverse()
}
