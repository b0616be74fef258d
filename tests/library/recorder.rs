//! The recorder: kinematics, meshes, collisions, projection, and recordings on disk.
#![cfg(feature = "recorder")]

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;
use whereabot::recorder::{
    CollisionModel, Effects, HEIGHT, INTRINSICS, Item, Kind, Lamp, Lighting, Material, Picture,
    RecorderError, Renderer, Request, Scene, Shot, Stage, WIDTH, Window, check_robot,
    paper_requests, record,
};
use whereabot::recording::{Header, Protocol, Reader, Sample, Writer};
use whereabot::robot::{Frames, Mesh, Robot, RobotError};

fn arm_urdf() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/arm/arm.urdf")
}

/// The UR5's joints as `ur_description` has them, without meshes.
fn ur5(folder: &Path) -> PathBuf {
    let joints = [
        ("shoulder_pan", "0 0 0.089159", "0 0 0", "0 0 1"),
        ("shoulder_lift", "0 0.13585 0", "0 1.57079632679 0", "0 1 0"),
        ("elbow", "0 -0.1197 0.425", "0 0 0", "0 1 0"),
        ("wrist_1", "0 0 0.39225", "0 1.57079632679 0", "0 1 0"),
        ("wrist_2", "0 0.093 0", "0 0 0", "0 0 1"),
        ("wrist_3", "0 0 0.09465", "0 0 0", "0 1 0"),
    ];
    let mut text = String::from("<robot name='ur5'><link name='world'/><link name='link0'/>");
    text += "<joint name='world_joint' type='fixed'><parent link='world'/><child link='link0'/>";
    text += "<origin xyz='1 2 3' rpy='0 0 1'/></joint>";
    for (i, (name, xyz, rpy, axis)) in joints.iter().enumerate() {
        let child = i + 1;
        text += &format!(
            "<link name='link{child}'/><joint name='{name}_joint' type='revolute'>
             <parent link='link{i}'/><child link='link{child}'/><origin xyz='{xyz}' rpy='{rpy}'/>
             <axis xyz='{axis}'/><limit lower='-6.3' upper='6.3' effort='1' velocity='1'/></joint>"
        );
    }
    text += "<link name='tool0'/><joint name='flange' type='fixed'><parent link='link6'/>";
    text += "<child link='tool0'/><origin xyz='0 0.0823 0' rpy='-1.57079632679 0 0'/></joint>";
    let path = folder.join("ur5.urdf");
    fs::write(&path, text + "</robot>").unwrap();
    path
}

fn farthest(found: &[DVec3], expected: &[[f64; 3]]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let pairs = found.iter().zip(expected);
    pairs
        .map(|(f, &e)| f.distance(e.into()))
        .fold(0.0, f64::max)
}

const BENT: [f64; 6] = [0.3, -1.2, 1.5, -0.9, -1.4, 0.7];

#[test]
fn kinematics_agree_with_the_published_robot() {
    let folder = TempDir::new().unwrap();
    let robot = Robot::load(&ur5(folder.path()), &[]).unwrap();
    let names: Vec<&str> = robot.joints.iter().map(|j| j.name.as_str()).collect();
    let expected = [
        "shoulder_pan",
        "shoulder_lift",
        "elbow",
        "wrist_1",
        "wrist_2",
        "wrist_3",
    ];
    assert_eq!(names, expected);

    let straight = [
        [0.0, 0.0, 0.089159],
        [0.0, 0.13585, 0.089159],
        [0.425, 0.01615, 0.089159],
        [0.81725, 0.01615, 0.089159],
        [0.81725, 0.10915, 0.089159],
        [0.81725, 0.10915, -0.005491],
    ];
    let bent = [
        [0.0, 0.0, 0.089159],
        [-0.040146, 0.129782, 0.089159],
        [0.142351, 0.060939, 0.485276],
        [0.500345, 0.17168, 0.369358],
        [0.472862, 0.260526, 0.369358],
        [0.523918, 0.27632, 0.29124],
    ];
    let tool = robot.find_link("tool0").unwrap();
    // The flanges come from the manufacturer's DH parameters, a second way to the same place.
    for (angles, joints, flange) in [
        ([0.0; 6], straight, [0.81725, 0.19145, -0.005491]),
        (BENT, bent, [0.455837, 0.269902, 0.245446]),
    ] {
        let poses = robot.link_poses(&angles);
        assert!(farthest(&robot.joint_origins(&poses), &joints) < 2e-6);
        assert!(farthest(&[poses[tool].translation], &[flange]) < 2e-6);

        let mut wrong = angles;
        wrong[1] += 0.01;
        let poses = robot.link_poses(&wrong);
        assert!(farthest(&robot.joint_origins(&poses), &joints) > 1e-3);
        assert!(farthest(&[poses[tool].translation], &[flange]) > 1e-3);
    }
}

/// Joints as the manufacturer's DH parameters have them, with the extra base frame of newer packages.
fn dh_urdf(path: &Path, [d1, a2, a3, d4, d5, d6]: [f64; 6]) {
    let joints = [
        ("shoulder_pan", format!("0 0 {d1}"), "0 0 0"),
        ("shoulder_lift", "0 0 0".into(), "1.57079632679 0 0"),
        ("elbow", format!("{a2} 0 0"), "0 0 0"),
        ("wrist_1", format!("{a3} 0 {d4}"), "0 0 0"),
        ("wrist_2", format!("0 -{d5} 0"), "1.57079632679 0 0"),
        (
            "wrist_3",
            format!("0 {d6} 0"),
            "1.57079632679 3.14159265359 3.14159265359",
        ),
    ];
    let mut text = String::from("<robot name='e'><link name='base_link'/><link name='link0'/>");
    text += "<joint name='turn' type='fixed'><parent link='base_link'/><child link='link0'/>";
    text += "<origin xyz='0 0 0' rpy='0 0 3.14159265359'/></joint>";
    for (i, (name, xyz, rpy)) in joints.iter().enumerate() {
        let child = i + 1;
        text += &format!(
            "<link name='link{child}'/><joint name='{name}_joint' type='revolute'>
             <parent link='link{i}'/><child link='link{child}'/><origin xyz='{xyz}' rpy='{rpy}'/>
             <axis xyz='0 0 1'/>
             <limit drake:acceleration='1' lower='-6.3' upper='6.3' effort='1' velocity='1'/></joint>"
        );
    }
    fs::write(path, text + "</robot>").unwrap();
}

