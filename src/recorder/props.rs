//! What is around the robot: support, tool, cables, room, clutter, light.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DQuat, DVec3};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

use super::chance::{any_colour, direction, grey, hsv, normal};
use super::scene::{Item, Kind, Lamp, Lighting, Material};
use crate::robot::Mesh;

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
    if rng.random_bool(0.3) {
        material.photo *= 0.4;
    }
    material.albedo = match rng.random_range(0.0..1.0) {
        p if p < 0.45 => grey(rng, 0.35, 0.97),
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
            p if p < 0.62 => Support::Frame {
                width: rng.random_range(0.25..0.9),
                height: rng.random_range(0.4..0.95),
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
                for level in [0.0, 0.5, 0.9] {
                    if level == 0.0 || rng.random_bool(0.5) {
                        let at = place(0.0, 0.0, -level * height - 0.0101);
                        build.add(CUBOID, at, plate, other, Kind::Scenery);
                    }
                }
                // The robot's controller and other cases inside.
                for _ in 0..rng.random_range(0..=3) {
                    let size = DVec3::new(
                        width * rng.random_range(0.2..0.6),
                        width * rng.random_range(0.2..0.6),
                        height * rng.random_range(0.1..0.4),
                    );
                    let level = if rng.random_bool(0.5) { -0.9 } else { -0.5 } * height;
                    let x = 0.25 * width * rng.random_range(-1.0..1.0);
                    let y = 0.25 * width * rng.random_range(-1.0..1.0);
                    let case = Material {
                        albedo: grey(rng, 0.05, 0.6),
                        ..MATT
                    };
                    let at = place(x, y, level + 0.5 * size.z);
                    build.add(CUBOID, at, size, case, Kind::Scenery);
                }
                height
            }
            Support::Table { size, middle } => {
                let thick = rng.random_range(0.02..0.08);
                let top = DVec3::new(size.x, size.y, thick);
                let at = DAffine3::from_translation(middle - DVec3::Z * (0.5 * thick + 0.001));
                let solid = rng.random_bool(0.25);
                build.add(CUBOID, at, top, material, Kind::Scenery);
                if rng.random_bool(0.4) {
                    // The plate or pedestal between robot and table.
                    let width = rng.random_range(0.16..0.35);
                    let tall = if rng.random_bool(0.5) { 0.012 } else { 0.001 };
                    let size = DVec3::new(width, width, tall);
                    let mesh = if rng.random_bool(0.5) {
                        CUBOID
                    } else {
                        CYLINDER
                    };
                    build.add(
                        mesh,
                        place(0.0, 0.0, 0.5 * tall),
                        size,
                        other,
                        Kind::Scenery,
                    );
                }
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
        rng.random_bool(0.7).then_some(-height)
    }
}

pub(super) struct Builder {
    pub(super) items: Vec<Item>,
    /// The camera's place, base frame.
    pub(super) camera: DVec3,
    /// The places of other cameras that see the same.
    others: Vec<DVec3>,
    /// The arms as lines, base frame: things keep clear of them.
    pub(super) arms: Vec<Vec<DVec3>>,
}

/// How far a point is from a line through points, metres.
pub(super) fn line_distance(line: &[DVec3], point: DVec3) -> f64 {
    line.windows(2)
        .map(|ends| {
            let along = ends[1] - ends[0];
            let t =
                ((point - ends[0]).dot(along) / along.length_squared().max(1e-9)).clamp(0.0, 1.0);
            point.distance(ends[0] + t * along)
        })
        .fold(f64::INFINITY, f64::min)
}

fn skin(rng: &mut ChaCha8Rng) -> Material {
    let albedo = hsv(
        rng.random_range(0.04..0.09),
        rng.random_range(0.25..0.6),
        rng.random_range(0.35..0.95),
    );
    Material { albedo, ..MATT }
}

fn clothing(rng: &mut ChaCha8Rng) -> Material {
    let albedo = match rng.random_range(0.0..1.0) {
        p if p < 0.5 => grey(rng, 0.05, 0.4),
        p if p < 0.65 => grey(rng, 0.6, 0.95),
        p if p < 0.85 => {
            let hue = rng.random_range(0.55..0.68);
            hsv(hue, rng.random_range(0.2..0.8), rng.random_range(0.15..0.7))
        }
        _ => any_colour(rng),
    };
    Material {
        albedo,
        photo: if rng.random_bool(0.2) { 0.5 } else { 0.0 },
        photo_scale: 3.0,
        ..MATT
    }
}

fn plain(albedo: [f32; 3]) -> Material {
    Material { albedo, ..MATT }
}

impl Builder {
    /// `cameras_from_base`: all that see the scene; what is put before or behind the arm is so for the first.
    pub(super) fn new(cameras_from_base: &[DAffine3]) -> Builder {
        let mut places = cameras_from_base.iter().map(|c| c.inverse().translation);
        Builder {
            items: Vec::new(),
            camera: places.next().unwrap_or_default(),
            others: places.collect(),
            arms: Vec::new(),
        }
    }

