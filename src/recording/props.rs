//! What is around the robot: support, tool, cables, room, clutter, light.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DQuat, DVec3};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

use super::chance::{any_colour, direction, grey, hsv, normal};
use super::mesh::Mesh;
use super::scene::{Item, Kind, Lamp, Lighting, Material};

/// The meshes that props are made of: they come first among a stage's meshes.
pub(super) const PRIMITIVES: [fn() -> Mesh; 3] = [Mesh::cuboid, Mesh::cylinder, Mesh::sphere];
const CUBOID: usize = 0;
const CYLINDER: usize = 1;
const SPHERE: usize = 2;

pub(super) const MATT: Material = Material {
    albedo: [0.5; 3],
    metal: 0.0,
    specular: 0.0,
    shininess: 10.0,
    photo: 0.0,
    photo_scale: 1.0,
    photo_offset: [0.0; 2],
};

fn any_material(rng: &mut ChaCha8Rng) -> Material {
    let albedo = any_colour(rng);
    let metal = if rng.random_bool(0.25) {
        rng.random_range(0.2..0.9)
    } else {
        0.0
    };
    let photo = if rng.random_bool(0.3) {
        rng.random_range(0.3..1.0)
    } else {
        0.0
    };
    Material {
        albedo,
        metal,
        specular: if rng.random_bool(0.5) {
            rng.random_range(0.0..0.4)
        } else {
            0.0
        },
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
    Material {
        albedo: grey(rng, 0.55, 0.9),
        metal,
        specular: 0.2,
        shininess: 20.0,
        ..MATT
    }
}

/// What the robot stands on; its top is z = 0 of the base frame. Lengths in metres.
#[derive(Debug, Clone, Copy)]
pub(super) enum Support {
    Nothing,
    Block {
        width: f64,
        depth: f64,
        height: f64,
        round: bool,
    },
    Frame {
        width: f64,
        height: f64,
    },
    Table {
        size: DVec3,
        middle: DVec3,
    },
}

impl Support {
    pub(super) fn any(rng: &mut ChaCha8Rng) -> Support {
        match rng.random_range(0.0..1.0) {
            p if p < 0.14 => Support::Nothing,
            p if p < 0.46 => {
                let width = rng.random_range(0.15..0.4);
                let round = rng.random_bool(0.4);
                let depth = if round {
                    width
                } else {
                    width * rng.random_range(0.8..1.3)
                };
                Support::Block {
                    width,
                    depth,
                    height: rng.random_range(0.05..0.9),
                    round,
                }
            }
            p if p < 0.6 => Support::Frame {
                width: rng.random_range(0.2..0.5),
                height: rng.random_range(0.3..0.9),
            },
            _ => {
                let size = DVec3::new(
                    rng.random_range(0.6..1.9),
                    rng.random_range(0.6..1.4),
                    rng.random_range(0.65..0.95),
                );
                let x = (0.5 * size.x - 0.12) * rng.random_range(-1.0..1.0);
                let y = (0.5 * size.y - 0.12) * rng.random_range(-1.0..1.0);
                Support::Table {
                    size,
                    middle: DVec3::new(x, y, 0.0),
                }
            }
        }
    }

    pub(super) fn is_table(&self) -> bool {
        matches!(self, Support::Table { .. })
    }

    /// The lowest elevation that a camera may have, radians.
    pub(super) fn lowest_camera(&self) -> f64 {
        if self.is_table() {
            0.0
        } else {
            -15f64.to_radians()
        }
    }

    /// Adds the support; returns the floor's height, where there is a floor.
    pub(super) fn build(&self, build: &mut Builder, rng: &mut ChaCha8Rng) -> Option<f64> {
        let material = if rng.random_bool(0.35) {
            aluminium(rng)
        } else {
            furniture(rng)
        };
        let other = if rng.random_bool(0.5) {
            aluminium(rng)
        } else {
            furniture(rng)
        };
        let place = |x: f64, y: f64, z: f64| DAffine3::from_translation(DVec3::new(x, y, z));
        let height = match *self {
            Support::Nothing => 0.002,
            Support::Block {
                width,
                depth,
                height,
                round,
            } => {
                let size = DVec3::new(width, depth, height);
                let mesh = if round { CYLINDER } else { CUBOID };
                build.add(
                    mesh,
                    place(0.0, 0.0, -0.5 * height),
                    size,
                    material,
                    Kind::Scenery,
                );
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
                    build.add(
                        CUBOID,
                        place(x, y, -0.5 * height),
                        size,
                        material,
                        Kind::Scenery,
                    );
                }
                for level in [0.08, 0.5, 0.92] {
                    for (x, y) in [(half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half)] {
                        let along = |c: f64| if c == 0.0 { width } else { post };
                        let size = DVec3::new(along(x), along(y), post);
                        build.add(
                            CUBOID,
                            place(x, y, -level * height),
                            size,
                            material,
                            Kind::Scenery,
                        );
                    }
                }
                let plate = DVec3::new(width * 1.1, width * 1.1, 0.02);
                build.add(
                    CUBOID,
                    place(0.0, 0.0, -0.0101),
                    plate,
                    other,
                    Kind::Scenery,
                );
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
                    build.add(
                        CUBOID,
                        DAffine3::from_translation(at),
                        leg,
                        other,
                        Kind::Scenery,
                    );
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

pub(super) struct Builder {
    pub(super) items: Vec<Item>,
    /// The camera's place, base frame.
    pub(super) camera: DVec3,
    /// The arm as a line, base frame: things keep clear of it.
    pub(super) arm: Vec<DVec3>,
}

impl Builder {
    fn add(&mut self, mesh: usize, pose: DAffine3, size: DVec3, material: Material, kind: Kind) {
        let base_from_mesh = pose * DAffine3::from_scale(size);
        self.items.push(Item {
            mesh,
            base_from_mesh,
            material,
            kind,
        });
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
            let t =
                ((centre - ends[0]).dot(along) / along.length_squared().max(1e-9)).clamp(0.0, 1.0);
            centre.distance(ends[0] + t * along) > radius + 0.09
        });
        far && centre.distance(self.camera) > radius + 0.25
    }

    /// A tool on the flange: an adapter, a body and fingers, or some of them.
    pub(super) fn gripper(&mut self, tool: DAffine3, on_table: bool, rng: &mut ChaCha8Rng) {
        let style = rng.random_range(0.0..1.0);
        let dark = rng.random_bool(0.6);
        let mut material = || {
            let albedo = if dark {
                grey(rng, 0.03, 0.25)
            } else {
                any_colour(rng)
            };
            let metal = if rng.random_bool(0.3) { 0.5 } else { 0.0 };
            Material {
                albedo,
                metal,
                specular: 0.15,
                shininess: 25.0,
                ..MATT
            }
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
        self.add(
            CYLINDER,
            at(0.0, 0.0, 0.5 * adapter),
            size,
            first,
            Kind::Scenery,
        );
        if style > 0.85 {
            // A suction cup or a probe.
            let thin = DVec3::new(0.02, 0.02, body + finger);
            self.add(
                CYLINDER,
                at(0.0, 0.0, adapter + 0.5 * (body + finger)),
                thin,
                second,
                Kind::Scenery,
            );
            return;
        }
        let mesh = if round { CYLINDER } else { CUBOID };
        let size = DVec3::new(wide, deep, body);
        self.add(
            mesh,
            at(0.0, 0.0, adapter + 0.5 * body),
            size,
            second,
            Kind::Scenery,
        );
        for side in [-0.5, 0.5] {
            let size = DVec3::new(0.015, 0.025, finger);
            let pose = at(side * gap, 0.0, adapter + body + 0.5 * finger);
            self.add(CUBOID, pose, size, third, Kind::Scenery);
        }
        if style > 0.7 {
            // A camera or a sensor beside the tool.
            let pose = at(0.0, radius + 0.04, rng.random_range(-0.03..0.05));
            self.add(
                CUBOID,
                pose,
                DVec3::new(0.09, 0.025, 0.025),
                first,
                Kind::Scenery,
            );
        }
    }

    /// Cables along the arm, with slack.
    pub(super) fn cables(&mut self, rng: &mut ChaCha8Rng) {
        let arm = self.arm.clone();
        let Some(last) = arm.len().checked_sub(2) else {
            return;
        };
        for _ in 0..rng.random_range(1..=2) {
            let albedo = match rng.random_range(0..6) {
                0 => any_colour(rng),
                1 => grey(rng, 0.4, 0.9),
                _ => grey(rng, 0.02, 0.15),
            };
            let material = Material {
                albedo,
                specular: 0.1,
                ..MATT
            };
            let radius = rng.random_range(0.0025..0.007);
            let start = rng.random_range(0..=1usize.min(last));
            let mut knots: Vec<DVec3> = Vec::new();
            for ends in arm.windows(2).skip(start) {
                for t in [0.0, 0.5] {
                    let offset =
                        DVec3::new(normal(rng), normal(rng), normal(rng)).normalize_or(DVec3::X);
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
    pub(super) fn room(&mut self, floor: Option<f64>, rng: &mut ChaCha8Rng) {
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
            self.add(
                CUBOID,
                pose,
                DVec3::new(14.0, 14.0, 0.1),
                of_floor,
                Kind::Surface,
            );
        }
        if rng.random_bool(0.4) {
            let distance = rng.random_range(0.7..3.5);
            let turn = DQuat::from_rotation_z(away.y.atan2(away.x) + 0.5 * normal(rng));
            let wall = |offset: DVec3| DAffine3::from_rotation_translation(turn, turn * offset);
            let bottom = floor.unwrap_or(if rng.random_bool(0.5) { -1.0 } else { -0.2 });
            let tall = rng.random_range(1.5..4.0);
            let at = DVec3::new(distance + 0.05, 0.0, bottom + 0.5 * tall);
            self.add(
                CUBOID,
                wall(at),
                DVec3::new(0.1, 12.0, tall),
                of_wall,
                Kind::Surface,
            );
            if rng.random_bool(0.4) {
                let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let at = DVec3::new(0.0, side * rng.random_range(0.9..2.5), bottom + 0.5 * tall);
                self.add(
                    CUBOID,
                    wall(at),
                    DVec3::new(2.0 * distance, 0.1, tall),
                    of_side,
                    Kind::Surface,
                );
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
            let centre = DVec3::new(
                distance * yaw.cos(),
                distance * yaw.sin(),
                bottom + 0.5 * size.z,
            );
            let turn = DQuat::from_rotation_z(rng.random_range(0.0..TAU));
            let material = furniture(rng);
            if self.clear(centre, 0.55 * size.length()) {
                let pose = DAffine3::from_rotation_translation(turn, centre);
                self.add(CUBOID, pose, size, material, Kind::Scenery);
            }
        }
    }

    /// Small things around the robot, and now and then something like an arm.
    pub(super) fn clutter(
        &mut self,
        support: &Support,
        floor: Option<f64>,
        no_robot: bool,
        rng: &mut ChaCha8Rng,
    ) {
        for _ in 0..rng.random_range(0..=12) {
            let mesh = *[CUBOID, CUBOID, CYLINDER, CYLINDER, SPHERE]
                .choose(rng)
                .unwrap_or(&CUBOID);
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
                Support::Table {
                    size: table,
                    middle,
                } if rng.random_bool(0.8) => {
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
        let chains = if no_robot {
            rng.random_range(0..=2)
        } else {
            usize::from(rng.random_bool(0.15))
        };
        for _ in 0..chains {
            self.chain(no_robot, rng);
        }
    }

    /// Rods end to end, in colours that include the robot's.
    fn chain(&mut self, near: bool, rng: &mut ChaCha8Rng) {
        let distance = if near {
            rng.random_range(0.0..0.6)
        } else {
            rng.random_range(0.7..1.8)
        };
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
            let mesh = if rng.random_bool(0.4) {
                CUBOID
            } else {
                CYLINDER
            };
            self.add(mesh, pose, size, one, Kind::Scenery);
            let knot = DVec3::splat(2.4 * radius);
            let mesh = if ball { SPHERE } else { CUBOID };
            self.add(
                mesh,
                DAffine3::from_rotation_translation(turn, next),
                knot,
                two,
                Kind::Scenery,
            );
            at = next;
            let bend = DVec3::new(normal(rng), normal(rng), normal(rng)).normalize_or(DVec3::X);
            way = (way + 1.2 * bend).normalize_or(DVec3::Z);
        }
    }

    /// Things between the camera and the arm.
    pub(super) fn occluders(&mut self, joints: &[DVec3], rng: &mut ChaCha8Rng) {
        for _ in 0..rng.random_range(1..=2) {
            let Some(&joint) = joints.choose(rng) else {
                return;
            };
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

pub(super) fn lighting(rng: &mut ChaCha8Rng) -> Lighting {
    let warm = |rng: &mut ChaCha8Rng, strength: f64| {
        let warmth = 0.12 * normal(rng);
        [
            strength * (1.0 + warmth),
            strength,
            strength * (1.0 - warmth),
        ]
        .map(|c| c.max(0.0) as f32)
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