fn frames(offsets: [f64; 6]) -> Frames {
    let names = [
        "shoulder_pan",
        "shoulder_lift",
        "elbow",
        "wrist_1",
        "wrist_2",
        "wrist_3",
    ];
    Frames {
        base_link: "base_link".into(),
        offsets_m: names.map(String::from).into_iter().zip(offsets).collect(),
    }
}

#[test]
fn another_body_has_its_joints_where_the_robot_has_them() {
    let folder = TempDir::new().unwrap();
    let classic = Robot::load(&ur5(folder.path()), &[]).unwrap();
    let path = folder.path().join("dh.urdf");
    dh_urdf(
        &path,
        [0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823],
    );
    let mut other = Robot::load(&path, &[]).unwrap();
    let apart = |other: &Robot, angles: [f64; 6]| {
        let expected = classic.joint_origins(&classic.link_poses(&angles));
        let expected: Vec<[f64; 3]> = expected.iter().map(|p| p.to_array()).collect();
        farthest(&other.joint_origins(&other.link_poses(&angles)), &expected)
    };
    assert!(apart(&other, BENT) > 0.1);
    let points = [0.0, 0.13585, 0.01615, -0.093, -0.09465, -0.0823];
    other.set_frames(&frames(points)).unwrap();
    for angles in [[0.0; 6], BENT, [2.0, -0.4, -1.1, 2.2, 0.8, -3.0]] {
        assert!(apart(&other, angles) < 1e-6);
    }
    let mut wrong = points;
    wrong[4] = 0.0;
    other.set_frames(&frames(wrong)).unwrap();
    assert!(apart(&other, BENT) > 0.05);
}

#[test]
fn the_frames_of_the_e_series_put_its_joints_on_its_body() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("e.urdf");
    // Points at zero angles, added up by hand: out along the arm, beside it, up.
    for (name, dh, expected) in [
        (
            "ur5e",
            [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996],
            [
                [0.0, 0.0, 0.1625],
                [0.0, 0.138, 0.1625],
                [0.425, 0.007, 0.1625],
                [0.8172, 0.007, 0.1625],
                [0.8172, 0.1333, 0.1625],
                [0.8172, 0.1333, 0.0628],
            ],
        ),
        (
            "ur3e",
            [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921],
            [
                [0.0, 0.0, 0.15185],
                [0.0, 0.12, 0.15185],
                [0.24355, 0.027, 0.15185],
                [0.45675, 0.027, 0.15185],
                [0.45675, 0.13105, 0.15185],
                [0.45675, 0.13105, 0.0665],
            ],
        ),
    ] {
        dh_urdf(&path, dh);
        let mut robot = Robot::load(&path, &[]).unwrap();
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("robots/{name}.json"));
        robot.set_frames(&Frames::read(&file).unwrap()).unwrap();
        let points = |angles: [f64; 6]| robot.joint_origins(&robot.link_poses(&angles));
        assert!(farthest(&points([0.0; 6]), &expected) < 1e-6, "{name}");
        assert!(farthest(&points([0.02; 6]), &expected) > 5e-3, "{name}");
    }
}

#[test]
fn unusable_bodies_are_named() {
    let folder = TempDir::new().unwrap();
    let packages = vec![("arm".into(), arm_urdf().parent().unwrap().to_owned())];
    let file = folder.path().join("frames.json");
    let foreign = ur5(folder.path());
    for (text, urdf, told) in [
        (
            "{\"base_link\":\"nowhere\",\"offsets_m\":{}}",
            &arm_urdf(),
            "\"nowhere\"",
        ),
        (
            "{\"base_link\":\"base\",\"offsets_m\":{\"hip\":1}}",
            &arm_urdf(),
            "\"hip\"",
        ),
        ("{\"base_link\":3}", &arm_urdf(), "line 1"),
        ("{}", &foreign, "pan, lift, elbow"),
    ] {
        fs::write(&file, text).unwrap();
        let bodies = [(file.clone(), urdf.clone())];
        let error = Stage::load(&arm_urdf(), &packages, &bodies)
            .err()
            .unwrap()
            .to_string();
        assert!(error.contains(told), "{error}");
    }
}

#[test]
fn meshes_of_all_formats_are_the_same_cube() {
    for name in ["cube.obj", "cube.stl", "cube.dae"] {
        let meshes = Mesh::read(&arm_urdf().with_file_name("meshes").join(name)).unwrap();
        let indices: usize = meshes.iter().map(|m| m.indices.len()).sum();
        assert_eq!(indices, 36, "{name}");
        for mesh in &meshes {
            assert_eq!(mesh.positions.len(), mesh.normals.len());
            for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
                assert!(
                    position.iter().all(|c| (c.abs() - 0.5).abs() < 1e-6),
                    "{name}"
                );
                // A side's normal points away from the centre, by half an edge.
                let height: f32 = position.iter().zip(normal).map(|(p, n)| p * n).sum();
                assert!(
                    (height - 0.5).abs() < 1e-6,
                    "{name}: {position:?} {normal:?}"
                );
            }
        }
    }
}

