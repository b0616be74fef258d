//! Random shots of a robot: its pose, the camera, and how it all looks.

use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DQuat, DVec3};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::background::PhotoView;
use super::chance::{direction, grey, hsv, normal};
use super::collision::CollisionModel;
use super::effects::{Effects, Window};
use super::props::{Builder, MATT, PRIMITIVES, Support, lighting, line_distance};
use super::scene::{Item, Kind, Material, Scene};
use super::sweep::Sweep;
use super::{HEIGHT, INTRINSICS, RecorderError, WIDTH};
use crate::robot::{Frames, Mesh, Robot, RobotError};

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

/// One of the bodies that a recording's robot may have.
struct Body {
    robot: Robot,
    collision: CollisionModel,
    visual: Vec<Part>,
    shadow: Vec<(usize, usize)>,
    /// The farthest that a joint gets from the second joint, metres.
    reach: f64,
    /// The frame that grippers are put on, z outwards.
    tool: Option<usize>,
}

/// A body in a pose.
struct Arm<'a> {
    body: &'a Body,
    angles: Vec<f64>,
    /// Poses of the links in the base frame of the recording's robot.
    poses: Vec<DAffine3>,
}

/// One camera's view of a scene.
struct View {
    camera_from_base: DAffine3,
    window: Window,
    /// What it is drawn from; `None` for the first camera.
    rng: Option<ChaCha8Rng>,
}

/// A robot ready to be put into scenes.
pub struct Stage {
    meshes: Vec<Mesh>,
    main: Body,
    others: Vec<Body>,
}

/// A recording with fixed cameras: what stays the same, and the robot's poses.
pub struct Station {
    cameras_from_base: Vec<DAffine3>,
    seed: u64,
    poses: Vec<Vec<f64>>,
}

impl Body {
    fn load(mut robot: Robot, meshes: &mut Vec<Mesh>) -> Body {
        let collision = CollisionModel::new(&robot);
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
        let mut body = Body {
            robot,
            collision,
            visual,
            shadow,
            reach: 0.0,
            tool,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..200 {
            let angles = body.any_angles(&mut rng);
            let origins = body.robot.joint_origins(&body.robot.link_poses(&angles));
            let centre = origins
                .get(1)
                .or(origins.first())
                .copied()
                .unwrap_or_default();
            let farthest = origins
                .iter()
                .map(|o| o.distance(centre))
                .fold(0.1, f64::max);
            body.reach = body.reach.max(farthest);
        }
        body
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

    fn arm(&self, angles: Vec<f64>) -> Arm<'_> {
        Arm {
            body: self,
            poses: self.robot.link_poses(&angles),
            angles,
        }
    }

    fn any_arm(&self, rng: &mut ChaCha8Rng) -> Option<Arm<'_>> {
        (0..200)
            .map(|_| self.arm(self.angles(rng)))
            .find(Arm::is_free)
    }
}

impl Stage {
    /// Loads a robot and its meshes; see [`Robot::load`]. `bodies` are other bodies that the robot may
    /// have in recordings with a free camera: [`Frames`] and URDF.
    ///
    /// # Errors
    /// As [`Robot::load`] and [`Frames::read`]; a body's joints have other names than the robot's, or
    /// it lacks what its frames name.
    pub fn load(
        urdf: &Path,
        packages: &[(String, PathBuf)],
        bodies: &[(PathBuf, PathBuf)],
    ) -> Result<Stage, RecorderError> {
        let mut meshes: Vec<Mesh> = PRIMITIVES.iter().map(|make| make()).collect();
        let main = Body::load(Robot::load(urdf, packages)?, &mut meshes);
        let names = |robot: &Robot| -> Vec<String> {
            robot.joints.iter().map(|j| j.name.clone()).collect()
        };
        let mut others = Vec::new();
        for (frames, urdf) in bodies {
            let mut robot = Robot::load(urdf, packages)?;
            let (expected, found) = (names(&main.robot), names(&robot));
            if found != expected {
                return Err(RobotError::Urdf {
                    path: urdf.clone(),
                    message: format!(
                        "expected the robot's joints ({}), found {}",
                        expected.join(", "),
                        found.join(", ")
                    ),
                }
                .into());
            }
            robot
                .set_frames(&Frames::read(frames)?)
                .map_err(|message| RobotError::Frames {
                    path: frames.clone(),
                    message: format!("{message} in {}", urdf.display()),
                })?;
            others.push(Body::load(robot, &mut meshes));
        }
        Ok(Stage {
            meshes,
            main,
            others,
        })
    }

