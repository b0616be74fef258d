//! Random scenes: the robot in a pose, what it stands on, what is around it, light and camera.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::background::PhotoView;
use super::collision::CollisionModel;
use super::effects::Effects;
use super::mesh::Mesh;
use super::robot::Robot;
use super::{HEIGHT, INTRINSICS, RecordingError, WIDTH};

/// How an item takes part in the picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Part of the robot: visible, and 1 in the mask.
    Robot,
    /// Casts the robot's shadow and is not seen.
    Shadow,
    /// Visible, casts a shadow, and hides the robot behind it from the mask.
    Scenery,
    /// Like scenery, without a shadow: floors and walls.
    Surface,
    /// A cable: visible, but what the mask says of the pixel stays.
    Cable,
}

impl Kind {
    /// Whether the item is drawn into the shadow map.
    pub fn casts_shadow(self) -> bool {
        matches!(self, Kind::Shadow | Kind::Scenery | Kind::Cable)
    }
}

/// What a surface looks like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Linear RGB in [0, 1].
    pub albedo: [f32; 3],
    /// 0 for a matt surface, 1 for one that only mirrors its surroundings.
    pub metal: f32,
    /// Strength of the highlights.
    pub specular: f32,
    /// Exponent of the highlights.
    pub shininess: f32,
    /// How much of the texture photo replaces the colour, 0 to 1.
    pub photo: f32,
    /// Repeats of the photo a metre.
    pub photo_scale: f32,
    /// Where on the photo the surface's origin is, in photo widths and heights.
    pub photo_offset: [f32; 2],
}

/// A mesh with a place and a material.
#[derive(Debug, Clone)]
pub struct Item {
    /// Which of the stage's meshes.
    pub mesh: usize,
    /// From the mesh's frame to the robot's base frame, scale included.
    pub base_from_mesh: DAffine3,
    /// What it looks like.
    pub material: Material,
    /// How it takes part.
    pub kind: Kind,
}

/// A light from far away.
#[derive(Debug, Clone, Copy)]
pub struct Lamp {
    /// Unit vector towards the light, base frame.
    pub direction: DVec3,
    /// Linear RGB; 0 is off.
    pub colour: [f32; 3],
}

/// All light in a scene.
#[derive(Debug, Clone)]
pub struct Lighting {
    /// Lights; the first one casts shadows.
    pub lamps: [Lamp; 3],
    /// How dark its shadows are, 0 to 1.
    pub shadow: f32,
    /// Linear RGB of the light from above.
    pub sky: [f32; 3],
    /// Linear RGB of the light from below.
    pub ground: [f32; 3],
    /// What metal mirrors: waves over directions of the base frame (wave vector, phase).
    pub mirrored: [(DVec3, f32); 3],
}

/// The robot's part in a scene.
#[derive(Debug, Clone)]
pub struct Posed {
    /// Joint angles, radians.
    pub angles: Vec<f64>,
    /// Joint origins in the camera optical frame, metres.
    pub joints: Vec<DVec3>,
}

/// Everything that one picture shows.
#[derive(Debug, Clone)]
pub struct Scene {
    /// From the robot's base frame to the camera optical frame.
    pub camera_from_base: DAffine3,
    /// What is drawn.
    pub items: Vec<Item>,
    /// The light.
    pub lighting: Lighting,
    /// The middle of the scene, base frame: shadows are drawn around it.
    pub centre: DVec3,
    /// The photo behind everything.
    pub background: PhotoView,
    /// The photo on textured surfaces, where there are any.
    pub texture: Option<PhotoView>,
    /// What the camera does to the picture.
    pub effects: Effects,
    /// The robot; `None` for a picture without one.
    pub robot: Option<Posed>,
}

const CUBOID: usize = 0;
const CYLINDER: usize = 1;
const SPHERE: usize = 2;

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

/// What stays the same over a recording with a fixed camera.
pub struct Station {
    camera_from_base: DAffine3,
    seed: u64,
}