#[test]
fn a_collada_geometry_keeps_all_its_materials() {
    let meshes = Mesh::read(&arm_urdf().with_file_name("meshes/cube.dae")).unwrap();
    let found: Vec<_> = meshes
        .iter()
        .map(|m| (m.diffuse, m.indices.len()))
        .collect();
    assert_eq!(
        found,
        [(Some([0.25, 0.35, 0.41]), 18), (Some([0.42; 3]), 18)]
    );
}

#[test]
fn broken_meshes_are_refused() {
    let folder = TempDir::new().unwrap();
    let good = fs::read_to_string(arm_urdf().with_file_name("meshes/cube.dae")).unwrap();
    for (name, text, told) in [
        ("a.dae", "<COLLADA".to_owned(), "not XML"),
        (
            "b.dae",
            good.replace("visual_scene ", "other "),
            "visual_scene",
        ),
        ("c.dae", good.replace("0 0  2 0", "99 0  2 0"), "index 99"),
        ("d.dae", good.replace("4 4 4", "4 4 5"), "fewer indices"),
        (
            "e.dae",
            good.replace("4 4 4", "18446744073709551615"),
            "fewer indices",
        ),
        (
            "f.dae",
            good.replace("source=\"#normals\"", "source=\"#gone\""),
            "#gone",
        ),
        (
            "g.dae",
            good.replace("-50 -50 -50", "-50 inf -50"),
            "finite",
        ),
        ("h.ply", good.clone(), ".ply"),
    ] {
        assert_ne!(
            text,
            if name == "h.ply" {
                String::new()
            } else {
                good.clone()
            },
            "{name}"
        );
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        let error = Mesh::read(&path).unwrap_err().to_string();
        assert!(error.contains(told) && error.contains(name), "{error}");
    }
    let path = folder.path().join("good.dae");
    fs::write(&path, good).unwrap();
    assert!(Mesh::read(&path).is_ok());
}

#[test]
fn a_missing_mesh_is_named() {
    let folder = TempDir::new().unwrap();
    let text = fs::read_to_string(arm_urdf()).unwrap();
    let urdf = folder.path().join("arm.urdf");
    fs::write(&urdf, text.replace("meshes/cube.dae", "meshes/absent.dae")).unwrap();
    let package = arm_urdf().parent().unwrap().to_owned();
    let packages = [("arm".to_owned(), package)];
    match Robot::load(&urdf, &packages).unwrap_err() {
        RobotError::MissingMesh {
            link,
            name,
            looked_for,
            ..
        } => {
            assert_eq!(link, "upper");
            assert_eq!(name, "package://arm/meshes/absent.dae");
            assert!(looked_for.ends_with("meshes/absent.dae"));
        }
        other => panic!("{other}"),
    }
    fs::write(&urdf, text).unwrap();
    assert!(Robot::load(&urdf, &packages).is_ok());
    // Without the package's place, and with no such folder above the URDF.
    assert!(matches!(
        Robot::load(&urdf, &[]),
        Err(RobotError::MissingMesh { .. })
    ));
}

#[test]
fn broken_robots_are_refused() {
    let folder = TempDir::new().unwrap();
    let urdf = folder.path().join("robot.urdf");
    let joint = |name: &str, kind: &str, parent: &str, child: &str, limit: &str| {
        format!(
            "<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>
             <limit {limit} effort='1' velocity='1'/></joint>"
        )
    };
    let limit = "lower='-1' upper='1'";
    let good = joint("j", "revolute", "a", "b", limit);
    for (joints, told) in [
        (
            joint("j", "fixed", "a", "b", limit),
            "at least one revolute joint",
        ),
        (joint("j", "revolute", "a", "z", limit), "\"z\""),
        (
            good.clone() + &joint("k", "revolute", "c", "b", limit),
            "more than one joint",
        ),
        (good.clone() + &joint("k", "fixed", "c", "c", limit), "loop"),
        (
            joint("j", "revolute", "a", "b", "lower='2' upper='1'"),
            "found 2 to 1",
        ),
        (
            joint("j", "revolute", "a", "b", "lower='-1e308' upper='1e308'"),
            "found -1",
        ),
        ("<joint".to_owned(), "not a URDF"),
    ] {
        let links = "<link name='a'/><link name='b'/><link name='c'/>";
        fs::write(&urdf, format!("<robot name='r'>{links}{joints}</robot>")).unwrap();
        let error = Robot::load(&urdf, &[]).unwrap_err().to_string();
        assert!(
            error.contains(told) && error.contains("robot.urdf"),
            "{error}"
        );
    }
    let links = "<link name='a'/><link name='b'/>";
    fs::write(&urdf, format!("<robot name='r'>{links}{good}</robot>")).unwrap();
    assert!(Robot::load(&urdf, &[]).is_ok());
}

#[test]
fn collisions_are_found() {
    let robot = Robot::load(&arm_urdf(), &[]).unwrap();
    let model = CollisionModel::new(&robot);
    // Pan, lift, elbow; touches itself; reaches below 9 cm.
    for (angles, itself, floor) in [
        ([0.0, 0.0, 0.0], false, false),
        ([1.0, 0.5, 1.0], false, false),
        ([0.0, 1.5, 3.0], true, false),
        ([0.0, 1.5, 1.6], false, true),
    ] {
        let poses = robot.link_poses(&angles);
        assert_eq!(model.self_collision(&poses), itself, "{angles:?}");
        assert_eq!(model.floor_collision(&poses, 0.09), floor, "{angles:?}");
        assert!(!model.floor_collision(&poses, 0.0));
    }
}