    fn cameras(&self) -> impl Iterator<Item = DVec3> {
        std::iter::once(self.camera).chain(self.others.iter().copied())
    }

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

    /// Whether a ball is clear of the arms and the cameras, and leaves most of the first arm in view.
    fn clear(&self, centre: DVec3, radius: f64) -> bool {
        let far = |line: &Vec<DVec3>| line_distance(line, centre) > radius + 0.09;
        let first = self.arms.first().map_or(&[][..], Vec::as_slice);
        self.arms.iter().all(far)
            && self.cameras().all(|camera| {
                let hides = |&&point: &&DVec3| line_distance(&[camera, point], centre) < radius;
                centre.distance(camera) > radius + 0.25
                    && 3 * first.iter().filter(hides).count() <= first.len()
            })
    }

    /// What a second arm stands on.
    pub(super) fn plinth(&mut self, base: DVec3, floor: Option<f64>, rng: &mut ChaCha8Rng) {
        let bottom = floor.unwrap_or(base.z - 0.6).min(base.z - 0.02);
        let width = rng.random_range(0.15..0.35);
        let size = DVec3::new(width, width, base.z - bottom);
        let at = DAffine3::from_translation(base - DVec3::Z * 0.5 * size.z);
        let mesh = if rng.random_bool(0.5) {
            CUBOID
        } else {
            CYLINDER
        };
        let material = furniture(rng);
        self.add(mesh, at, size, material, Kind::Scenery);
    }