impl Stage {
    /// Loads a robot and its meshes; see [`Robot::load`].
    ///
    /// # Errors
    /// As [`Robot::load`].
    pub fn load(
        urdf: &Path,
        packages: &[(String, std::path::PathBuf)],
    ) -> Result<Stage, RecordingError> {
        let mut robot = Robot::load(urdf, packages)?;
        let collision = CollisionModel::new(&robot);
        let mut meshes = vec![Mesh::cuboid(), Mesh::cylinder(), Mesh::sphere()];
        let mut visual = Vec::new();
        let mut shadow = Vec::new();
        for (index, link) in robot.links.iter_mut().enumerate() {
            for mesh in link.visual.drain(..) {
                visual.push(Part { link: index, mesh: meshes.len(), finish: Finish::of(&mesh) });
                meshes.push(mesh);
            }
            for mesh in link.collision.drain(..) {
                shadow.push((index, meshes.len()));
                meshes.push(mesh);
            }
        }
        let tool = robot.find_link("tool0");
        let mut stage = Stage { robot, collision, meshes, visual, shadow, reach: 0.0, tool };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..200 {
            let angles = stage.any_angles(&mut rng);
            let origins = stage.robot.joint_origins(&stage.robot.link_poses(&angles));
            let centre = origins.get(1).or(origins.first()).copied().unwrap_or_default();
            let farthest = origins.iter().map(|o| o.distance(centre)).fold(0.1, f64::max);
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
        self.robot.joints.iter().map(|j| rng.random_range(j.range[0]..=j.range[1])).collect()
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
                    if b > 0.0 { a - PI / 2.0 - lift_and_elbow } else { b }
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

    /// The scene of sample `id` of a recording with a free camera: the same for the same `seed` and `id`.
    /// `photos`: how many background photos there are.
    ///
    /// # Errors
    /// No pose and camera that keep the rules were found.
    pub fn free_scene(&self, seed: u64, id: u64, photos: usize) -> Result<Scene, RecordingError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(id);
        let mut look = ChaCha8Rng::from_rng(&mut rng);
        let support = Support::any(&mut look);
        if rng.random_bool(0.15) {
            return Ok(self.empty_scene(support, &mut look, &mut rng, photos));
        }
        for _ in 0..100 {
            let Some((angles, poses)) = self.free_angles(&mut rng) else { continue };
            for _ in 0..8 {
                let camera = self.aim(&poses, &support, &mut rng);
                if let Some(camera_from_base) = camera {
                    let robot = (angles, poses);
                    return Ok(self.scene(camera_from_base, support, Some(robot), &mut look, &mut rng, photos));
                }
            }
        }
        Err(RecordingError::NoScene { id })
    }

    /// The scene of sample `id` of a recording with a fixed camera.
    ///
    /// # Errors
    /// No pose without collision that stays in the picture was found.
    pub fn fixed_scene(&self, station: &Station, id: u64, photos: usize) -> Result<Scene, RecordingError> {
        let mut rng = ChaCha8Rng::seed_from_u64(station.seed);
        rng.set_stream(id);
        let mut look = station_rng(station.seed);
        let support = Support::any(&mut look);
        for _ in 0..200 {
            let Some(robot) = self.free_angles(&mut rng) else { continue };
            let camera = station.camera_from_base;
            if self.in_view(camera, &robot.1, 4) {
                return Ok(self.scene(camera, support, Some(robot), &mut look, &mut rng, photos));
            }
        }
        Err(RecordingError::NoScene { id })
    }

    /// Chooses the camera of a recording with a fixed camera: one that shows the robot on 6 to 17 % of
    /// the picture in as many poses as possible (the paper, section 3).
    ///
    /// # Errors
    /// The robot has no pose without collision.
    pub fn station(&self, seed: u64) -> Result<Station, RecordingError> {
        const POSES: usize = 40;
        let mut rng = station_rng(seed);
        let support = Support::any(&mut rng.clone());
        let poses: Vec<Vec<DAffine3>> =
            (0..POSES).filter_map(|_| Some(self.free_angles(&mut rng)?.1)).collect();
        if poses.is_empty() {
            return Err(RecordingError::NoScene { id: 0 });
        }
        let mut best = (-1.0, DAffine3::IDENTITY);
        for _ in 0..60 {
            let direction = direction(&mut rng, support.lowest_camera().max(5f64.to_radians()), PI / 4.0);
            let distance = self.reach * rng.random_range(0.9..2.0);
            let aim = DVec3::new(0.0, 0.0, self.reach * rng.random_range(0.2..0.6));
            let pixel = [INTRINSICS.cx, INTRINSICS.cy + rng.random_range(-20.0..20.0)];
            let camera = look_at(aim, direction, distance, 0.0, pixel);
            let mut score = 0.0;
            for pose in &poses {
                let coverage = self.coverage(camera, pose);
                score += f64::from((0.06..0.17).contains(&coverage));
                score += f64::from(self.in_view(camera, pose, self.robot.joints.len()));
            }
            if score > best.0 {
                best = (score, camera);
            }
        }
        Ok(Station { camera_from_base: best.1, seed })
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
            let (Some(&pose), Some(mesh)) = (poses.get(link), self.meshes.get(mesh)) else { continue };
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

    fn empty_scene(
        &self,
        support: Support,
        look: &mut ChaCha8Rng,
        rng: &mut ChaCha8Rng,
        photos: usize,
    ) -> Scene {
        let aim = DVec3::new(0.0, 0.0, rng.random_range(0.0..0.5));
        let direction = direction(rng, support.lowest_camera(), PI / 3.0);
        let roll = rng.random_range(-10f64..10.0).to_radians();
        let pixel = [
            INTRINSICS.cx + rng.random_range(-120.0..120.0),
            INTRINSICS.cy + rng.random_range(-100.0..100.0),
        ];
        let distance = self.reach * rng.random_range(0.7..2.2);
        let camera = look_at(aim, direction, distance, roll, pixel);
        self.scene(camera, support, None, look, rng, photos)
    }

    /// Dresses a scene. `look` draws what a recording with a fixed camera keeps: support, colours, tool.
    fn scene(
        &self,
        camera_from_base: DAffine3,
        support: Support,
        robot: Option<(Vec<f64>, Vec<DAffine3>)>,
        look: &mut ChaCha8Rng,
        rng: &mut ChaCha8Rng,
        photos: usize,
    ) -> Scene {
        let mut build = Builder {
            items: Vec::new(),
            camera: camera_from_base.inverse().translation,
            arm: Vec::new(),
        };
        let mut centre = DVec3::new(0.0, 0.0, 0.3);
        let bare = robot.is_none() && look.random_bool(0.4);
        let floor = if bare { None } else { support.build(&mut build, look) };
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
        if let Some((angles, poses)) = &robot {
            let _ = angles;
            if rng.random_bool(0.25) {
                build.occluders(&self.robot.joint_origins(poses), rng);
            }
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
        Scene {
            camera_from_base,
            items: build.items,
            lighting: lighting(rng),
            centre,
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
        let housing = if rng.random_bool(0.8) { grey(rng, 0.4, 0.8) } else { grey(rng, 0.25, 0.45) };
        let rubber = grey(rng, 0.05, 0.3);
        let tube_metal = rng.random_range(0.15..0.9);
        let housing_metal = rng.random_range(0.0..0.65);
        let gloss = rng.random_range(0.0..1.0f32);
        for part in &self.visual {
            let Some(&pose) = poses.get(part.link) else { continue };
            let (albedo, metal, specular, shininess) = match part.finish {
                Finish::Cap => (cap, 0.0, 0.05 + 0.25 * gloss, 8.0 + 60.0 * gloss),
                Finish::Tube => (tube, tube_metal, 0.1 + 0.4 * gloss, 12.0 + 40.0 * gloss),
                Finish::Housing => (housing, housing_metal, 0.05 + 0.3 * gloss, 10.0 + 40.0 * gloss),
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
            build.items.push(Item { mesh: part.mesh, base_from_mesh: pose, material, kind: Kind::Robot });
        }
        for &(link, mesh) in &self.shadow {
            let Some(&pose) = poses.get(link) else { continue };
            build.items.push(Item { mesh, base_from_mesh: pose, material: MATT, kind: Kind::Shadow });
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
        (a[axis].max(b[axis]).max(c[axis]).floor().min(end as f32 - 1.0) + 1.0).max(0.0) as usize
    };
    let edge = |p: [f32; 2], q: [f32; 2], x: f32, y: f32| {
        (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
    };
    let columns_in = low(0)..high(0, columns);
    for y in low(1)..high(1, rows) {
        let row = covered.get_mut(y * columns..(y + 1) * columns).unwrap_or_default();
        for (x, slot) in row.iter_mut().enumerate().take(columns_in.end).skip(columns_in.start) {
            let (fx, fy) = (x as f32, y as f32);
            let (e0, e1, e2) = (edge(a, b, fx, fy), edge(b, c, fx, fy), edge(c, a, fx, fy));
            let inside = (e0 >= 0.0 && e1 >= 0.0 && e2 >= 0.0) || (e0 <= 0.0 && e1 <= 0.0 && e2 <= 0.0);
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

/// A direction with any yaw and an elevation between two angles, radians.
fn direction(rng: &mut ChaCha8Rng, lowest: f64, highest: f64) -> DVec3 {
    let yaw = rng.random_range(0.0..TAU);
    let elevation: f64 = rng.random_range(lowest..highest);
    DVec3::new(yaw.cos() * elevation.cos(), yaw.sin() * elevation.cos(), elevation.sin())
}

/// A number with mean 0 and deviation 1, within 3 of 0.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    2.0 * ((0..3).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 1.5)
}

/// Linear RGB of a colour whose hue, saturation and value are meant for the screen.
fn hsv(hue: f64, saturation: f64, value: f64) -> [f32; 3] {
    [5.0, 3.0, 1.0].map(|n: f64| {
        let k = (n + 6.0 * hue) % 6.0;
        let encoded = value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0));
        encoded.powf(2.2) as f32
    })
}

/// A nearly neutral grey.
fn grey(rng: &mut ChaCha8Rng, darkest: f64, lightest: f64) -> [f32; 3] {
    let hue = rng.random_range(0.0..1.0);
    hsv(hue, rng.random_range(0.0..0.06), rng.random_range(darkest..lightest))
}

const MATT: Material = Material {
    albedo: [0.5; 3],
    metal: 0.0,
    specular: 0.0,
    shininess: 10.0,
    photo: 0.0,
    photo_scale: 1.0,
    photo_offset: [0.0; 2],
};

/// Any plausible colour of a thing, some of them like the robot's.
fn any_colour(rng: &mut ChaCha8Rng) -> [f32; 3] {
    match rng.random_range(0.0..1.0) {
        p if p < 0.3 => grey(rng, 0.1, 0.95),
        p if p < 0.4 => grey(rng, 0.02, 0.2),
        p if p < 0.5 => grey(rng, 0.5, 0.85),
        p if p < 0.6 => {
            let (hue, saturation) = (rng.random_range(0.52..0.62), rng.random_range(0.15..0.6));
            hsv(hue, saturation, rng.random_range(0.4..0.9))
        }
        p if p < 0.72 => {
            let (hue, saturation) = (rng.random_range(0.06..0.11), rng.random_range(0.2..0.6));
            hsv(hue, saturation, rng.random_range(0.4..0.9))
        }
        _ => {
            let (hue, saturation) = (rng.random_range(0.0..1.0), rng.random_range(0.3..1.0));
            hsv(hue, saturation, rng.random_range(0.2..1.0))
        }
    }
}

fn any_material(rng: &mut ChaCha8Rng) -> Material {
    let albedo = any_colour(rng);
    let metal = if rng.random_bool(0.25) { rng.random_range(0.2..0.9) } else { 0.0 };
    let photo = if rng.random_bool(0.3) { rng.random_range(0.3..1.0) } else { 0.0 };
    Material {
        albedo,
        metal,
        specular: if rng.random_bool(0.5) { rng.random_range(0.0..0.4) } else { 0.0 },
        shininess: rng.random_range(5.0..60.0),
        photo,
        photo_scale: rng.random_range(0.3..3.0),
        photo_offset: [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)],
    }
}

/// The material of furniture, floors and walls: mostly neutral or wooden.
fn furniture(rng: &mut ChaCha8Rng) -> Material {
    let mut material = any_material(rng);
    material.albedo = match rng.random_range(0.0..1.0) {
        p if p < 0.4 => grey(rng, 0.35, 0.97),
        p if p < 0.5 => grey(rng, 0.05, 0.35),
        p if p < 0.7 => {
            let (hue, saturation) = (rng.random_range(0.06..0.12), rng.random_range(0.15..0.55));
            hsv(hue, saturation, rng.random_range(0.4..0.95))
        }
        _ => material.albedo,
    };
    material
}

fn aluminium(rng: &mut ChaCha8Rng) -> Material {
    let metal = rng.random_range(0.2..0.8);
    Material { albedo: grey(rng, 0.55, 0.9), metal, specular: 0.2, shininess: 20.0, ..MATT }
}

/// What the robot stands on; its top is z = 0 of the base frame. Lengths in metres.
#[derive(Debug, Clone, Copy)]
enum Support {
    Nothing,
    Block { width: f64, depth: f64, height: f64, round: bool },
    Frame { width: f64, height: f64 },
    Table { size: DVec3, middle: DVec3 },
}

impl Support {
    fn any(rng: &mut ChaCha8Rng) -> Support {
        match rng.random_range(0.0..1.0) {
            p if p < 0.14 => Support::Nothing,
            p if p < 0.46 => {
                let width = rng.random_range(0.15..0.4);
                let round = rng.random_bool(0.4);
                let depth = if round { width } else { width * rng.random_range(0.8..1.3) };
                Support::Block { width, depth, height: rng.random_range(0.05..0.9), round }
            }
            p if p < 0.6 => {
                Support::Frame { width: rng.random_range(0.2..0.5), height: rng.random_range(0.3..0.9) }
            }
            _ => {
                let size = DVec3::new(
                    rng.random_range(0.6..1.9),
                    rng.random_range(0.6..1.4),
                    rng.random_range(0.65..0.95),
                );
                let x = (0.5 * size.x - 0.12) * rng.random_range(-1.0..1.0);
                let y = (0.5 * size.y - 0.12) * rng.random_range(-1.0..1.0);
                Support::Table { size, middle: DVec3::new(x, y, 0.0) }
            }
        }
    }

    fn is_table(&self) -> bool {
        matches!(self, Support::Table { .. })
    }

    /// The lowest elevation that a camera may have, radians.
    fn lowest_camera(&self) -> f64 {
        if self.is_table() { 0.0 } else { -15f64.to_radians() }
    }

    /// Adds the support; returns the floor's height, where there is a floor.
    fn build(&self, build: &mut Builder, rng: &mut ChaCha8Rng) -> Option<f64> {
        let material = if rng.random_bool(0.35) { aluminium(rng) } else { furniture(rng) };
        let other = if rng.random_bool(0.5) { aluminium(rng) } else { furniture(rng) };
        let place = |x: f64, y: f64, z: f64| DAffine3::from_translation(DVec3::new(x, y, z));
        let height = match *self {
            Support::Nothing => 0.002,
            Support::Block { width, depth, height, round } => {
                let size = DVec3::new(width, depth, height);
                let mesh = if round { CYLINDER } else { CUBOID };
                build.add(mesh, place(0.0, 0.0, -0.5 * height), size, material, Kind::Scenery);
                if rng.random_bool(0.5) {
                    let plate = DVec3::new(width * 1.25, depth * 1.25, 0.02);
                    build.add(mesh, place(0.0, 0.0, -0.0101), plate, other, Kind::Scenery);
                }
                height
            }
            Support::Frame { width, height } => {
                let post = rng.random_range(0.03..0.07);
                let half = 0.5 * (width - post);
                for (x, y) in [(half, half), (half, -half), (-half, half), (-half, -half)] {
                    let size = DVec3::new(post, post, height);
                    build.add(CUBOID, place(x, y, -0.5 * height), size, material, Kind::Scenery);
                }
                for level in [0.08, 0.5, 0.92] {
                    for (x, y) in [(half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half)] {
                        let along = |c: f64| if c == 0.0 { width } else { post };
                        let size = DVec3::new(along(x), along(y), post);
                        build.add(CUBOID, place(x, y, -level * height), size, material, Kind::Scenery);
                    }
                }
                let plate = DVec3::new(width * 1.1, width * 1.1, 0.02);
                build.add(CUBOID, place(0.0, 0.0, -0.0101), plate, other, Kind::Scenery);
                height
            }
            Support::Table { size, middle } => {
                let thick = rng.random_range(0.02..0.08);
                let top = DVec3::new(size.x, size.y, thick);
                let at = DAffine3::from_translation(middle - DVec3::Z * (0.5 * thick + 0.001));
                let solid = rng.random_bool(0.25);
                build.add(CUBOID, at, top, material, Kind::Scenery);
                for (x, y) in [(0.45, 0.45), (0.45, -0.45), (-0.45, 0.45), (-0.45, -0.45)] {
                    let leg = DVec3::new(0.06, 0.06, size.z);
                    let at = middle + DVec3::new(x * size.x, y * size.y, -0.5 * size.z - 0.01);
                    build.add(CUBOID, DAffine3::from_translation(at), leg, other, Kind::Scenery);
                }
                if solid {
                    let body = DVec3::new(0.95 * size.x, 0.95 * size.y, size.z - thick);
                    let at = DAffine3::from_translation(middle - DVec3::Z * (0.5 * size.z + 0.01));
                    build.add(CUBOID, at, body, other, Kind::Scenery);
                }
                size.z
            }
        };
        rng.random_bool(0.5).then_some(-height)
    }
}

struct Builder {
    items: Vec<Item>,
    /// The camera's place, base frame.
    camera: DVec3,
    /// The arm as a line, base frame: things keep clear of it.
    arm: Vec<DVec3>,
}

impl Builder {
    fn add(&mut self, mesh: usize, pose: DAffine3, size: DVec3, material: Material, kind: Kind) {
        let base_from_mesh = pose * DAffine3::from_scale(size);
        self.items.push(Item { mesh, base_from_mesh, material, kind });
    }

    /// A cylinder between two points.
    fn rod(&mut self, from: DVec3, to: DVec3, radius: f64, material: Material, kind: Kind) {
        let along = to - from;
        let turn = DQuat::from_rotation_arc(DVec3::Z, along.normalize_or(DVec3::Z));
        let pose = DAffine3::from_rotation_translation(turn, 0.5 * (from + to));
        let size = DVec3::new(2.0 * radius, 2.0 * radius, along.length());
        self.add(CYLINDER, pose, size, material, kind);
    }

    /// Whether a ball is clear of the arm and the camera.
    fn clear(&self, centre: DVec3, radius: f64) -> bool {
        let far = self.arm.windows(2).all(|ends| {
            let along = ends[1] - ends[0];
            let t = ((centre - ends[0]).dot(along) / along.length_squared().max(1e-9)).clamp(0.0, 1.0);
            centre.distance(ends[0] + t * along) > radius + 0.09
        });
        far && centre.distance(self.camera) > radius + 0.25
    }

    /// A tool on the flange: an adapter, a body and fingers, or some of them.
    fn gripper(&mut self, tool: DAffine3, on_table: bool, rng: &mut ChaCha8Rng) {
        let style = rng.random_range(0.0..1.0);
        let dark = rng.random_bool(0.6);
        let mut material = || {
            let albedo = if dark { grey(rng, 0.03, 0.25) } else { any_colour(rng) };
            let metal = if rng.random_bool(0.3) { 0.5 } else { 0.0 };
            Material { albedo, metal, specular: 0.15, shininess: 25.0, ..MATT }
        };
        let (first, second, third) = (material(), material(), material());
        if style < 0.25 {
            return;
        }
        let adapter = rng.random_range(0.01..0.06);
        let radius = rng.random_range(0.025..0.042);
        let body = rng.random_range(0.04..0.15);
        let wide = rng.random_range(0.05..0.14);
        let deep = rng.random_range(0.04..0.09);
        let finger = rng.random_range(0.03..0.12);
        let gap = rng.random_range(0.01..0.9) * wide;
        let round = rng.random_bool(0.4);
        let tip = tool.transform_point3(DVec3::Z * (adapter + body + finger));
        if on_table && tip.z < 0.0 {
            return;
        }
        let at = |x: f64, y: f64, z: f64| tool * DAffine3::from_translation(DVec3::new(x, y, z));
        let size = DVec3::new(2.0 * radius, 2.0 * radius, adapter);
        self.add(CYLINDER, at(0.0, 0.0, 0.5 * adapter), size, first, Kind::Scenery);
        if style > 0.85 {
            // A suction cup or a probe.
            let thin = DVec3::new(0.02, 0.02, body + finger);
            self.add(CYLINDER, at(0.0, 0.0, adapter + 0.5 * (body + finger)), thin, second, Kind::Scenery);
            return;
        }
        let mesh = if round { CYLINDER } else { CUBOID };
        let size = DVec3::new(wide, deep, body);
        self.add(mesh, at(0.0, 0.0, adapter + 0.5 * body), size, second, Kind::Scenery);
        for side in [-0.5, 0.5] {
            let size = DVec3::new(0.015, 0.025, finger);
            let pose = at(side * gap, 0.0, adapter + body + 0.5 * finger);
            self.add(CUBOID, pose, size, third, Kind::Scenery);
        }
        if style > 0.7 {
            // A camera or a sensor beside the tool.
            let pose = at(0.0, radius + 0.04, rng.random_range(-0.03..0.05));
            self.add(CUBOID, pose, DVec3::new(0.09, 0.025, 0.025), first, Kind::Scenery);
        }
    }

    /// Cables along the arm, with slack.
    fn cables(&mut self, rng: &mut ChaCha8Rng) {
        let arm = self.arm.clone();
        let Some(last) = arm.len().checked_sub(2) else { return };
        for _ in 0..rng.random_range(1..=2) {
            let albedo = match rng.random_range(0..6) {
                0 => any_colour(rng),
                1 => grey(rng, 0.4, 0.9),
                _ => grey(rng, 0.02, 0.15),
            };
            let material = Material { albedo, specular: 0.1, ..MATT };
            let radius = rng.random_range(0.0025..0.007);
            let start = rng.random_range(0..=1usize.min(last));
            let mut knots: Vec<DVec3> = Vec::new();
            for ends in arm.windows(2).skip(start) {
                for t in [0.0, 0.5] {
                    let offset = DVec3::new(normal(rng), normal(rng), normal(rng)).normalize_or(DVec3::X);
                    knots.push(ends[0].lerp(ends[1], t) + offset * rng.random_range(0.05..0.11));
                }
            }
            for four in knots.windows(4) {
                const STEPS: usize = 6;
                let point = |t: f64| {
                    let (a, b, c, d) = (four[0], four[1], four[2], four[3]);
                    0.5 * (2.0 * b
                        + (c - a) * t
                        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
                        + (3.0 * b - a - 3.0 * c + d) * t * t * t)
                };
                for i in 0..STEPS {
                    let (t, next) = (i as f64 / STEPS as f64, (i + 1) as f64 / STEPS as f64);
                    self.rod(point(t), point(next), radius, material, Kind::Cable);
                }
            }
        }
    }

    /// Floor, walls and furniture.
    fn room(&mut self, floor: Option<f64>, rng: &mut ChaCha8Rng) {
        let mut away = -self.camera;
        away.z = 0.0;
        let away = away.normalize_or(DVec3::X);
        let mut plain = || {
            let mut material = furniture(rng);
            material.metal = 0.0;
            material.specular = 0.0;
            material
        };
        let (of_floor, of_wall, of_side) = (plain(), plain(), plain());
        if let Some(height) = floor {
            let pose = DAffine3::from_translation(DVec3::new(0.0, 0.0, height - 0.051));
            self.add(CUBOID, pose, DVec3::new(14.0, 14.0, 0.1), of_floor, Kind::Surface);
        }
        if rng.random_bool(0.4) {
            let distance = rng.random_range(0.7..3.5);
            let turn = DQuat::from_rotation_z(away.y.atan2(away.x) + 0.5 * normal(rng));
            let wall = |offset: DVec3| DAffine3::from_rotation_translation(turn, turn * offset);
            let bottom = floor.unwrap_or(if rng.random_bool(0.5) { -1.0 } else { -0.2 });
            let tall = rng.random_range(1.5..4.0);
            let at = DVec3::new(distance + 0.05, 0.0, bottom + 0.5 * tall);
            self.add(CUBOID, wall(at), DVec3::new(0.1, 12.0, tall), of_wall, Kind::Surface);
            if rng.random_bool(0.4) {
                let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let at = DVec3::new(0.0, side * rng.random_range(0.9..2.5), bottom + 0.5 * tall);
                self.add(CUBOID, wall(at), DVec3::new(2.0 * distance, 0.1, tall), of_side, Kind::Surface);
            }
        }
        for _ in 0..rng.random_range(0..=4) {
            let size = DVec3::new(
                rng.random_range(0.1..1.0),
                rng.random_range(0.1..1.0),
                rng.random_range(0.2..1.8),
            );
            let yaw = away.y.atan2(away.x) + 0.6 * normal(rng);
            let distance = rng.random_range(0.7..3.0);
            let bottom = floor.unwrap_or_else(|| rng.random_range(-1.0..0.2));
            let centre = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), bottom + 0.5 * size.z);
            let turn = DQuat::from_rotation_z(rng.random_range(0.0..TAU));
            let material = furniture(rng);
            if self.clear(centre, 0.55 * size.length()) {
                let pose = DAffine3::from_rotation_translation(turn, centre);
                self.add(CUBOID, pose, size, material, Kind::Scenery);
            }
        }
    }

    /// Small things around the robot, and now and then something like an arm.
    fn clutter(&mut self, support: &Support, floor: Option<f64>, no_robot: bool, rng: &mut ChaCha8Rng) {
        for _ in 0..rng.random_range(0..=12) {
            let mesh = *[CUBOID, CUBOID, CYLINDER, CYLINDER, SPHERE].choose(rng).unwrap_or(&CUBOID);
            let largest = rng.random_range(0.03..0.3);
            let mut size = DVec3::new(
                largest * rng.random_range(0.15..1.0),
                largest * rng.random_range(0.15..1.0),
                largest,
            );
            if mesh != CUBOID {
                size.y = size.x;
            }
            if mesh == SPHERE {
                size = DVec3::splat(size.x);
            }
            let mut turn = DQuat::from_rotation_z(rng.random_range(0.0..TAU));
            let distance = rng.random_range(0.2..1.6);
            let yaw = rng.random_range(0.0..TAU);
            let mut centre = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), 0.5 * size.z);
            match *support {
                Support::Table { size: table, middle } if rng.random_bool(0.8) => {
                    centre.x = middle.x + 0.47 * table.x * rng.random_range(-1.0..1.0);
                    centre.y = middle.y + 0.47 * table.y * rng.random_range(-1.0..1.0);
                }
                _ => match floor {
                    Some(height) if rng.random_bool(0.7) => centre.z += height,
                    _ => {
                        centre.z = rng.random_range(-0.6..1.0);
                        let tilt = rng.random_range(0.0..PI);
                        turn *= DQuat::from_rotation_x(tilt);
                    }
                },
            }
            let material = any_material(rng);
            if self.clear(centre, 0.5 * size.length()) {
                let pose = DAffine3::from_rotation_translation(turn, centre);
                self.add(mesh, pose, size, material, Kind::Scenery);
            }
        }
        let chains = if no_robot { rng.random_range(0..=2) } else { usize::from(rng.random_bool(0.15)) };
        for _ in 0..chains {
            self.chain(no_robot, rng);
        }
    }

    /// Rods end to end, in colours that include the robot's.
    fn chain(&mut self, near: bool, rng: &mut ChaCha8Rng) {
        let distance = if near { rng.random_range(0.0..0.6) } else { rng.random_range(0.7..1.8) };
        let yaw = rng.random_range(0.0..TAU);
        let mut at = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), 0.0);
        let mut way = DVec3::Z;
        let (one, two) = (any_material(rng), any_material(rng));
        let ball = rng.random_bool(0.5);
        for _ in 0..rng.random_range(2..=5) {
            let radius = rng.random_range(0.015..0.09);
            let next = at + way * rng.random_range(0.08..0.5);
            if !self.clear(0.5 * (at + next), 0.5 * at.distance(next)) {
                return;
            }
            let turn = DQuat::from_rotation_arc(DVec3::Z, way);
            let pose = DAffine3::from_rotation_translation(turn, 0.5 * (at + next));
            let size = DVec3::new(2.0 * radius, 2.0 * radius, at.distance(next));
            let mesh = if rng.random_bool(0.4) { CUBOID } else { CYLINDER };
            self.add(mesh, pose, size, one, Kind::Scenery);
            let knot = DVec3::splat(2.4 * radius);
            let mesh = if ball { SPHERE } else { CUBOID };
            self.add(mesh, DAffine3::from_rotation_translation(turn, next), knot, two, Kind::Scenery);
            at = next;
            let bend = DVec3::new(normal(rng), normal(rng), normal(rng)).normalize_or(DVec3::X);
            way = (way + 1.2 * bend).normalize_or(DVec3::Z);
        }
    }