const WHITE: Material = Material {
    albedo: [0.8; 3],
    metal: 0.0,
    specular: 0.0,
    shininess: 10.0,
    photo: 0.0,
    photo_scale: 1.0,
    photo_offset: [0.0; 2],
};

fn ball(kind: Kind, centre: DVec3, radius: f64) -> Item {
    Item {
        mesh: 0,
        base_from_mesh: DAffine3::from_translation(centre)
            * DAffine3::from_scale(DVec3::splat(2.0 * radius)),
        material: WHITE,
        kind,
    }
}

/// A scene whose base frame is the camera's.
fn scene(items: Vec<Item>) -> Scene {
    let lamp = Lamp {
        direction: -DVec3::Z,
        colour: [0.3; 3],
    };
    Scene {
        camera_from_base: DAffine3::IDENTITY,
        items,
        lighting: Lighting {
            lamps: [lamp; 3],
            shadow: 0.5,
            sky: [0.2; 3],
            ground: [0.2; 3],
            mirrored: [(DVec3::X, 0.0); 3],
        },
        centre: DVec3::new(0.0, 0.0, 2.0),
    }
}

fn black() -> Vec<u8> {
    vec![0; (4 * WIDTH * HEIGHT) as usize]
}

/// Mean column and row of the mask.
fn centroid(mask: &[u8]) -> [f64; 2] {
    let mut sums = [0.0; 3];
    for (i, _) in mask.iter().enumerate().filter(|&(_, &m)| m == 255) {
        sums[0] += (i % WIDTH as usize) as f64;
        sums[1] += (i / WIDTH as usize) as f64;
        sums[2] += 1.0;
    }
    assert!(sums[2] > 20.0);
    [sums[0] / sums[2], sums[1] / sums[2]]
}

#[test]
fn a_small_ball_appears_where_its_centre_projects() {
    let device = crate::common::device();
    let mut renderer = Renderer::new(&device, &[Mesh::sphere()]).unwrap();
    let mut errors = Vec::new();
    for (x, y, z) in [
        (0.0, 0.0, 2.0),
        (1.2, 0.3, 2.0),
        (-1.3, -1.0, 2.2),
        (0.5, 0.9, 1.8),
        (0.1003, -0.4001, 1.5),
    ] {
        let centre = DVec3::new(x, y, z);
        let items = vec![ball(Kind::Robot, centre, 0.011 * z)];
        let picture = renderer.draw(&scene(items), &black(), None).unwrap();
        let found = centroid(&picture.mask);
        let expected = INTRINSICS.project(centre.to_array()).unwrap();
        // The picture shows the ball where the mask says, on the black background.
        for (i, &mask) in picture.mask.iter().enumerate() {
            let bright = picture.rgb[3 * i] > 0;
            assert!(mask == 0 || bright, "pixel {i}");
        }
        errors.push([found[0] - expected[0], found[1] - expected[1]]);
    }
    for axis in 0..2 {
        let mean = errors.iter().map(|e| e[axis]).sum::<f64>() / errors.len() as f64;
        let largest = |shift: f64| {
            errors
                .iter()
                .map(|e| (e[axis] + shift).abs())
                .fold(0.0, f64::max)
        };
        assert!(mean.abs() < 0.08 && largest(0.0) < 0.2, "{errors:?}");
        // Half a pixel, as from the other pixel convention, would be noticed.
        assert!(largest(0.5) > 0.3 && largest(-0.5) > 0.3);
    }
}

#[test]
fn what_hides_the_robot_is_not_in_the_mask() {
    let device = crate::common::device();
    let mut renderer = Renderer::new(&device, &[Mesh::sphere()]).unwrap();
    let robot = ball(Kind::Robot, DVec3::new(0.0, 0.0, 2.0), 0.3);
    let near = DVec3::new(0.0, 0.0, 1.5);
    let far = DVec3::new(0.0, 0.0, 2.6);
    let mut covered = |other: Option<Item>| {
        let items = std::iter::once(robot.clone()).chain(other).collect();
        let picture = renderer.draw(&scene(items), &black(), None).unwrap();
        picture.mask.iter().filter(|&&m| m == 255).count()
    };
    let alone = covered(None);
    assert!(alone > 9000);
    assert!(covered(Some(ball(Kind::Scenery, near, 0.1))) < alone - 1000);
    assert_eq!(covered(Some(ball(Kind::Scenery, far, 0.1))), alone);
    assert_eq!(covered(Some(ball(Kind::Cable, near, 0.1))), alone);
    assert_eq!(covered(Some(ball(Kind::Shadow, near, 0.1))), alone);
}