    /// All meshes that scenes refer to.
    pub fn meshes(&self) -> &[Mesh] {
        &self.meshes
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.main.robot
    }

    /// The robot as it is described, or one of its other bodies as often.
    fn any_body(&self, rng: &mut ChaCha8Rng) -> &Body {
        let other = self.others.choose(rng);
        other
            .filter(|_| rng.random_bool(0.55))
            .unwrap_or(&self.main)
    }

    /// Sample `id` of a recording with free cameras, a shot a camera of one scene: the same for the same
    /// `seed`, `id` and `cameras`. `photos`: how many background photos there are.
    ///
    /// # Errors
    /// No pose and cameras that keep the rules were found.
    pub fn free_shots(
        &self,
        seed: u64,
        id: u64,
        cameras: usize,
        photos: usize,
    ) -> Result<Vec<Shot>, RecorderError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(id);
        let mut look = ChaCha8Rng::from_rng(&mut rng);
        let support = Support::any(&mut look);
        let window = Window::any(&mut look);
        let mut views = vec![View::new(window)];
        // A recording of one camera draws nothing for others.
        for number in 1..cameras as u64 {
            views.push(View::another(seed, id, number));
        }
        if rng.random_bool(0.15) {
            for view in &mut views {
                let rng = view.rng.as_mut().unwrap_or(&mut rng);
                view.camera_from_base = self.look_around(&support, rng);
            }
            return Ok(self.dress(views, support, &[], &mut look, &mut rng, photos));
        }
        let body = self.any_body(&mut rng);
        for _ in 0..100 {
            let Some(arm) = body.any_arm(&mut rng) else {
                continue;
            };
            for _ in 0..8 {
                let Some(camera) = self.aim(&arm, &support, &window, &mut rng) else {
                    continue;
                };
                let aimed = views.iter_mut().all(|view| match &mut view.rng {
                    None => {
                        view.camera_from_base = camera;
                        true
                    }
                    Some(rng) => {
                        let mut tries =
                            (0..40).map(|_| self.aim(&arm, &support, &view.window, rng));
                        let found = tries.find_map(|camera| camera);
                        view.camera_from_base = found.unwrap_or_default();
                        found.is_some()
                    }
                });
                if !aimed {
                    continue;
                }
                let second = if rng.random_bool(0.14) {
                    self.second(&arm, &views, &mut rng)
                } else {
                    None
                };
                let arms: Vec<Arm> = std::iter::once(arm).chain(second).collect();
                return Ok(self.dress(views, support, &arms, &mut look, &mut rng, photos));
            }
        }
        Err(RecorderError::NoScene { id })
    }

    /// Sample `id` of a recording with fixed cameras, a shot a camera: the photos behind the robot and the
    /// light are the sample's own, all else is the station's.
    ///
    /// # Errors
    /// The station has fewer samples.
    pub fn fixed_shots(
        &self,
        station: &Station,
        id: u64,
        photos: usize,
    ) -> Result<Vec<Shot>, RecorderError> {
        let pose = usize::try_from(id).ok().and_then(|i| station.poses.get(i));
        let Some(angles) = pose else {
            return Err(RecorderError::NoScene { id });
        };
        let arm = self.main.arm(angles.clone());
        let mut rng = ChaCha8Rng::seed_from_u64(station.seed);
        rng.set_stream(id);
        let mut look = station_rng(station.seed);
        let support = Support::any(&mut look);
        let mut build = Builder::new(&station.cameras_from_base);
        support.build(&mut build, &mut look);
        let texture = PhotoView::any(&mut look, photos, false);
        // Last, as poses that leave no room for a tool draw less.
        let centre = put_arm(&mut build, &arm, &support, &mut look);
        let textured = build.items.iter().any(|item| item.material.photo > 0.0);
        let lighting = lighting(&mut rng);
        let cameras = station.cameras_from_base.iter();
        Ok(cameras
            .map(|&camera_from_base| Shot {
                scene: Scene {
                    camera_from_base,
                    items: build.items.clone(),
                    lighting: lighting.clone(),
                    centre,
                },
                background: PhotoView::any(&mut rng, photos, true),
                texture: textured.then_some(texture.clone()),
                effects: Effects::any(&mut rng, Window::WHOLE),
                robot: Some(arm.posed(camera_from_base)),
            })
            .collect())
    }

    /// The cameras and the `samples` poses of a recording with fixed cameras (the paper, section 2): all
    /// joints are swept through their ranges in equal steps, in combination, and poses in which the robot
    /// meets itself or the floor, or has a joint outside one of the pictures, are left out. The more samples,
    /// the finer the steps.
    ///
    /// Each camera is one that shows the robot whole and on 6 to 17 % of the picture (the paper, section 3)
    /// in as many poses as possible; cameras look from directions that are 30 degrees apart or more.
    ///
    /// # Errors
    /// There are not as many such poses.
    pub fn station(
        &self,
        seed: u64,
        cameras: usize,
        samples: usize,
    ) -> Result<Station, RecorderError> {
        let mut cameras_from_base: Vec<DAffine3> = Vec::new();
        for _ in 0..cameras {
            let camera = self.station_camera(seed, &cameras_from_base);
            cameras_from_base.push(camera);
        }
        let kept = |sweep: &Sweep| -> Vec<Vec<f64>> {
            let keep = |point: usize| {
                let arm = self.main.arm(sweep.angles(point));
                let seen = cameras_from_base
                    .iter()
                    .all(|&camera| arm.in_view(camera, &Window::WHOLE) >= Some(arm.joints()));
                (seen && arm.is_free()).then_some(arm.angles)
            };
            (0..sweep.len()).into_par_iter().filter_map(keep).collect()
        };
        // So many points at most for each sample: more would say that hardly any pose can be seen.
        const POINTS: usize = 400;
        let mut sweep = Sweep::new(&self.main.robot, samples);
        let mut poses = kept(&sweep);
        while poses.len() < samples {
            // A coarse sweep may say little about how many poses a finer one has.
            let share = (poses.len() as f64 / sweep.len() as f64).max(0.125);
            let wanted = (samples as f64 / share) as usize;
            let finer = Sweep::new(&self.main.robot, wanted.max(sweep.len() + 1));
            // A robot whose joints cannot turn has no finer sweep.
            if sweep.len() > POINTS.saturating_mul(samples) || finer == sweep {
                return Err(RecorderError::TooFewPoses {
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
            cameras_from_base,
            seed,
            poses: (0..samples).filter_map(evenly).collect(),
        })
    }

    /// A camera beside `others`.
    fn station_camera(&self, seed: u64, others: &[DAffine3]) -> DAffine3 {
        const CAMERAS: usize = 100;
        const POSES: usize = 60;
        let mut rng = station_rng(seed);
        let support = Support::any(&mut rng.clone());
        if !others.is_empty() {
            rng.set_stream(u64::MAX - others.len() as u64);
        }
        let apart = |camera: DAffine3| {
            let forward = |camera: DAffine3| camera.matrix3.row(2);
            let others = others.iter().map(|&other| forward(other));
            others
                .map(|other| other.angle_between(forward(camera)))
                .fold(PI, f64::min)
        };
        let sweep = Sweep::new(&self.main.robot, 10 * POSES);
        let poses: Vec<Arm> = (0..sweep.len())
            .step_by(sweep.len().div_ceil(5 * POSES))
            .map(|point| self.main.arm(sweep.angles(point)))
            .filter(Arm::is_free)
            .take(POSES)
            .collect();
        let mut best = (-1.0, DAffine3::IDENTITY);
        for _ in 0..CAMERAS {
            let direction = direction(
                &mut rng,
                support.lowest_camera().max(5f64.to_radians()),
                PI / 4.0,
            );
            let distance = self.main.reach * rng.random_range(0.9..2.0);
            let aim = DVec3::new(0.0, 0.0, self.main.reach * rng.random_range(0.2..0.6));
            let pixel = [INTRINSICS.cx, INTRINSICS.cy + rng.random_range(-20.0..20.0)];
            let camera = look_at(aim, direction, distance, 0.0, pixel);
            if apart(camera) < PI / 6.0 {
                continue;
            }
            // What is seen at another size counts against the camera.
            let whole = &Window::WHOLE;
            let score: f64 = poses
                .par_iter()
                .filter(|arm| arm.in_view(camera, whole) >= Some(arm.joints()))
                .map(|arm| match self.coverage(camera, arm, whole) {
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

    /// A camera that shows the arm at a random size, if the first try keeps the rules.
    fn aim(
        &self,
        arm: &Arm,
        support: &Support,
        window: &Window,
        rng: &mut ChaCha8Rng,
    ) -> Option<DAffine3> {
        let wanted = (0.095f64.ln() + 0.8 * normal(rng)).exp().clamp(0.015, 0.44);
        let lowest = support.lowest_camera();
        let level = 25f64.to_radians();
        let direction = if rng.random_bool(0.6) {
            direction(rng, lowest, level)
        } else {
            direction(rng, level, PI / 3.0)
        };
        let cut = rng.random_bool(0.15) || wanted > 0.2;
        let origins = arm.joint_origins();
        let nearness: f64 = rng.random_range(0.0..1.0);
        let middle = origins.iter().sum::<DVec3>() / origins.len() as f64;
        let aim = middle.lerp(*origins.choose(rng)?, 0.7 * nearness);
        let roll = any_roll(rng);
        // Small arms may stand anywhere.
        let spread = (0.22 - 0.5 * wanted).max(0.1);
        let [left, top, right, bottom] = window.edges();
        let pixel = [
            0.5 * (left + right) + spread * (right - left) * normal(rng),
            0.5 * (top + bottom) + spread * (bottom - top) * normal(rng),
        ];
        let reach = arm.body.reach;
        let nearest = 0.5 * reach;
        let mut distance = reach / wanted.sqrt() * 0.36;
        let mut camera = look_at(aim, direction, distance.max(nearest), roll, pixel);
        for _ in 0..4 {
            let ratio = self.coverage(camera, arm, window) / wanted;
            distance = (distance * ratio.sqrt().clamp(0.6, 1.6)).clamp(nearest, 4.0 * reach);
            camera = look_at(aim, direction, distance, roll, pixel);
        }
        let coverage = self.coverage(camera, arm, window);
        let low = camera.inverse().translation.z < 0.08 && support.is_table();
        let fits = (0.013..0.45).contains(&coverage) && (0.6..1.6).contains(&(coverage / wanted));
        let inside = if cut { 3 } else { arm.joints() };
        (fits && !low && arm.in_view(camera, window)? >= inside.min(arm.joints())).then_some(camera)
    }

    /// A second arm in the same place, clear of the first, in the first of the `views`, and in all smaller than the first.
    fn second(&self, first: &Arm, views: &[View], rng: &mut ChaCha8Rng) -> Option<Arm<'_>> {
        let spine = first.body.robot.spine(&first.poses);
        let covers =
            |view: &View, arm: &Arm| self.coverage(view.camera_from_base, arm, &view.window);
        let largest: Vec<f64> = views.iter().map(|view| covers(view, first)).collect();
        let main = views.first()?;
        (0..12).find_map(|_| {
            let mut arm = self.any_body(rng).any_arm(rng)?;
            let distance = arm.body.reach * rng.random_range(0.5..1.8);
            let yaw = rng.random_range(0.0..TAU);
            let height = if rng.random_bool(0.7) {
                0.0
            } else {
                rng.random_range(-0.3..0.3)
            };
            let place = DAffine3::from_rotation_translation(
                DQuat::from_rotation_z(rng.random_range(0.0..TAU)),
                DVec3::new(distance * yaw.cos(), distance * yaw.sin(), height),
            );
            arm.poses.iter_mut().for_each(|pose| *pose = place * *pose);
            let own = arm.body.robot.spine(&arm.poses);
            let clear = own
                .windows(2)
                .flat_map(|ends| [ends[0], 0.5 * (ends[0] + ends[1])])
                .all(|point| line_distance(&spine, point) > 0.2);
            let is_far = |view: &View| view.camera_from_base.transform_point3(arm.base()).z >= 0.6;
            let fits = clear
                && views.iter().all(is_far)
                && arm.in_view(main.camera_from_base, &main.window) >= Some(1)
                && covers(main, &arm) > 0.004
                && views
                    .iter()
                    .zip(&largest)
                    .all(|(view, &largest)| covers(view, &arm) < largest);
            fits.then_some(arm)
        })
    }

    /// The share of the picture that the robot covers, from its collision meshes at a quarter of the
    /// resolution.
    fn coverage(&self, camera_from_base: DAffine3, arm: &Arm, window: &Window) -> f64 {
        const STEP: f32 = 4.0;
        const COLUMNS: usize = (WIDTH / 4) as usize;
        const ROWS: usize = (HEIGHT / 4) as usize;
        let mut covered = vec![false; COLUMNS * ROWS];
        let k = INTRINSICS;
        let (f, cx, cy) = ((k.fx as f32) / STEP, k.cx as f32 / STEP, k.cy as f32 / STEP);
        for &(link, mesh) in &arm.body.shadow {
            let (Some(&pose), Some(mesh)) = (arm.poses.get(link), self.meshes.get(mesh)) else {
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
        let seen = (0..).zip(&covered).filter(|&(i, &c)| {
            let pixel = [i % COLUMNS, i / COLUMNS].map(|c| STEP as u32 * c as u32);
            c && window.contains(pixel)
        });
        seen.count() as f64 / covered.len() as f64
    }

    /// A camera for a picture without a robot.
    fn look_around(&self, support: &Support, rng: &mut ChaCha8Rng) -> DAffine3 {
        let aim = DVec3::new(0.0, 0.0, rng.random_range(0.0..0.5));
        let direction = direction(rng, support.lowest_camera(), PI / 3.0);
        let roll = any_roll(rng);
        let pixel = [
            INTRINSICS.cx + rng.random_range(-120.0..120.0),
            INTRINSICS.cy + rng.random_range(-100.0..100.0),
        ];
        let distance = self.main.reach * rng.random_range(0.7..3.0);
        look_at(aim, direction, distance, roll, pixel)
    }

    /// Puts everything into a scene, and takes a shot of it a view. `arms`: the robot, then others. `look`
    /// draws what a recording with a fixed camera keeps: support, colours, tool.
    fn dress(
        &self,
        views: Vec<View>,
        support: Support,
        arms: &[Arm],
        look: &mut ChaCha8Rng,
        rng: &mut ChaCha8Rng,
        photos: usize,
    ) -> Vec<Shot> {
        let cameras: Vec<DAffine3> = views.iter().map(|view| view.camera_from_base).collect();
        let mut build = Builder::new(&cameras);
        let mut centre = DVec3::new(0.0, 0.0, 0.3);
        let bare = arms.is_empty() && look.random_bool(0.4);
        let floor = if bare {
            None
        } else {
            support.build(&mut build, look)
        };
        for (n, arm) in arms.iter().enumerate() {
            if n > 0 {
                build.plinth(arm.base(), floor, look);
            }
            let middle = put_arm(&mut build, arm, &support, look);
            if n == 0 {
                centre = middle;
            }
            if rng.random_bool(0.5) {
                build.cables(arm.body.reach, rng);
            }
        }
        build.room(floor, rng);
        build.clutter(&support, floor, arms.is_empty(), rng);
        build.people(floor.unwrap_or(-0.8), rng);
        if let Some(arm) = arms.first()
            && rng.random_bool(0.25)
        {
            build.occluders(&arm.joint_origins(), rng);
        }
        let texture = PhotoView::any(rng, photos, false);
        let textured = build.items.iter().any(|item| item.material.photo > 0.0);
        let lighting = lighting(rng);
        let mut shots = Vec::with_capacity(views.len());
        for mut view in views {
            let rng = view.rng.as_mut().unwrap_or(rng);
            shots.push(Shot {
                scene: Scene {
                    camera_from_base: view.camera_from_base,
                    items: build.items.clone(),
                    lighting: lighting.clone(),
                    centre,
                },
                background: PhotoView::any(rng, photos, true),
                texture: textured.then_some(texture.clone()),
                effects: Effects::any(rng, view.window),
                robot: arms.first().map(|arm| arm.posed(view.camera_from_base)),
            });
        }
        shots
    }
}

impl View {
    /// The first camera's, which is drawn together with the scene.
    fn new(window: Window) -> Self {
        Self {
            camera_from_base: DAffine3::IDENTITY,
            window,
            rng: None,
        }
    }

    /// That of camera `number`, which is drawn on its own.
    fn another(seed: u64, id: u64, number: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // Ids fill the streams from below, stations from above.
        rng.set_stream((number << 48) ^ id);
        Self {
            window: Window::any(&mut rng),
            rng: Some(rng),
            ..Self::new(Window::WHOLE)
        }
    }
}

impl Arm<'_> {
    /// Whether the arm meets neither itself nor the floor.
    fn is_free(&self) -> bool {
        let collision = &self.body.collision;
        !collision.floor_collision(&self.poses, 0.0) && !collision.self_collision(&self.poses)
    }

    fn posed(&self, camera_from_base: DAffine3) -> Posed {
        let joints = self.joint_origins().into_iter();
        Posed {
            angles: self.angles.clone(),
            joints: joints
                .map(|j| camera_from_base.transform_point3(j))
                .collect(),
        }
    }

    fn joints(&self) -> usize {
        self.body.robot.joints.len()
    }

    fn base(&self) -> DVec3 {
        let pose = self.poses.get(self.body.robot.base_link());
        pose.copied().unwrap_or_default().translation
    }

    fn joint_origins(&self) -> Vec<DVec3> {
        self.body.robot.joint_origins(&self.poses)
    }

    /// How many joints are in the window; `None` where one is not well before the camera.
    fn in_view(&self, camera_from_base: DAffine3, window: &Window) -> Option<usize> {
        let mut count = 0;
        for joint in self.joint_origins() {
            let joint = camera_from_base.transform_point3(joint);
            if joint.z < 0.2 {
                return None;
            }
            let [u, v] = INTRINSICS.project(joint.to_array())?;
            let [left, top, right, bottom] = window.edges();
            let inside = (left..right - 1.0).contains(&u) && (top..bottom - 1.0).contains(&v);
            count += usize::from(inside);
        }
        Some(count)
    }
}

/// Mostly small; now and then a camera that is held askew.
fn any_roll(rng: &mut ChaCha8Rng) -> f64 {
    let spread = if rng.random_bool(0.1) { 12.0 } else { 3.5 };
    (spread * normal(rng)).to_radians()
}

/// Puts an arm with a tool into a scene; returns its middle.
fn put_arm(build: &mut Builder, arm: &Arm, support: &Support, look: &mut ChaCha8Rng) -> DVec3 {
    let spine = arm.body.robot.spine(&arm.poses);
    let middle = spine.iter().sum::<DVec3>() / spine.len() as f64;
    build.arms.push(spine);
    add_robot(build, arm, look);
    if let Some(tool) = arm.body.tool.and_then(|t| arm.poses.get(t)) {
        build.gripper(*tool, support.is_table(), look);
    }
    middle
}

fn add_robot(build: &mut Builder, arm: &Arm, rng: &mut ChaCha8Rng) {
    let cap = match rng.random_range(0.0..1.0) {
        p if p < 0.65 => hsv(
            rng.random_range(0.52..0.60),
            rng.random_range(0.12..0.5),
            rng.random_range(0.65..0.97),
        ),
        p if p < 0.9 => grey(rng, 0.4, 0.9),
        _ => grey(rng, 0.14, 0.4),
    };
    let tube = grey(rng, 0.7, 0.97);
    let housing = match rng.random_range(0.0..1.0) {
        p if p < 0.5 => grey(rng, 0.36, 0.62),
        p if p < 0.85 => grey(rng, 0.6, 0.88),
        _ => grey(rng, 0.2, 0.38),
    };
    let rubber = grey(rng, 0.05, 0.3);
    let tube_metal = rng.random_range(0.45..1.0);
    let housing_metal = rng.random_range(0.0..0.7);
    let gloss = rng.random_range(0.0..1.0f32);
    for part in &arm.body.visual {
        let Some(&pose) = arm.poses.get(part.link) else {
            continue;
        };
        let (albedo, metal, specular, shininess) = match part.finish {
            Finish::Cap => (cap, 0.12 * gloss, 0.05 + 0.35 * gloss, 8.0 + 60.0 * gloss),
            Finish::Tube => (tube, tube_metal, 0.1 + 0.5 * gloss, 12.0 + 40.0 * gloss),
            Finish::Housing => (
                housing,
                housing_metal,
                0.05 + 0.35 * gloss,
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
    for &(link, mesh) in &arm.body.shadow {
        let Some(&pose) = arm.poses.get(link) else {
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