    /// Things between the camera and the arm.
    fn occluders(&mut self, joints: &[DVec3], rng: &mut ChaCha8Rng) {
        for _ in 0..rng.random_range(1..=2) {
            let Some(&joint) = joints.choose(rng) else { return };
            let t = rng.random_range(0.3..0.8);
            let distance = self.camera.distance(joint) * t;
            let offset = DVec3::new(normal(rng), normal(rng), normal(rng)) * 0.1 * distance;
            let centre = self.camera.lerp(joint, t) + offset;
            let largest = distance * rng.random_range(0.05..0.3);
            let size = DVec3::new(
                largest * rng.random_range(0.1..0.5),
                largest * rng.random_range(0.1..0.5),
                largest,
            );
            let turn = DQuat::from_rotation_z(rng.random_range(0.0..TAU))
                * DQuat::from_rotation_x(rng.random_range(0.0..PI));
            let mesh = *[CUBOID, CYLINDER, SPHERE].choose(rng).unwrap_or(&CUBOID);
            let material = any_material(rng);
            if self.clear(centre, 0.5 * size.length()) {
                let pose = DAffine3::from_rotation_translation(turn, centre);
                self.add(mesh, pose, size, material, Kind::Scenery);
            }
        }
    }
}

fn lighting(rng: &mut ChaCha8Rng) -> Lighting {
    let warm = |rng: &mut ChaCha8Rng, strength: f64| {
        let warmth = 0.12 * normal(rng);
        [strength * (1.0 + warmth), strength, strength * (1.0 - warmth)].map(|c| c.max(0.0) as f32)
    };
    let sky = rng.random_range(0.25..0.9);
    let ground = sky * rng.random_range(0.25..0.9);
    let mut strengths = [rng.random_range(0.2..1.1), 0.0, 0.0];
    if rng.random_bool(0.6) {
        strengths[1] = rng.random_range(0.1..0.6);
    }
    if rng.random_bool(0.3) {
        strengths[2] = rng.random_range(0.1..0.5);
    }
    // A light grey surface ends up between dim and nearly white.
    let total = sky + 0.6 * strengths.iter().sum::<f64>();
    let exposure = rng.random_range(0.75..1.35) / total;
    let lamps = strengths.map(|strength| Lamp {
        direction: direction(rng, 0.25, 1.4),
        colour: warm(rng, strength * exposure),
    });
    let mirrored = [(); 3].map(|()| {
        let wave = DVec3::new(normal(rng), normal(rng), normal(rng)) * rng.random_range(1.0..3.5);
        (wave, rng.random_range(0.0..std::f32::consts::TAU))
    });
    Lighting {
        lamps,
        shadow: rng.random_range(0.0..0.95),
        sky: warm(rng, sky * exposure),
        ground: warm(rng, ground * exposure),
        mirrored,
    }
}