    /// A tool on the flange: an adapter, a body and fingers, or some of them.
    pub(super) fn gripper(&mut self, tool: DAffine3, on_table: bool, rng: &mut ChaCha8Rng) {
        let style = rng.random_range(0.0..1.0);
        let dark = rng.random_bool(0.75);
        let mut material = || {
            let albedo = match rng.random_range(0.0..1.0) {
                p if dark && p < 0.85 => grey(rng, 0.03, 0.25),
                p if p < 0.9 => grey(rng, 0.1, 0.9),
                p if p < 0.96 => hsv(rng.random_range(0.0..0.1), 0.85, 0.85),
                _ => any_colour(rng),
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
        if style < 0.15 {
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
        let thick = rng.random_range(0.012..0.03);
        let fingers = if rng.random_bool(0.2) { 3 } else { 2 };
        for n in 0..fingers {
            let turn = DQuat::from_rotation_z(TAU * f64::from(n) / f64::from(fingers));
            let place = tool * DAffine3::from_quat(turn);
            let finger_at =
                |x: f64, z: f64| place.transform_point3(DVec3::new(x, 0.0, adapter + body + z));
            // A knuckle that leans outwards, then the finger itself.
            let half = 0.5 * gap;
            let knuckle = rng.random_range(0.2..0.6) * finger;
            let (low, high) = (finger_at(0.35 * wide, -0.01), finger_at(half, knuckle));
            self.rod(low, high, 0.5 * thick, second, Kind::Scenery);
            let size = DVec3::new(thick, 0.025, finger);
            let pose = place
                * DAffine3::from_translation(DVec3::new(half, 0.0, adapter + body + 0.5 * finger));
            self.add(CUBOID, pose, size, third, Kind::Scenery);
        }
        if rng.random_bool(0.35) {
            // A camera or a sensor beside the tool, on a bracket.
            let out = radius + rng.random_range(0.03..0.07);
            let z = rng.random_range(-0.03..0.05);
            let bracket = DVec3::new(0.03, out, 0.01);
            self.add(CUBOID, at(0.0, 0.5 * out, z), bracket, first, Kind::Scenery);
            let size = DVec3::new(rng.random_range(0.04..0.12), 0.028, 0.028);
            self.add(CUBOID, at(0.0, out, z), size, third, Kind::Scenery);
        }
    }

    /// A rope through knots.
    fn rope(&mut self, knots: &[DVec3], radius: f64, material: Material) {
        for four in knots.windows(4) {
            const STEPS: usize = 5;
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

    /// Cables and hoses along the latest arm, wound round it or in loops beside it, and the straps that
    /// hold them.
    pub(super) fn cables(&mut self, reach: f64, rng: &mut ChaCha8Rng) {
        let spine = self.arms.last().cloned().unwrap_or_default();
        let links: Vec<[DVec3; 2]> = spine
            .windows(2)
            .skip(1)
            .map(|ends| [ends[0], ends[1]])
            .filter(|ends| ends[0].distance(ends[1]) > 0.04)
            .collect();
        let near = 0.07 * reach;
        for _ in 0..rng.random_range(1..=3) {
            let albedo = match rng.random_range(0.0..1.0) {
                p if p < 0.1 => any_colour(rng),
                p if p < 0.25 => grey(rng, 0.4, 0.9),
                p if p < 0.4 => hsv(rng.random_range(0.56..0.66), 0.8, 0.6),
                _ => grey(rng, 0.02, 0.15),
            };
            let material = Material {
                albedo,
                specular: 0.1,
                ..MATT
            };
            let hose = rng.random_bool(0.15);
            let radius = if hose {
                rng.random_range(0.009..0.018)
            } else {
                rng.random_range(0.002..0.007)
            };
            // How far it turns between two straps, and how far it hangs out.
            let winding = rng.random_range(0.1..2.5);
            let slack = reach * rng.random_range(0.01..0.16);
            let mut angle = rng.random_range(0.0..TAU);
            let mut knots: Vec<DVec3> = Vec::new();
            for ends in links.iter().skip(rng.random_range(0..=1)) {
                let way = (ends[1] - ends[0]).normalize_or(DVec3::Z);
                let side = way.any_orthonormal_vector();
                let other = way.cross(side);
                let straps = (ends[0].distance(ends[1]) / (0.2 * reach)).ceil().min(4.0) as usize;
                for n in 0..straps {
                    let t = (n as f64 + 0.25) / straps as f64;
                    let around = |angle: f64, distance: f64, t: f64| {
                        let out = side * angle.cos() + other * angle.sin();
                        ends[0].lerp(ends[1], t) + out * distance
                    };
                    knots.push(around(angle, near, t));
                    let half = angle + 0.5 * winding;
                    let hanging = around(
                        half,
                        near + slack * rng.random_range(0.0..1.0),
                        t + 0.5 / straps as f64,
                    );
                    knots.push(hanging - DVec3::Z * 0.4 * slack);
                    angle += winding + 0.3 * normal(rng);
                    if rng.random_bool(0.25) {
                        let middle = ends[0].lerp(ends[1], t);
                        let half = way * rng.random_range(0.006..0.02);
                        let strap = if rng.random_bool(0.5) {
                            plain(albedo)
                        } else {
                            plain(any_colour(rng))
                        };
                        self.rod(middle - half, middle + half, 0.9 * near, strap, Kind::Cable);
                    }
                }
            }
            self.rope(&knots, radius, material);
        }
    }

    /// Floor, walls, furniture and what hangs on walls.
    pub(super) fn room(&mut self, floor: Option<f64>, rng: &mut ChaCha8Rng) {
        let mut away = -self.camera;
        away.z = 0.0;
        let away = away.normalize_or(DVec3::X);
        let heading = away.y.atan2(away.x);
        let paint = |rng: &mut ChaCha8Rng| {
            let mut material = furniture(rng);
            material.metal = 0.0;
            material.specular = 0.0;
            material.photo = match rng.random_range(0.0..1.0) {
                p if p < 0.3 => 0.0,
                p if p < 0.9 => rng.random_range(0.05..0.3),
                _ => material.photo,
            };
            material.photo_scale = rng.random_range(0.1..1.0);
            if rng.random_bool(0.5) {
                material.albedo = grey(rng, 0.45, 0.98);
            }
            material
        };
        let of_floor = paint(rng);
        if let Some(height) = floor {
            let pose = DAffine3::from_translation(DVec3::new(0.0, 0.0, height - 0.051));
            let size = DVec3::new(14.0, 14.0, 0.1);
            self.add(CUBOID, pose, size, of_floor, Kind::Surface);
            // Marks, mats and tape on the floor.
            for _ in 0..rng.random_range(0..=3) {
                let narrow = rng.random_bool(0.7);
                let size = DVec3::new(
                    rng.random_range(0.5..4.0),
                    if narrow {
                        0.06
                    } else {
                        rng.random_range(0.4..1.5)
                    },
                    0.002,
                );
                let (x, y) = (rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0));
                let pose = DAffine3::from_rotation_translation(
                    DQuat::from_rotation_z(rng.random_range(0.0..TAU)),
                    DVec3::new(x, y, height + 0.002),
                );
                let material = plain(any_colour(rng));
                self.add(CUBOID, pose, size, material, Kind::Surface);
            }
        }
        let bottom = floor.unwrap_or(if rng.random_bool(0.5) { -1.0 } else { -0.2 });
        if rng.random_bool(0.6) {
            let screen = rng.random_bool(0.05).then(|| {
                let hue = rng.random_range(0.24..0.36);
                plain(hsv(
                    hue,
                    rng.random_range(0.6..0.95),
                    rng.random_range(0.4..0.95),
                ))
            });
            let of_wall = screen.unwrap_or_else(|| paint(rng));
            let turn = DQuat::from_rotation_z(heading + 0.5 * normal(rng));
            // Walls are behind and beside everything.
            let inside: Vec<DVec3> = self
                .arms
                .iter()
                .flatten()
                .chain(&self.others)
                .map(|&p| turn.inverse() * p)
                .collect();
            let camera = turn.inverse() * self.camera;
            let behind = inside.iter().map(|p| p.x).fold(camera.x, f64::max) + 0.12;
            let distance = rng.random_range(0.7..4.0f64).max(behind);
            let tall = rng.random_range(1.8..4.0);
            let wall = |x: f64, y: f64, z: f64| {
                DAffine3::from_rotation_translation(turn, turn * DVec3::new(x, y, bottom + z))
            };
            let size = DVec3::new(0.1, 12.0, tall);
            let at = wall(distance + 0.05, 0.0, 0.5 * tall);
            self.add(CUBOID, at, size, of_wall, Kind::Surface);
            if rng.random_bool(0.4) {
                let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let beside = inside
                    .iter()
                    .map(|p| side * p.y)
                    .fold(side * camera.y, f64::max)
                    + 0.2;
                let offset = rng.random_range(0.9..2.5f64).max(beside);
                let at = wall(0.0, side * offset, 0.5 * tall);
                let of_side = screen.unwrap_or_else(|| paint(rng));
                let size = DVec3::new(2.0 * distance, 0.1, tall);
                self.add(CUBOID, at, size, of_side, Kind::Surface);
            }
            if screen.is_none() {
                self.on_wall(&wall, distance, rng);
            }
        }
        for _ in 0..rng.random_range(0..=6) {
            let yaw = heading + 0.7 * normal(rng);
            let distance = rng.random_range(0.7..3.2);
            let foot = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), bottom);
            let turn = DQuat::from_rotation_z(rng.random_range(0.0..TAU));
            match rng.random_range(0..8) {
                0 => self.desk(foot, turn, rng),
                1 => self.chair(foot, turn, rng),
                2 => self.post(foot, rng),
                3 => self.shelf(foot, turn, rng),
                4 => self.case(foot, turn, rng),
                _ => {
                    let size = DVec3::new(
                        rng.random_range(0.1..1.0),
                        rng.random_range(0.1..1.0),
                        rng.random_range(0.2..1.8),
                    );
                    let material = furniture(rng);
                    let centre = foot + DVec3::Z * 0.5 * size.z;
                    if self.clear(centre, 0.55 * size.length()) {
                        let pose = DAffine3::from_rotation_translation(turn, centre);
                        self.add(CUBOID, pose, size, material, Kind::Scenery);
                    }
                }
            }
        }
    }

    /// Windows, doors, cupboards, posters, pipes and rails.
    fn on_wall(
        &mut self,
        wall: &dyn Fn(f64, f64, f64) -> DAffine3,
        distance: f64,
        rng: &mut ChaCha8Rng,
    ) {
        for _ in 0..rng.random_range(0..=6) {
            let y = rng.random_range(-2.0..2.0);
            let z = rng.random_range(0.3..2.2);
            let (wide, high) = (rng.random_range(0.2..1.2), rng.random_range(0.2..1.2));
            let deep = rng.random_range(0.01..0.05);
            let (material, size) = match rng.random_range(0..6) {
                // Bright: a window or a whiteboard.
                0 => (
                    plain(grey(rng, 0.9, 1.0).map(|c| 1.4 * c)),
                    DVec3::new(deep, wide, high),
                ),
                1 => {
                    let poster = Material {
                        photo: 1.0,
                        photo_scale: rng.random_range(0.5..2.0),
                        photo_offset: [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)],
                        ..MATT
                    };
                    (poster, DVec3::new(deep, wide, high))
                }
                2 => (furniture(rng), DVec3::new(0.35, wide, high)),
                3 => (aluminium(rng), DVec3::new(0.05, 0.05, 4.0)),
                4 => (plain(grey(rng, 0.3, 0.9)), DVec3::new(0.04, 6.0, 0.06)),
                _ => (any_material(rng), DVec3::new(deep, wide, high)),
            };
            let at = wall(distance - 0.5 * size.x, y, z);
            let centre = at.translation;
            if self.clear(centre, 0.2) {
                let round = size.z > 3.0 && rng.random_bool(0.5);
                let mesh = if round { CYLINDER } else { CUBOID };
                self.add(mesh, at, size, material, Kind::Surface);
            }
        }
    }

    /// A table with legs and perhaps a monitor on it.
    fn desk(&mut self, foot: DVec3, turn: DQuat, rng: &mut ChaCha8Rng) {
        let size = DVec3::new(
            rng.random_range(0.5..0.9),
            rng.random_range(0.8..1.6),
            rng.random_range(0.65..0.9),
        );
        if !self.clear(foot + DVec3::Z * size.z, 0.5 * size.y) {
            return;
        }
        let place = DAffine3::from_rotation_translation(turn, foot);
        let at = |x: f64, y: f64, z: f64| place * DAffine3::from_translation(DVec3::new(x, y, z));
        let (top, leg) = (furniture(rng), furniture(rng));
        let plate = DVec3::new(size.x, size.y, 0.03);
        self.add(CUBOID, at(0.0, 0.0, size.z), plate, top, Kind::Scenery);
        for (x, y) in [(0.46, 0.46), (0.46, -0.46), (-0.46, 0.46), (-0.46, -0.46)] {
            let bar = DVec3::new(0.05, 0.05, size.z);
            let pose = at(x * size.x, y * size.y, 0.5 * size.z);
            self.add(CYLINDER, pose, bar, leg, Kind::Scenery);
        }
        let dark = plain(grey(rng, 0.03, 0.2));
        for _ in 0..rng.random_range(0..=2) {
            let wide = rng.random_range(0.3..0.65);
            let y = 0.3 * size.y * rng.random_range(-1.0..1.0);
            let z = size.z + rng.random_range(0.2..0.4);
            let frame = DVec3::new(0.03, wide, 0.62 * wide);
            self.add(CUBOID, at(0.0, y, z), frame, dark, Kind::Scenery);
            let stand = DVec3::new(0.03, 0.06, z - size.z);
            self.add(
                CUBOID,
                at(0.02, y, 0.5 * (z + size.z)),
                stand,
                dark,
                Kind::Scenery,
            );
            let glow = Material {
                albedo: grey(rng, 0.02, 0.9),
                photo: if rng.random_bool(0.6) { 0.9 } else { 0.0 },
                photo_scale: 1.5,
                ..MATT
            };
            let screen = DVec3::new(0.034, 0.94 * wide, 0.56 * wide);
            self.add(CUBOID, at(0.0, y, z), screen, glow, Kind::Scenery);
        }
    }

    fn chair(&mut self, foot: DVec3, turn: DQuat, rng: &mut ChaCha8Rng) {
        if !self.clear(foot + DVec3::Z * 0.45, 0.5) {
            return;
        }
        let place = DAffine3::from_rotation_translation(turn, foot);
        let at = |x: f64, y: f64, z: f64| place * DAffine3::from_translation(DVec3::new(x, y, z));
        let (cloth, metal) = (clothing(rng), aluminium(rng));
        let seat = DVec3::new(0.43, 0.43, 0.05);
        self.add(CUBOID, at(0.0, 0.0, 0.45), seat, cloth, Kind::Scenery);
        let back = DVec3::new(0.04, 0.43, 0.4);
        self.add(CUBOID, at(-0.2, 0.0, 0.75), back, cloth, Kind::Scenery);
        for (x, y) in [(0.18, 0.18), (0.18, -0.18), (-0.18, 0.18), (-0.18, -0.18)] {
            let leg = DVec3::new(0.025, 0.025, 0.45);
            self.add(CYLINDER, at(x, y, 0.225), leg, metal, Kind::Scenery);
        }
    }

    /// A lamp, a tripod, a barrier post, a pipe: upright and thin.
    fn post(&mut self, foot: DVec3, rng: &mut ChaCha8Rng) {
        let tall = rng.random_range(0.6..2.2);
        let radius = rng.random_range(0.01..0.06);
        if !self.clear(foot + DVec3::Z * tall, 0.3)
            || !self.clear(foot + DVec3::Z * 0.5 * tall, 0.3)
        {
            return;
        }
        let material = self.bright(rng);
        let top = foot + DVec3::Z * tall;
        self.rod(foot, top, radius, material, Kind::Scenery);
        if rng.random_bool(0.4) {
            for n in 0..3 {
                let yaw = TAU * f64::from(n) / 3.0;
                let end = foot + DVec3::new(yaw.cos(), yaw.sin(), 0.0) * 0.35;
                let high = foot + DVec3::Z * 0.45 * tall;
                self.rod(end, high, 0.6 * radius, material, Kind::Scenery);
            }
        }
        let head = DVec3::new(
            rng.random_range(0.05..0.3),
            rng.random_range(0.05..0.3),
            rng.random_range(0.03..0.25),
        );
        let mesh = *[CUBOID, CYLINDER, SPHERE].choose(rng).unwrap_or(&CUBOID);
        let material = any_material(rng);
        self.add(
            mesh,
            DAffine3::from_translation(top),
            head,
            material,
            Kind::Scenery,
        );
    }

    /// A finish like those of the robot's parts.
    fn bright(&mut self, rng: &mut ChaCha8Rng) -> Material {
        match rng.random_range(0.0..1.0) {
            p if p < 0.45 => aluminium(rng),
            p if p < 0.6 => plain(grey(rng, 0.3, 0.9)),
            p if p < 0.75 => plain(hsv(
                rng.random_range(0.52..0.6),
                rng.random_range(0.15..0.5),
                rng.random_range(0.6..0.95),
            )),
            _ => any_material(rng),
        }
    }

    /// Shelves or a rack of profiles, with boxes in it.
    fn shelf(&mut self, foot: DVec3, turn: DQuat, rng: &mut ChaCha8Rng) {
        let (wide, deep, tall) = (
            rng.random_range(0.5..1.4),
            rng.random_range(0.3..0.6),
            rng.random_range(0.9..2.1),
        );
        if !self.clear(foot + DVec3::Z * 0.5 * tall, 0.6 * tall.max(wide)) {
            return;
        }
        let place = DAffine3::from_rotation_translation(turn, foot);
        let at = |x: f64, y: f64, z: f64| place * DAffine3::from_translation(DVec3::new(x, y, z));
        let (bar, board) = (aluminium(rng), furniture(rng));
        for (x, y) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
            let size = DVec3::new(0.04, 0.04, tall);
            self.add(
                CUBOID,
                at(x * deep, y * wide, 0.5 * tall),
                size,
                bar,
                Kind::Scenery,
            );
        }
        let levels = rng.random_range(2..=4);
        for n in 0..levels {
            let z = tall * (f64::from(n) + 0.6) / f64::from(levels);
            let size = DVec3::new(deep, wide, 0.025);
            self.add(CUBOID, at(0.0, 0.0, z), size, board, Kind::Scenery);
            for _ in 0..rng.random_range(0..=3) {
                let size = DVec3::new(
                    0.7 * deep,
                    rng.random_range(0.06..0.3),
                    rng.random_range(0.06..0.25),
                );
                let y = 0.4 * wide * rng.random_range(-1.0..1.0);
                let material = any_material(rng);
                let pose = at(0.0, y, z + 0.5 * size.z);
                self.add(CUBOID, pose, size, material, Kind::Scenery);
            }
        }
    }