#[test]
fn a_second_arm_is_in_the_mask_and_its_joints_are_not_recorded() {
    let packages = vec![("arm".into(), arm_urdf().parent().unwrap().to_owned())];
    let stage = Stage::load(&arm_urdf(), &packages, &[]).unwrap();
    let visible = |shot: &Shot| -> Vec<Item> {
        let items = shot.scene.items.iter();
        items.filter(|i| i.kind == Kind::Robot).cloned().collect()
    };
    let shots: Vec<Shot> = (0..60)
        .flat_map(|id| stage.free_shots(1, id, 1, 1).unwrap())
        .collect();
    let counts: Vec<usize> = shots.iter().map(|shot| visible(shot).len()).collect();
    let one = counts.iter().copied().filter(|&c| c > 0).min().unwrap();
    assert!(counts.iter().all(|&c| c == 0 || c == one || c == 2 * one));
    assert!(counts.contains(&0) && counts.contains(&one));
    let device = crate::common::device();
    let mut renderer = Renderer::new(&device, stage.meshes()).unwrap();
    let mut seen = 0;
    for shot in shots
        .iter()
        .filter(|shot| visible(shot).len() == 2 * one)
        .take(4)
    {
        let items = visible(shot);
        let mut covered = |items: &[Item]| {
            let scene = Scene {
                items: items.to_vec(),
                ..shot.scene.clone()
            };
            let picture = renderer.draw(&scene, &black(), None).unwrap();
            picture.mask.iter().filter(|&&m| m == 255).count()
        };
        let (both, first, second) = (
            covered(&items),
            covered(&items[..one]),
            covered(&items[one..]),
        );
        assert!(both > first && first > 0 && second > 0);
        seen += 1;
        // The recorded joints belong to the first arm: its pan link is there.
        let robot = shot.robot.as_ref().unwrap();
        let robot_poses = stage.robot().link_poses(&robot.angles);
        let expected = stage.robot().joint_origins(&robot_poses);
        for (&found, expected) in robot.joints.iter().zip(expected) {
            let expected = shot.scene.camera_from_base.transform_point3(expected);
            assert!(found.distance(expected) < 1e-9);
        }
        let base = |item: &Item| item.base_from_mesh.translation.length();
        assert!(base(&items[0]) < base(&items[one]));
    }
    assert!(seen > 0);
}

#[test]
fn pictures_of_other_shapes_have_black_edges_without_a_mask() {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let (mut whole, mut tall, mut flat) = (0, 0, 0);
    for _ in 0..60 {
        let window = Window::any(&mut rng);
        let mut picture = Picture {
            rgb: vec![200; (3 * WIDTH * HEIGHT) as usize],
            mask: vec![255; (WIDTH * HEIGHT) as usize],
        };
        Effects::any(&mut rng, window).apply(&mut picture);
        let [left, top, right, bottom] = window.edges();
        whole += usize::from(window == Window::WHOLE);
        tall += usize::from(left > 0.0);
        flat += usize::from(top > 0.0);
        // In the middle, but for the pixel that an odd size leaves over.
        assert!((left + right - 512.0).abs() <= 1.0 && (top + bottom - 424.0).abs() <= 1.0);
        let pixels = picture.rgb.as_chunks::<3>().0.iter();
        for (i, (pixel, &mask)) in (0..).zip(pixels.zip(&picture.mask)) {
            let inside = window.contains([i % WIDTH, i / WIDTH]);
            assert_eq!(mask, if inside { 255 } else { 0 });
            assert_eq!(pixel.iter().all(|&c| c > 0), inside);
        }
    }
    assert!(
        whole > tall && tall > 0 && flat > 0,
        "{whole} {tall} {flat}"
    );
}

/// A folder with two pictures and one that only has a picture's name.
fn backgrounds(folder: &Path) -> PathBuf {
    let folder = folder.join("backgrounds");
    fs::create_dir(&folder).unwrap();
    let noise = crate::common::noise(3 * 64 * 48, 1);
    let bytes: Vec<u8> = noise.iter().map(|n| (127.0 * (n + 1.0)) as u8).collect();
    let picture = image::RgbImage::from_raw(64, 48, bytes).unwrap();
    picture.save(folder.join("a.png")).unwrap();
    picture.save(folder.join("b.JPG")).unwrap();
    fs::write(folder.join("c.jpg"), "no picture").unwrap();
    folder
}

fn request(folder: &Path, out: &str) -> Request {
    let backgrounds = folder.join("backgrounds");
    Request {
        urdf: arm_urdf(),
        packages: vec![("arm".into(), arm_urdf().parent().unwrap().to_owned())],
        bodies: Vec::new(),
        robot: "arm".into(),
        backgrounds,
        samples: 6,
        seed: 3,
        protocol: Protocol::FreeCamera,
        cameras: 1,
        out: folder.join(out),
    }
}