    /// A cardboard box or an open crate. `foot`: the middle of its bottom.
    fn case(&mut self, foot: DVec3, turn: DQuat, rng: &mut ChaCha8Rng) {
        let size = DVec3::new(
            rng.random_range(0.15..0.6),
            rng.random_range(0.15..0.45),
            rng.random_range(0.08..0.4),
        );
        if !self.clear(foot + DVec3::Z * 0.5 * size.z, 0.5 * size.length()) {
            return;
        }
        let place = DAffine3::from_rotation_translation(turn, foot);
        let at = |x: f64, y: f64, z: f64| place * DAffine3::from_translation(DVec3::new(x, y, z));
        if rng.random_bool(0.5) {
            let board = plain(hsv(
                rng.random_range(0.07..0.1),
                rng.random_range(0.3..0.5),
                rng.random_range(0.5..0.8),
            ));
            self.add(
                CUBOID,
                at(0.0, 0.0, 0.5 * size.z),
                size,
                board,
                Kind::Scenery,
            );
            return;
        }
        let colour = if rng.random_bool(0.6) {
            hsv(
                rng.random_range(0.58..0.66),
                0.8,
                rng.random_range(0.4..0.8),
            )
        } else {
            any_colour(rng)
        };
        let plastic = Material {
            albedo: colour,
            specular: 0.1,
            ..MATT
        };
        let thin = 0.012;
        let bottom = DVec3::new(size.x, size.y, thin);
        self.add(
            CUBOID,
            at(0.0, 0.0, 0.5 * thin),
            bottom,
            plastic,
            Kind::Scenery,
        );
        for side in [-0.5, 0.5] {
            let long = DVec3::new(size.x, thin, size.z);
            let short = DVec3::new(thin, size.y, size.z);
            let z = 0.5 * size.z;
            self.add(
                CUBOID,
                at(0.0, side * size.y, z),
                long,
                plastic,
                Kind::Scenery,
            );
            self.add(
                CUBOID,
                at(side * size.x, 0.0, z),
                short,
                plastic,
                Kind::Scenery,
            );
        }
    }