fn samples(out: &Path) -> Vec<Sample> {
    let text = fs::read_to_string(out.join("samples.jsonl")).unwrap();
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

fn image_of(out: &Path, name: &str) -> image::DynamicImage {
    image::open(out.join(name)).unwrap()
}

#[test]
fn a_urdf_is_of_the_robot_that_it_is_said_to_be() {
    let folder = TempDir::new().unwrap();
    let urdf = folder.path().join("arm.urdf");
    let origins = |upper: f64, fore: f64| {
        [0.0, 0.1, upper, fore, 0.1, 0.1].map(|z| format!("<origin xyz=\"0 0 {z}\"/>"))
    };
    let write = |origins: &[String]| {
        let mut text = String::from("<robot name=\"arm\"><link name=\"l0\"/>");
        for (i, origin) in origins.iter().enumerate() {
            text += &format!(
                "<link name=\"l{0}\"/><joint name=\"j{0}\" type=\"revolute\"><parent link=\"l{i}\"/><child \
                 link=\"l{0}\"/>{origin}<axis xyz=\"0 1 0\"/><limit lower=\"-3\" upper=\"3\" effort=\"1\" \
                 velocity=\"1\"/></joint>",
                i + 1
            );
        }
        fs::write(&urdf, text + "</robot>").unwrap();
        Robot::kinematics(&urdf).unwrap()
    };
    let check = |name: &str, robot: &Robot| {
        let request = Request {
            urdf: urdf.clone(),
            robot: name.into(),
            ..request(folder.path(), "out")
        };
        check_robot(&request, robot).map_err(|error| error.to_string())
    };
    for (name, upper, fore) in [
        ("ur3", 0.24365, 0.21325),
        ("ur5", 0.425, 0.39225),
        ("ur10", 0.6127, 0.57155),
    ] {
        let robot = write(&origins(upper, fore));
        assert_eq!(check(name, &robot), Ok(()));
        assert_eq!(check("mine", &robot), Ok(()));
        for (other, _) in whereabot::recorder::PAPER {
            assert_eq!(check(other, &robot).is_ok(), other == name);
        }
    }
    let said = check("ur10", &write(&origins(0.425, 0.39225))).unwrap_err();
    let expected =
        "expected the arm of a ur10, 1.20 m from shoulder to elbow to wrist, found one of 0.82 m";
    assert!(said.contains(expected), "{said}");
    let said = check("ur5", &write(&origins(0.425, 0.39225)[..3])).unwrap_err();
    assert!(said.ends_with("found none of six joints"), "{said}");
}

#[test]
fn a_recording_tells_the_truth_about_its_pictures() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let mut request = request(folder.path(), "out");
    request.samples = 16;
    let done = std::sync::atomic::AtomicU64::new(0);
    record(&crate::common::device(), &request, |n| {
        done.store(n, std::sync::atomic::Ordering::Relaxed);
    })
    .unwrap();
    assert_eq!(done.into_inner(), 16);

    let header = fs::read_to_string(request.out.join("recording.json")).unwrap();
    let header: Header = serde_json::from_str(&header).unwrap();
    assert_eq!(header.joints, ["pan", "lift", "elbow"]);
    assert_eq!((header.width, header.height, header.version), (512, 424, 1));
    assert_eq!(header.source.urdf.as_deref(), Some("arm.urdf"));

    let robot = Robot::load(&request.urdf, &request.packages).unwrap();
    let samples = samples(&request.out);
    assert_eq!(samples.len(), 16);
    let (mut on_robot, mut on_mirrored, mut joints, mut empty) = (0, 0, 0, 0);
    for (id, sample) in samples.iter().enumerate() {
        assert_eq!(sample.id, id as u64);
        let colour = image_of(&request.out, &sample.image).into_rgb8();
        let mask = image_of(&request.out, &sample.mask);
        assert_eq!(mask.color(), image::ColorType::L8);
        let mask = mask.into_luma8();
        assert_eq!(colour.dimensions(), (512, 424));
        assert_eq!(mask.dimensions(), (512, 424));
        assert!(mask.iter().all(|&m| m == 0 || m == 255));
        let share = mask.iter().filter(|&&m| m == 255).count() as f64 / mask.len() as f64;
        assert!((sample.coverage - share).abs() < 1e-12);

        let Some(angles) = &sample.joint_angles_rad else {
            let text = serde_json::to_string(sample).unwrap();
            assert!(
                !text.contains("joint") && !text.contains("camera_from_base"),
                "{text}"
            );
            assert_eq!(share, 0.0);
            empty += 1;
            continue;
        };
        assert!((0.002..0.5).contains(&share), "{share}");
        let matrix = sample.camera_from_base.unwrap();
        let camera_from_base =
            DAffine3::from_mat4(glam::DMat4::from_cols_array(&matrix).transpose());
        let origins = robot.joint_origins(&robot.link_poses(angles));
        let metres = sample.joints_m.as_ref().unwrap();
        let pixels = sample.joints_px.as_ref().unwrap();
        for ((origin, &metres), pixel) in origins.iter().zip(metres).zip(pixels) {
            assert!(
                camera_from_base
                    .transform_point3(*origin)
                    .distance(metres.into())
                    < 1e-9
            );
            let [u, v] = INTRINSICS.project(metres).unwrap();
            assert!((u - pixel[0]).abs() < 1e-9 && (v - pixel[1]).abs() < 1e-9);
            let robot_at = |u: f64, v: f64| {
                let (u, v) = (u.round(), v.round());
                let inside = (0.0..512.0).contains(&u) && (0.0..424.0).contains(&v);
                inside.then(|| mask.get_pixel(u as u32, v as u32).0[0] == 255)
            };
            // All joints of this robot are inside its body.
            if let Some(hit) = robot_at(u, v) {
                joints += 1;
                on_robot += usize::from(hit);
                on_mirrored += usize::from(robot_at(511.0 - u, v) == Some(true));
            }
        }
    }
    assert!(
        empty > 0 && joints > 20,
        "{empty} without a robot, {joints} joints"
    );
    assert!(
        on_robot * 10 > joints * 8,
        "{on_robot} of {joints} joints on the mask"
    );
    assert!(
        on_mirrored * 10 < joints * 8,
        "{on_mirrored} of {joints} mirrored ones as well"
    );
}

#[test]
fn the_same_seed_gives_the_same_recording_even_after_a_stop() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let device = crate::common::device();
    let whole = request(folder.path(), "whole");
    record(&device, &whole, |_| {}).unwrap();

    let mut stopped = request(folder.path(), "stopped");
    stopped.samples = 2;
    record(&device, &stopped, |_| {}).unwrap();
    let lines = stopped.out.join("samples.jsonl");
    let half_a_line = fs::read_to_string(&lines).unwrap() + "{\"id\":2,\"ima";
    fs::write(&lines, half_a_line).unwrap();
    stopped.samples = 6;
    record(&device, &stopped, |_| {}).unwrap();

    let mut other = request(folder.path(), "other");
    other.seed = 4;
    record(&device, &other, |_| {}).unwrap();

    let all = |out: &Path| {
        let mut bytes = fs::read(out.join("samples.jsonl")).unwrap();
        for sample in samples(out) {
            bytes.extend(fs::read(out.join(sample.image)).unwrap());
            bytes.extend(fs::read(out.join(sample.mask)).unwrap());
        }
        bytes
    };
    assert!(all(&whole.out) == all(&stopped.out));
    assert!(all(&whole.out) != all(&other.out));
}

#[test]
fn a_fixed_camera_stays_where_it_is() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let device = crate::common::device();
    let mut request = request(folder.path(), "out");
    request.protocol = Protocol::FixedCamera;
    request.samples = 20;
    record(&device, &request, |_| {}).unwrap();
    let reader = Reader::open(&request.out).unwrap();
    assert_eq!(reader.header().source.planned, Some(20));
    let first = &reader.samples()[0];
    let mut angles: Vec<Vec<f64>> = Vec::new();
    for sample in reader.samples() {
        assert!(sample.camera_from_base.is_some());
        assert_eq!(sample.camera_from_base, first.camera_from_base);
        for &[u, v] in sample.joints_px.as_ref().unwrap() {
            assert!((0.0..512.0).contains(&u) && (0.0..424.0).contains(&v));
        }
        angles.push(sample.joint_angles_rad.clone().unwrap());
    }
    // Joints stand on few steps each, in many combinations.
    for joint in 0..3 {
        let mut values: Vec<f64> = angles.iter().map(|a| a[joint]).collect();
        values.sort_by(f64::total_cmp);
        values.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
        assert!((2..20).contains(&values.len()), "joint {joint}: {values:?}");
    }
    angles.sort_by(|a, b| a.partial_cmp(b).unwrap());
    angles.dedup();
    assert_eq!(angles.len(), 20);

    // The photo behind the robot changes, and so does the light.
    let picture = |sample| reader.image(sample).unwrap();
    let (one, two) = (picture(first), picture(&reader.samples()[1]));
    let differ = one.pixels().zip(two.pixels()).filter(|(a, b)| a != b);
    let differ = differ.count();
    assert!(differ > 100_000, "{differ} pixels");

    let mut other = request.clone();
    other.out = folder.path().join("other");
    other.seed += 1;
    other.samples = 2;
    record(&device, &other, |_| {}).unwrap();
    let other = Reader::open(&other.out).unwrap();
    assert_ne!(other.samples()[0].camera_from_base, first.camera_from_base);
}

#[test]
fn several_cameras_see_the_same_robot_at_the_same_time() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let device = crate::common::device();
    for (protocol, name) in [
        (Protocol::FixedCamera, "fixed"),
        (Protocol::FreeCamera, "free"),
    ] {
        let mut request = request(folder.path(), name);
        request.protocol = protocol;
        request.cameras = 3;
        request.samples = 4;
        record(&device, &request, |_| {}).unwrap();
        let camera =
            |number: u64| Reader::open(&request.out.join(format!("camera_{number}"))).unwrap();
        let cameras: Vec<Reader> = (1..=3).map(camera).collect();
        let mut robots = 0;
        for (number, reader) in (1..).zip(&cameras) {
            let source = &reader.header().source;
            assert_eq!((source.camera, source.cameras), (Some(number), Some(3)));
            assert_eq!(reader.samples().len(), 4);
            for (sample, first) in reader.samples().iter().zip(cameras[0].samples()) {
                reader.mask(sample).unwrap();
                assert_eq!(sample.joint_angles_rad, first.joint_angles_rad);
                robots += u64::from(sample.coverage > 0.0);
                if number > 1 && sample.joint_angles_rad.is_some() {
                    assert_ne!(sample.camera_from_base, first.camera_from_base);
                }
                // The same joints in the base frame, each camera's through its own pose.
                let in_base = |sample: &Sample| -> Vec<DVec3> {
                    let matrix = sample.camera_from_base.unwrap_or_default();
                    let camera =
                        DAffine3::from_mat4(glam::DMat4::from_cols_array(&matrix).transpose());
                    let joints = sample.joints_m.iter().flatten();
                    joints
                        .map(|&j| camera.inverse().transform_point3(j.into()))
                        .collect()
                };
                for (a, b) in in_base(sample).iter().zip(in_base(first)) {
                    assert!(a.distance(b) < 1e-9);
                }
            }
        }
        assert!(robots >= 6, "{robots} robots are seen");

        // One that was cut off goes on, whichever camera is behind.
        let lines = request.out.join("camera_2/samples.jsonl");
        let whole = fs::read_to_string(&lines).unwrap();
        let picture = fs::read(request.out.join("camera_2/image/000003.jpg")).unwrap();
        let cut = whole
            .lines()
            .take(3)
            .map(|line| format!("{line}\n"))
            .collect::<String>();
        fs::write(&lines, cut + "{\"id\":3").unwrap();
        record(&device, &request, |_| {}).unwrap();
        assert_eq!(fs::read_to_string(&lines).unwrap(), whole);
        assert_eq!(
            fs::read(request.out.join("camera_2/image/000003.jpg")).unwrap(),
            picture
        );
        assert_eq!(camera(1).samples().len(), 4);

        request.cameras = 2;
        let error = record(&device, &request, |_| {}).unwrap_err().to_string();
        assert!(
            error.contains("source.cameras: expected 2, found 3"),
            "{error}"
        );
    }
}

#[test]
fn a_fixed_camera_needs_poses_it_can_see() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let text = fs::read_to_string(arm_urdf()).unwrap();
    // An arm whose joints cannot turn has one pose.
    let stiff = ["-3.1", "-1.6", "-3"].iter().zip(["3.1", "1.6", "3"]);
    let stiff = stiff.fold(text.clone(), |text, (lower, upper)| {
        let range = format!("lower=\"{lower}\" upper=\"{upper}\"");
        assert!(text.contains(&range));
        text.replace(&range, "lower=\"0.1\" upper=\"0.1\"")
    });
    let mut request = request(folder.path(), "out");
    request.urdf = folder.path().join("arm.urdf");
    request.protocol = Protocol::FixedCamera;
    request.samples = 2;
    fs::write(&request.urdf, stiff).unwrap();
    let error = record(&crate::common::device(), &request, |_| {}).unwrap_err();
    assert!(
        matches!(error, RecorderError::TooFewPoses { wanted: 2, .. }),
        "{error}"
    );
    assert!(!request.out.exists());
    fs::write(&request.urdf, text).unwrap();
    record(&crate::common::device(), &request, |_| {}).unwrap();
}