    /// A board of black and white squares, as cameras are calibrated with.
    fn checkerboard(&mut self, foot: DVec3, turn: DQuat, rng: &mut ChaCha8Rng) {
        let square = rng.random_range(0.015..0.04);
        let (columns, rows) = (rng.random_range(4..=8), rng.random_range(3..=6));
        if !self.clear(foot, 0.6 * square * f64::from(columns)) {
            return;
        }
        let place = DAffine3::from_rotation_translation(turn, foot);
        let (white, black) = (plain([0.85; 3]), plain([0.02; 3]));
        let size = DVec3::new(f64::from(columns + 1), f64::from(rows + 1), 0.1) * square;
        self.add(CUBOID, place, size, white, Kind::Surface);
        for column in 0..columns {
            for row in (column % 2..rows).step_by(2) {
                let x = (f64::from(column) - 0.5 * f64::from(columns - 1)) * square;
                let y = (f64::from(row) - 0.5 * f64::from(rows - 1)) * square;
                let pose = place * DAffine3::from_translation(DVec3::new(x, y, 0.06 * square));
                self.add(
                    CUBOID,
                    pose,
                    DVec3::new(square, square, 0.02),
                    black,
                    Kind::Surface,
                );
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
        let small = rng.random_range(0.2..1.0);
        for _ in 0..rng.random_range(0..=16) {
            let mesh = *[CUBOID, CUBOID, CYLINDER, CYLINDER, SPHERE]
                .choose(rng)
                .unwrap_or(&CUBOID);
            let largest = small * rng.random_range(0.03..0.3);
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
            let mut foot = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), 0.0);
            let mut lies = true;
            match *support {
                Support::Table {
                    size: table,
                    middle,
                } if rng.random_bool(0.8) => {
                    foot.x = middle.x + 0.47 * table.x * rng.random_range(-1.0..1.0);
                    foot.y = middle.y + 0.47 * table.y * rng.random_range(-1.0..1.0);
                }
                _ => match floor {
                    Some(height) if rng.random_bool(0.8) => foot.z = height,
                    _ => {
                        foot.z = rng.random_range(-0.6..1.0);
                        lies = false;
                    }
                },
            }
            match rng.random_range(0.0..1.0) {
                p if lies && p < 0.04 => self.checkerboard(foot, turn, rng),
                p if lies && p < 0.12 => self.case(foot, turn, rng),
                _ => {
                    if !lies || rng.random_bool(0.3) {
                        // Lying or leaning.
                        turn *= DQuat::from_rotation_x(rng.random_range(0.0..PI));
                        foot.z += 0.2 * size.z;
                    }
                    let centre = foot + DVec3::Z * 0.5 * size.z;
                    let material = if rng.random_bool(0.3) {
                        self.bright(rng)
                    } else {
                        any_material(rng)
                    };
                    if self.clear(centre, 0.5 * size.length()) {
                        let pose = DAffine3::from_rotation_translation(turn, centre);
                        self.add(mesh, pose, size, material, Kind::Scenery);
                    }
                }
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

    /// An arm of another make: tapering tubes and round joints, mostly of one bright colour.
    fn chain(&mut self, near: bool, rng: &mut ChaCha8Rng) {
        let distance = if near {
            rng.random_range(0.0..0.6)
        } else {
            rng.random_range(0.6..1.8)
        };
        let yaw = rng.random_range(0.0..TAU);
        let mut at = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), 0.0);
        let mut way = DVec3::Z;
        let paint = |rng: &mut ChaCha8Rng| Material {
            albedo: match rng.random_range(0.0..1.0) {
                p if p < 0.35 => grey(rng, 0.8, 0.98),
                p if p < 0.65 => {
                    let hue = rng.random_range(0.02..0.15);
                    hsv(hue, rng.random_range(0.7..1.0), rng.random_range(0.6..0.95))
                }
                p if p < 0.8 => grey(rng, 0.03, 0.2),
                _ => any_colour(rng),
            },
            specular: rng.random_range(0.0..0.3),
            shininess: 30.0,
            ..MATT
        };
        let one = paint(rng);
        let two = if rng.random_bool(0.5) {
            one
        } else {
            paint(rng)
        };
        let ball = rng.random_bool(0.5);
        let mut radius = rng.random_range(0.04..0.1);
        for _ in 0..rng.random_range(3..=6) {
            let next = at + way * rng.random_range(0.08..0.45);
            if !self.clear(0.5 * (at + next), 0.5 * at.distance(next)) {
                return;
            }
            let turn = DQuat::from_rotation_arc(DVec3::Z, way);
            self.rod(at, next, radius, one, Kind::Scenery);
            let (mesh, knot) = if ball {
                (SPHERE, DVec3::splat(2.5 * radius))
            } else {
                (CYLINDER, DVec3::new(2.3, 2.3, 3.2) * radius)
            };
            let turn = turn * DQuat::from_rotation_x(0.5 * PI);
            let pose = DAffine3::from_rotation_translation(turn, next);
            self.add(mesh, pose, knot, two, Kind::Scenery);
            at = next;
            radius *= rng.random_range(0.7..1.0);
            let bend = DVec3::new(normal(rng), normal(rng), normal(rng)).normalize_or(DVec3::X);
            way = (way + 1.2 * bend).normalize_or(DVec3::Z);
        }
    }

    /// People: beside and behind the robot, some before it.
    pub(super) fn people(&mut self, floor: f64, rng: &mut ChaCha8Rng) {
        let count = match rng.random_range(0.0..1.0) {
            p if p < 0.72 => 0,
            p if p < 0.9 => 1,
            p if p < 0.97 => 2,
            _ => 3,
        };
        for _ in 0..count {
            let behind = (-self.camera).y.atan2((-self.camera).x);
            let (yaw, distance) = if rng.random_bool(0.85) {
                (behind + 0.9 * normal(rng), rng.random_range(0.5..2.5))
            } else {
                (behind + PI + 0.5 * normal(rng), rng.random_range(0.4..1.2))
            };
            let tall = rng.random_range(1.5..1.95);
            let feet = floor.min(0.9 - tall).max(-1.1);
            let foot = DVec3::new(distance * yaw.cos(), distance * yaw.sin(), feet);
            let clear = [0.2, 0.5, 0.7, 0.9]
                .iter()
                .all(|&part| self.clear(foot + DVec3::Z * part * tall, 0.28));
            if clear {
                let turn = DQuat::from_rotation_z(yaw + PI + 0.8 * normal(rng));
                self.person(foot, turn, tall, rng);
            }
        }
    }

    /// A person `tall` metres tall who looks along x.
    fn person(&mut self, foot: DVec3, turn: DQuat, tall: f64, rng: &mut ChaCha8Rng) {
        let place = DAffine3::from_rotation_translation(turn, foot)
            * DAffine3::from_scale(DVec3::splat(tall));
        let at = |x: f64, y: f64, z: f64| place.transform_point3(DVec3::new(x, y, z));
        let pose = |x: f64, y: f64, z: f64| DAffine3::from_rotation_translation(turn, at(x, y, z));
        let (skin, shirt, trousers) = (skin(rng), clothing(rng), clothing(rng));
        let hair = plain(hsv(
            rng.random_range(0.05..0.12),
            rng.random_range(0.1..0.6),
            rng.random_range(0.05..0.5),
        ));
        let wide = rng.random_range(0.24..0.3);
        for side in [-1.0, 1.0] {
            let stride = 0.05 * normal(rng);
            let (hip, knee, ankle) = (
                at(0.0, side * 0.055, 0.5),
                at(0.5 * stride + 0.01, side * 0.06, 0.28),
                at(stride, side * 0.06, 0.03),
            );
            self.rod(hip, knee, 0.05 * tall, trousers, Kind::Scenery);
            self.rod(knee, ankle, 0.036 * tall, trousers, Kind::Scenery);
            let shoe = DVec3::new(0.15, 0.055, 0.05) * tall;
            self.add(
                CUBOID,
                pose(stride + 0.03, side * 0.06, 0.025),
                shoe,
                trousers,
                Kind::Scenery,
            );
            // Arms hang, or reach forwards.
            let reaching = rng.random_bool(0.4);
            let lift = if reaching {
                rng.random_range(0.4..1.5)
            } else {
                0.15
            };
            let shoulder = (0.0, side * 0.5 * wide, 0.8);
            let elbow = (
                0.17 * f64::sin(lift),
                shoulder.1 + side * 0.03,
                0.8 - 0.17 * f64::cos(lift),
            );
            let bend = if reaching {
                lift + rng.random_range(0.0..0.9)
            } else {
                lift + 0.2
            };
            let hand = (
                elbow.0 + 0.16 * f64::sin(bend),
                elbow.1 - side * rng.random_range(0.0..0.1),
                elbow.2 - 0.16 * f64::cos(bend),
            );
            let [a, b, c] = [shoulder, elbow, hand].map(|(x, y, z)| at(x, y, z));
            let bare = rng.random_bool(0.4);
            self.rod(a, b, 0.032 * tall, shirt, Kind::Scenery);
            self.rod(
                b,
                c,
                0.024 * tall,
                if bare { skin } else { shirt },
                Kind::Scenery,
            );
            for (place, size, material) in [(a, 0.075, shirt), (b, 0.058, shirt), (c, 0.06, skin)] {
                let ball = DAffine3::from_translation(place);
                self.add(
                    SPHERE,
                    ball,
                    DVec3::splat(size * tall),
                    material,
                    Kind::Scenery,
                );
            }
        }
        let chest = DVec3::new(0.14, wide, 0.3) * tall;
        self.add(CYLINDER, pose(0.0, 0.0, 0.66), chest, shirt, Kind::Scenery);
        let belly = DVec3::new(0.14, 0.88 * wide, 0.22) * tall;
        self.add(SPHERE, pose(0.0, 0.0, 0.52), belly, trousers, Kind::Scenery);
        let top = DVec3::new(0.14, wide, 0.1) * tall;
        self.add(SPHERE, pose(0.0, 0.0, 0.81), top, shirt, Kind::Scenery);
        self.rod(
            at(0.0, 0.0, 0.82),
            at(0.01, 0.0, 0.88),
            0.03 * tall,
            skin,
            Kind::Scenery,
        );
        let head = DVec3::new(0.105, 0.088, 0.13) * tall;
        self.add(SPHERE, pose(0.012, 0.0, 0.925), head, skin, Kind::Scenery);
        let crown = DVec3::new(0.108, 0.096, 0.11) * tall;
        self.add(SPHERE, pose(-0.006, 0.0, 0.947), crown, hair, Kind::Scenery);
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
            if rng.random_bool(0.25) {
                // Someone's sleeve and hand.
                let way = DVec3::new(normal(rng), normal(rng), -1.0).normalize_or(DVec3::Z);
                let (sleeve, skin) = (clothing(rng), skin(rng));
                let hand = DAffine3::from_translation(centre);
                if self.clear(centre, 0.08) && self.clear(centre + 0.3 * way, 0.15) {
                    self.rod(
                        centre + 0.06 * way,
                        centre + 0.6 * way,
                        0.05,
                        sleeve,
                        Kind::Scenery,
                    );
                    self.rod(centre, centre + 0.1 * way, 0.032, skin, Kind::Scenery);
                    self.add(
                        SPHERE,
                        hand,
                        DVec3::new(0.1, 0.08, 0.09),
                        skin,
                        Kind::Scenery,
                    );
                }
            } else if self.clear(centre, 0.5 * size.length()) {
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
    let window = rng.random_bool(0.2);
    let strongest = if window { 1.2..2.5 } else { 0.2..1.1 };
    let mut strengths = [rng.random_range(strongest), 0.0, 0.0];
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
        direction: direction(rng, if window { 0.15 } else { 0.4 }, 1.5),
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