#[test]
fn the_papers_recordings_are_nine() {
    let urdfs = ["a", "b", "c"].map(PathBuf::from);
    let requests = |seed| {
        paper_requests(
            urdfs.clone(),
            &[],
            Path::new("photos"),
            seed,
            Path::new("out"),
        )
    };
    let nine = requests(1);
    let found: Vec<(&str, &str, u64)> = nine
        .iter()
        .map(|r| (r.out.to_str().unwrap(), r.urdf.to_str().unwrap(), r.samples))
        .collect();
    let expected = [
        ("out/ur3_1", "a", 211),
        ("out/ur3_2", "a", 252),
        ("out/ur3_3", "a", 463),
        ("out/ur5_1", "b", 252),
        ("out/ur5_2", "b", 756),
        ("out/ur5_3", "b", 1512),
        ("out/ur10_1", "c", 112),
        ("out/ur10_2", "c", 278),
        ("out/ur10_3", "c", 514),
    ];
    assert_eq!(found, expected);
    assert!(nine.iter().all(|r| r.protocol == Protocol::FixedCamera));
    let folder_of = |r: &Request| r.out.file_name().unwrap().to_str().unwrap().to_owned();
    assert!(
        nine.iter()
            .all(|r| folder_of(r).starts_with(&format!("{}_", r.robot)))
    );
    let mut seeds: Vec<u64> = nine.iter().chain(&requests(2)).map(|r| r.seed).collect();
    seeds.sort_unstable();
    seeds.dedup();
    assert_eq!(seeds.len(), 18);
}

#[test]
fn another_recording_is_not_overwritten() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let device = crate::common::device();
    let mut request = request(folder.path(), "out");
    request.samples = 1;
    record(&device, &request, |_| {}).unwrap();
    let (header, lines) = ("recording.json", "samples.jsonl");
    let (header, lines) = (request.out.join(header), request.out.join(lines));
    let before = (fs::read(&header).unwrap(), fs::read(&lines).unwrap());
    let refused = |request: &Request, told: &str| {
        let error = record(&device, request, |_| {}).unwrap_err().to_string();
        assert!(error.contains(told), "{error}");
    };

    let mut other = request.clone();
    other.seed = 99;
    refused(
        &other,
        "recording.json: holds another recording (source.seed: expected 99, found 3)",
    );
    let mut other = request.clone();
    other.robot = "leg".into();
    refused(
        &other,
        "recording.json: holds another recording (robot: expected \"leg\", found \"arm\")",
    );
    let mut other = request.clone();
    other.protocol = Protocol::FixedCamera;
    refused(
        &other,
        "(source.protocol: expected \"fixed_camera\", found \"free_camera\")",
    );
    let mut other = request.clone();
    other.urdf = folder.path().join("renamed.urdf");
    fs::copy(arm_urdf(), &other.urdf).unwrap();
    refused(
        &other,
        "(source.urdf: expected \"renamed.urdf\", found \"arm.urdf\")",
    );
    let text = fs::read_to_string(arm_urdf()).unwrap();
    fs::write(&other.urdf, text.replace("\"elbow", "\"knee")).unwrap();
    refused(
        &other,
        "(joints: expected [\"pan\",\"lift\",\"knee\"], found [\"pan\",\"lift\",\"elbow\"])",
    );
    assert_eq!(
        (fs::read(&header).unwrap(), fs::read(&lines).unwrap()),
        before
    );

    let text = fs::read_to_string(&header).unwrap();
    fs::write(&header, text.replace("\"version\": 1", "\"version\": 2")).unwrap();
    refused(&request, "recording.json: version: expected 1, found 2");
    fs::write(&header, text).unwrap();

    fs::write(&lines, "{\"id\":7}\n").unwrap();
    refused(&request, "samples.jsonl:1: ");
    fs::remove_file(&header).unwrap();
    refused(
        &request,
        "samples.jsonl: part of something without a recording.json",
    );
    fs::remove_file(&lines).unwrap();
    refused(
        &request,
        "image: part of something without a recording.json",
    );
    assert!(request.out.join("image/000000.jpg").exists());
}

#[test]
fn two_writers_do_not_mix_their_samples() {
    let folder = TempDir::new().unwrap();
    backgrounds(folder.path());
    let mut request = request(folder.path(), "out");
    request.samples = 1;
    record(&crate::common::device(), &request, |_| {}).unwrap();
    let header = Reader::open(&request.out).unwrap().header().clone();
    let first = Writer::open(&request.out, &header).unwrap();
    let error = Writer::open(&request.out, &header).err().unwrap();
    assert!(error.to_string().contains("another process"), "{error}");
    drop(first);
    assert_eq!(Writer::open(&request.out, &header).unwrap().next(), 1);
}

#[test]
fn backgrounds_must_exist() {
    let folder = TempDir::new().unwrap();
    let device = crate::common::device();
    let request = request(folder.path(), "out");
    let error = record(&device, &request, |_| {}).unwrap_err();
    assert!(matches!(error, RecorderError::Io { .. }), "{error}");
    fs::create_dir(&request.backgrounds).unwrap();
    fs::write(request.backgrounds.join("a.jpg"), "no picture").unwrap();
    let error = record(&device, &request, |_| {}).unwrap_err();
    assert!(
        matches!(error, RecorderError::NoBackgrounds { .. }),
        "{error}"
    );
    assert!(!request.out.exists());
}
