//! `whereabot calibrate`: poses, what they are told by, and what it says to bad input.
#![cfg(feature = "cli")]

// Of what is known only the names are used here.
#[allow(dead_code)]
use std::fmt::Write;

use crate::known::{JOINTS, command};
use glam::{DAffine3, DMat4, DQuat, DVec3};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::robot::Robot;

/// The UR5's joints as `ur_description` has them, with meshes that are not there.
const URDF: [(&str, &str, &str, &str); 6] = [
    ("shoulder_pan", "0 0 0.089159", "0 0 0", "0 0 1"),
    ("shoulder_lift", "0 0.13585 0", "0 1.57079632679 0", "0 1 0"),
    ("elbow", "0 -0.1197 0.425", "0 0 0", "0 1 0"),
    ("wrist_1", "0 0 0.39225", "0 1.57079632679 0", "0 1 0"),
    ("wrist_2", "0 0.093 0", "0 0 0", "0 0 1"),
    ("wrist_3", "0 0 0.09465", "0 0 0", "0 1 0"),
];

struct Bench {
    folder: TempDir,
    robot: Robot,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mesh = "<visual><geometry><mesh filename='package://gone/a.stl'/></geometry></visual>";
        let mut text = format!("<robot name='ur5'><link name='base_link'>{mesh}</link>");
        let mut parent = "base_link".to_owned();
        for (name, xyz, rpy, axis) in URDF {
            let _ = write!(
                text,
                "<link name='{name}_link'/><joint name='{name}_joint' type='revolute'><parent link='{parent}'/>
                 <child link='{name}_link'/><origin xyz='{xyz}' rpy='{rpy}'/><axis xyz='{axis}'/>
                 <limit lower='-6.28' upper='6.28' effort='1' velocity='1'/></joint>"
            );
            parent = format!("{name}_link");
        }
        let urdf = folder.path().join("ur5.urdf");
        std::fs::write(&urdf, text + "</robot>").unwrap();
        let robot = Robot::kinematics(&urdf).unwrap();
        Self { folder, robot }
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.folder.path().join(name), text).unwrap();
    }

    /// stdout, stderr and the exit code.
    fn calibrate(&self, arguments: &[&str]) -> (String, String, i32) {
        let mut command = command(self.folder.path());
        let output = command
            .args(["calibrate", "--urdf", "ur5.urdf"])
            .args(arguments)
            .output()
            .unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        let code = output.status.code().unwrap();
        (text(output.stdout), text(output.stderr), code)
    }

    fn json(&self, arguments: &[&str]) -> Value {
        let (stdout, stderr, code) = self.calibrate(&[arguments, &["--json"]].concat());
        assert_eq!(code, 0, "{stderr}");
        serde_json::from_str(&stdout).unwrap()
    }

    fn refused(&self, arguments: &[&str]) -> String {
        let (stdout, stderr, code) = self.calibrate(arguments);
        assert_eq!((stdout.as_str(), code), ("", 1), "{stderr}");
        stderr
    }

    /// What a camera sees of the robot in these angles: the line's joints.
    fn joints(&self, camera_from_base: DAffine3, angles: &[f64]) -> Value {
        let joints = self.robot.joint_origins(&self.robot.link_poses(angles));
        let line = |(name, joint): (&str, DVec3)| json!({"name": name, "xyz_m": camera_from_base.transform_point3(joint).to_array(), "px": [0, 0]});
        JOINTS.into_iter().zip(joints).map(line).collect()
    }
}

/// Smooth, so that what lies between rows is known to a tenth of a millimetre.
fn angles(time: f64) -> [f64; 6] {
    [0.4, -1.2, 1.3, -0.9, -1.4, 0.7].map(|middle| middle + (0.7 * time + 5.0 * middle).sin())
}

fn camera_from_base(azimuth: f64) -> DAffine3 {
    let turn = DQuat::from_rotation_x(1.9) * DQuat::from_rotation_z(azimuth);
    DAffine3::from_rotation_translation(turn, DVec3::new(0.1, 0.2, 1.8))
}

/// Lines as `watch` prints them, three a second.
fn watched(bench: &Bench, camera: &str, place: DAffine3) -> String {
    let mut lines =
        json!({"schema": 1, "type": "event", "event": "live", "camera": camera, "at_s": 99.0})
            .to_string()
            + "\n";
    for n in 0..40 {
        let time = f64::from(n) / 3.0;
        let mut line = json!({"schema": 1, "type": "result", "camera": camera, "robot": "ur5", "frame_number": n,
            "acquired_s": 100.0 + time, "status": "found", "frame": "camera_optical",
            "joints": bench.joints(place, &angles(time))});
        if n % 5 == 1 {
            // Seen in a mirror.
            for joint in line["joints"].as_array_mut().unwrap() {
                joint["xyz_m"][0] = json!(0.8 - joint["xyz_m"][0].as_f64().unwrap());
            }
        }
        if n == 7 {
            line = json!({"schema": 1, "type": "result", "camera": camera, "acquired_s": 100.0 + time, "status": "not_found"});
        }
        lines += &format!("{line}\n");
    }
    lines
}

/// A controller's log, a hundred rows a second.
fn table(header: &str, separator: &str) -> String {
    let mut text = header.to_owned() + "\n";
    for n in 0..1300 {
        let time = 0.01 * f64::from(n) + 0.003;
        let cells = std::iter::once(100.0 + time).chain(angles(time));
        let cells: Vec<String> = cells.map(|v| format!("{v:.6}")).collect();
        text += &(cells.join(separator) + "\n");
    }
    text
}

/// Metres and radians from the truth.
fn off(report: &Value, truth: DAffine3) -> (f64, f64) {
    let numbers: Vec<f64> = serde_json::from_value(report["camera_from_base"].clone()).unwrap();
    let matrix = DMat4::from_cols_slice(&numbers).transpose();
    let found = DAffine3::from_mat4(matrix).inverse();
    let truth = truth.inverse();
    let [x, y, z] = serde_json::from_value::<[f64; 3]>(report["translation_m"].clone()).unwrap();
    assert!(found.translation.distance(DVec3::new(x, y, z)) < 1e-9);
    let turn: [f64; 4] = serde_json::from_value(report["rotation_xyzw"].clone()).unwrap();
    let turn = DQuat::from_array(turn);
    (
        found.translation.distance(truth.translation),
        turn.angle_between(DQuat::from_mat3(&truth.matrix3)),
    )
}

#[test]
fn cameras_are_found_by_time() {
    let bench = Bench::new();
    let places = [0.3, 2.0].map(camera_from_base);
    bench.write(
        "lines",
        &(watched(&bench, "left", places[0]) + &watched(&bench, "right", places[1])),
    );
    let header = "timestamp,shoulder_pan_joint,shoulder_lift_joint,elbow_joint,wrist_1_joint,wrist_2_joint,wrist_3_joint";
    bench.write("angles.csv", &table(header, ","));
    let rtde = "timestamp actual_q_0 actual_q_1 actual_q_2 actual_q_3 actual_q_4 actual_q_5";
    bench.write("rtde.csv", &table(rtde, " "));
    for file in ["angles.csv", "rtde.csv"] {
        let (stdout, stderr, code) =
            bench.calibrate(&["lines", "--angles", file, "--moving", "--json"]);
        assert_eq!((code, stderr.as_str()), (0, ""));
        let reports: Vec<Value> = stdout
            .lines()
            .map(|l| serde_json::from_str(l).unwrap())
            .collect();
        assert_eq!(reports.len(), 2);
        for (report, (name, place)) in reports.iter().zip(["left", "right"].iter().zip(places)) {
            assert_eq!(report["camera"], *name);
            assert_eq!(
                (&report["frame_id"], &report["matched_by"]),
                (&json!("base_link"), &json!("time"))
            );
            assert_eq!(
                (&report["frames"], &report["frames_not_found"]),
                (&json!(40), &json!(1))
            );
            // The first frame is before the first row, the last one behind the last.
            assert_eq!(
                (&report["frames_used"], &report["frames_unmatched"]),
                (&json!(37), &json!(2))
            );
            let (metres, radians) = off(report, place);
            assert!(metres < 5e-4 && radians < 5e-4, "{metres} {radians}");
            // The other camera is somewhere else.
            let (metres, radians) = off(report, camera_from_base(1.0));
            assert!(metres > 0.1 && radians > 0.5);
            let share = report["inlier_share"].as_f64().unwrap();
            assert!((0.7..0.85).contains(&share), "{share}");
            assert!(report["translation_sigma_m"].as_f64().unwrap() < 2e-3);
            assert!(report["residuals"][5]["rms_m"].as_f64().unwrap() < 1e-3);
            assert!(report["residual_scale"].as_f64().unwrap() < 0.1);
            assert_eq!(report["doubts"], json!([]));
        }
    }
    // A clock that is half a second off is seen in what is left.
    let late = table(header, ",")
        .replace("\n10", "\n20")
        .replace("\n11", "\n21");
    bench.write("late.csv", &late);
    let stderr = bench.refused(&["lines", "--angles", "late.csv"]);
    assert!(stderr.contains("left: error: from 0 of 40 frames (1 without the robot, 39 without joint angles by time, 0 of a moving robot)"), "{stderr}");
    assert!(
        stderr.contains(
            "angles of 200.0 to 213.0 s: not one clock: expected at least 3 points, found 0"
        ),
        "{stderr}"
    );
}

#[test]
fn angles_and_urdf_of_something_else_are_doubted() {
    let bench = Bench::new();
    let place = camera_from_base(0.5);
    let (mut lines, mut rows) = (String::new(), Vec::new());
    for n in 0..12 {
        let angles = angles(2.0 * f64::from(n));
        let line = json!({"schema": 1, "status": "found", "frame": "camera_optical", "joints": bench.joints(place, &angles)});
        lines += &format!("{line}\n");
        rows.push(angles.map(|angle| angle.to_string()).join(","));
    }
    bench.write("lines.jsonl", &lines);
    let doubts = |rows: &[String], lines: &str| {
        bench.write(
            "angles.csv",
            &format!("{}\n{}", JOINTS.join(","), rows.join("\n")),
        );
        let (stdout, stderr, code) = bench.calibrate(&[lines, "--angles", "angles.csv", "--json"]);
        assert_eq!(code, 0, "{stderr}");
        let report: Value = serde_json::from_str(&stdout).unwrap();
        let doubts: Vec<String> = serde_json::from_value(report["doubts"].clone()).unwrap();
        assert!(
            doubts.iter().all(|doubt| stderr.contains(doubt)),
            "{stderr}"
        );
        doubts.join("\n")
    };
    assert_eq!(doubts(&rows, "lines.jsonl"), "");
    let mut shifted = rows.clone();
    shifted.rotate_left(1);
    let told = doubts(&shifted, "lines.jsonl");
    assert!(
        told.contains("do the joint angles and the URDF belong"),
        "{told}"
    );
    // A smaller arm's joints.
    let small: String = lines
        .lines()
        .map(|line| {
            let mut line: Value = serde_json::from_str(line).unwrap();
            for joint in line["joints"].as_array_mut().unwrap() {
                for x in joint["xyz_m"].as_array_mut().unwrap() {
                    *x = json!(0.6 * x.as_f64().unwrap());
                }
            }
            format!("{line}\n")
        })
        .collect();
    bench.write("small.jsonl", &small);
    let told = doubts(&rows, "small.jsonl");
    assert!(
        told.contains(
            "from shoulder_lift to elbow it is 0.26 m in these lines, 0.44 m in the URDF"
        ),
        "{told}"
    );
}

#[test]
fn frames_are_matched_by_file_name_and_by_order() {
    let bench = Bench::new();
    let place = camera_from_base(0.5);
    let (mut lines, mut samples, mut table) =
        (String::new(), String::new(), JOINTS.join(";") + "\n");
    for n in 0..12 {
        let (name, angles) = (format!("{n:06}.jpg"), angles(f64::from(n)));
        let line = json!({"schema": 1, "file": format!("somewhere/image/{name}"), "status": "found",
            "frame": "camera_optical", "joints": bench.joints(place, &angles)});
        lines += &format!("{line}\n");
        let sample = json!({"id": n, "image": format!("image/{name}"), "coverage": 0.1, "joint_angles_rad": angles});
        // The last one first: names tell, not the order.
        samples = format!("{sample}\n{samples}");
        let cells: Vec<String> = angles.iter().map(f64::to_string).collect();
        table += &(cells.join(";") + "\n");
    }
    bench.write("lines.jsonl", &lines);
    bench.write("samples.jsonl", &samples);
    bench.write("angles.csv", &table);
    for (file, by) in [("samples.jsonl", "file"), ("angles.csv", "order")] {
        let report = bench.json(&["lines.jsonl", "--angles", file]);
        assert_eq!(
            (&report["camera"], &report["matched_by"]),
            (&json!("lines"), &json!(by))
        );
        let (metres, radians) = off(&report, place);
        assert!(metres < 1e-6 && radians < 1e-6, "{metres} {radians}");
    }
    bench.write("twice.jsonl", &(samples.clone() + &samples));
    let stderr = bench.refused(&["lines.jsonl", "--angles", "twice.jsonl"]);
    assert!(stderr.contains("found 000011.jpg twice"), "{stderr}");
    // By order the last one first is wrong.
    let wrong: String = samples.replace("\"image\"", "\"picture\"");
    bench.write("wrong.jsonl", &wrong);
    let (stdout, ..) = bench.calibrate(&["lines.jsonl", "--angles", "wrong.jsonl", "--json"]);
    assert!(stdout.is_empty() || off(&serde_json::from_str(&stdout).unwrap(), place).0 > 0.05);
    bench.write("short.csv", table.trim_end().rsplit_once('\n').unwrap().0);
    let stderr = bench.refused(&["lines.jsonl", "--angles", "short.csv"]);
    assert!(stderr.contains("found 11 for 12 frames"), "{stderr}");
    // ROS's message, and a key a joint.
    let named = |n: i32| {
        let names = JOINTS.map(|name| format!("{name}_joint"));
        let [a, b, c, d, e, f] = angles(f64::from(n));
        json!({"header": {"stamp": {"sec": n, "nanosec": 0}}, "name": [names[5], names[0], names[1], names[2], names[3], names[4]],
            "position": [f, a, b, c, d, e]}).to_string()
    };
    let keys = |n: i32| {
        let pairs = JOINTS.into_iter().zip(angles(f64::from(n)));
        Value::from_iter(pairs.map(|(k, v)| (k.to_owned(), json!(v)))).to_string()
    };
    for line in [&named as &dyn Fn(i32) -> String, &keys] {
        let lines: Vec<String> = (0..12).map(line).collect();
        bench.write("ros.jsonl", &lines.join("\n"));
        let (metres, _) = off(
            &bench.json(&["lines.jsonl", "--angles", "ros.jsonl"]),
            place,
        );
        assert!(metres < 1e-6, "{metres}");
    }
}

#[test]
fn a_camera_that_is_late_is_found_by_poses_in_which_the_robot_stands() {
    let bench = Bench::new();
    let place = camera_from_base(0.5);
    // Two seconds in a pose, one on the way to the next.
    let pose = |time: f64| {
        let part = (time % 3.0 - 2.0).max(0.0);
        let [from, to] = [0.0, 1.0].map(|next| angles(4.0 * ((time / 3.0).floor() + next)));
        let between = |joint: usize| from[joint] + part * (to[joint] - from[joint]);
        std::array::from_fn::<f64, 6, _>(between)
    };
    let mut rows = format!("time_s,{}\n", JOINTS.join(","));
    for n in 0..6000 {
        let time = 0.01 * f64::from(n);
        let cells = std::iter::once(time).chain(pose(time));
        let cells: Vec<String> = cells.map(|v| format!("{v:.6}")).collect();
        rows += &(cells.join(",") + "\n");
    }
    bench.write("angles.csv", &rows);
    let mut lines = String::new();
    for n in 4..150 {
        let taken = 0.4 * f64::from(n);
        let line = json!({"schema": 1, "type": "result", "camera": "late", "acquired_s": taken + 0.6, "status": "found",
            "frame": "camera_optical", "joints": bench.joints(place, &pose(taken))});
        lines += &format!("{line}\n");
    }
    bench.write("lines", &lines);
    let report = bench.json(&["lines", "--angles", "angles.csv"]);
    let (metres, radians) = off(&report, place);
    assert!(metres < 1e-4 && radians < 1e-4, "{metres} {radians}");
    let count = |key: &str| report[key].as_u64().unwrap();
    assert!(count("frames_used") > 40 && count("frames_moving") > 80);
    assert!(count("poses") > 10);
    // One that never stands tells nothing, and why is said.
    let late = |line: &str| {
        let mut line: Value = serde_json::from_str(line).unwrap();
        if let Some(time) = line["acquired_s"].as_f64() {
            line["acquired_s"] = json!(time + 0.6);
        }
        format!("{line}\n")
    };
    let moving: String = watched(&bench, "left", place).lines().map(late).collect();
    bench.write("lines", &moving);
    bench.write(
        "angles.csv",
        &table(&format!("time_s,{}", JOINTS.join(",")), ","),
    );
    let stderr = bench.refused(&["lines", "--angles", "angles.csv"]);
    assert!(
        stderr.contains("of a moving robot): let it stand still"),
        "{stderr}"
    );
    // Negative control: taken all the same, it is somewhere else.
    let report = bench.json(&["lines", "--angles", "angles.csv", "--moving"]);
    assert!(off(&report, place).0 > 0.02, "{report}");
}

#[test]
fn few_poses_are_told() {
    let bench = Bench::new();
    let all = watched(&bench, "left", camera_from_base(0.3));
    // Neither the mirrored ones nor the one without the robot.
    let few: Vec<&str> = all.lines().skip(3).take(4).collect();
    bench.write("lines", &few.join("\n"));
    let header = format!("time_s,{}", JOINTS.join(","));
    bench.write("angles.csv", &table(&header, ","));
    let (text, stderr, _) = bench.calibrate(&["lines", "--angles", "angles.csv", "--moving"]);
    assert!(text.contains("left: its optical frame"), "{text}");
    assert!(stderr.contains("left: fewer than 5 poses"), "{stderr}");
}

#[test]
fn a_pose_is_told_in_the_forms_of_ros() {
    let bench = Bench::new();
    bench.write("lines", &watched(&bench, "left cam", camera_from_base(0.3)));
    let header = format!("time_s,{}", JOINTS.join(","));
    bench.write("angles.csv", &table(&header, ","));
    let run = |form: &[&str]| {
        let (stdout, stderr, code) =
            bench.calibrate(&[&["lines", "--angles", "angles.csv", "--moving"], form].concat());
        assert_eq!((code, stderr.as_str()), (0, ""));
        stdout
    };
    let report: Value = serde_json::from_str(&run(&["--json"])).unwrap();
    let [x, y, z]: [f64; 3] = serde_json::from_value(report["translation_m"].clone()).unwrap();
    let arguments = format!("--x {x:.6} --y {y:.6} --z {z:.6} --qx");
    let text = run(&[]);
    assert!(
        text.contains(&format!(
            "ros2 run tf2_ros static_transform_publisher {arguments}"
        )),
        "{text}"
    );
    assert!(
        text.contains("--frame-id base_link --child-frame-id left_cam_optical"),
        "{text}"
    );
    assert!(
        text.contains("+-") && text.contains("degrees (one standard deviation)"),
        "{text}"
    );

    let yaml: Value = serde_saphyr::from_str(&run(&["--yaml"])).unwrap();
    let transform = &yaml["transforms"][0];
    assert_eq!(transform["header"]["frame_id"], "base_link");
    assert_eq!(transform["child_frame_id"], "left_cam_optical");
    assert!((transform["transform"]["translation"]["y"].as_f64().unwrap() - y).abs() < 1e-6);
    let launch: Value = serde_saphyr::from_str(&run(&["--launch"])).unwrap();
    let node = &launch["launch"][0]["node"];
    assert_eq!(node["name"], "left_cam_static_transform");
    assert_eq!(
        (&node["pkg"], &node["exec"]),
        (&json!("tf2_ros"), &json!("static_transform_publisher"))
    );
    assert!(
        node["args"].as_str().unwrap().starts_with(&arguments),
        "{node}"
    );
    let (_, _, code) = bench.calibrate(&["lines", "--angles", "angles.csv", "--json", "--yaml"]);
    assert_eq!(code, 2);
}

#[test]
fn cameras_that_cannot_be_told_apart_are_refused() {
    let bench = Bench::new();
    let lines = |camera: &str| watched(&bench, camera, camera_from_base(0.5));
    let nameless = lines("left").replace("\"camera\":\"left\",", "");
    for folder in ["left", "right"] {
        std::fs::create_dir(bench.folder.path().join(folder)).unwrap();
        bench.write(&format!("{folder}/locate.jsonl"), &nameless);
    }
    bench.write("other.jsonl", &nameless);
    bench.write(
        "angles.csv",
        &table(&format!("time_s,{}", JOINTS.join(",")), ","),
    );
    let angles = ["--angles", "angles.csv", "--moving"];
    let stderr =
        bench.refused(&[&["left/locate.jsonl", "right/locate.jsonl"], &angles[..]].concat());
    assert!(
        stderr.contains("camera locate in one file, found some in left/locate.jsonl: rename one"),
        "{stderr}"
    );
    // Negative control: another name is another camera.
    let (stdout, stderr, code) =
        bench.calibrate(&[&["left/locate.jsonl", "other.jsonl"], &angles[..]].concat());
    assert_eq!(code, 0, "{stderr}");
    assert!(
        stdout.contains("locate") && stdout.contains("other"),
        "{stdout}"
    );

    bench.write("names.jsonl", &(lines("left-1") + &lines("left_1")));
    let stderr = bench.refused(&[&["names.jsonl"], &angles[..]].concat());
    assert!(
        stderr.contains("found left-1 and left_1, both left_1_optical"),
        "{stderr}"
    );
}

#[test]
fn bad_input_is_told_with_file_and_line() {
    let bench = Bench::new();
    let good = watched(&bench, "left", camera_from_base(0.3));
    let header = format!("time_s,{}", JOINTS.join(","));
    let rows = table(&header, ",");
    bench.write("angles.csv", &rows);
    bench.write("lines", &good);
    for (lines, told) in [
        ("{\"status\": \"found\"\n", "bad:42: "),
        (
            "{\"status\": \"perhaps\"}\n",
            "bad:42: status: expected found, not_found, invalid or error, found perhaps",
        ),
        (
            "{\"file\": \"a.jpg\"}\n",
            "bad:42: status: expected found, not_found, invalid or error, found none",
        ),
        ("{\"status\": \"found\"}\n", "bad:42: joints: expected"),
        (
            "{\"status\": \"found\", \"frame\": \"base\", \"joints\": [{\"name\": \"elbow\", \"xyz_m\": [0, 0, 1]}]}\n",
            "bad:42: frame: expected camera_optical, found base",
        ),
        (
            "{\"status\": \"found\", \"camera\": \"left\", \"acquired_s\": 105, \"frame\": \"camera_optical\", \"joints\": [{\"name\": \"knee\", \"xyz_m\": [0, 0, 1]}]}\n",
            "bad:42: joints: expected those of the URDF (shoulder_pan, shoulder_lift, elbow, wrist_1, wrist_2, wrist_3), found knee",
        ),
    ] {
        bench.write("bad", &(good.clone() + lines));
        let stderr = bench.refused(&["bad", "--angles", "angles.csv", "--moving"]);
        assert!(stderr.contains(told), "{stderr}");
    }
    let rows: Vec<&str> = rows.lines().collect();
    for (row, told) in [
        (
            "101,0,0,0,x,0,0",
            "bad.csv:3: wrist_1: expected a number, found \"x\"",
        ),
        ("101,0,0,0,0,0", "bad.csv:3: "),
        (
            "101,0,-90,0,0,0,0",
            "bad.csv:3: shoulder_lift: expected radians, -6.38 to 6.38, found -90",
        ),
        (
            "nan,0,0,0,0,0,0",
            "bad.csv:3: time_s: expected a number, found \"nan\"",
        ),
    ] {
        bench.write("bad.csv", &[rows[0], rows[1], row, rows[2]].join("\n"));
        let stderr = bench.refused(&["lines", "--angles", "bad.csv"]);
        assert!(stderr.contains(told), "{stderr}");
    }
    for (text, told) in [
        (
            "time_s,shoulder_pan\n1,2\n",
            "bad.csv:1: expected a column shoulder_lift (or shoulder_lift_joint, actual_q_1)",
        ),
        ("", "bad.csv:1: expected a column"),
        (
            "{\"elbow\": 1}\n",
            "bad.csv:1: shoulder_pan: expected its angle",
        ),
        (
            "{\"joint_angles_rad\": [0, 0, 0, 0, 0, 0]}\n{",
            "bad.csv:2: ",
        ),
    ] {
        bench.write("bad.csv", text);
        let stderr = bench.refused(&["lines", "--angles", "bad.csv"]);
        assert!(stderr.contains(told), "{stderr}");
    }
    bench.write("events", good.lines().next().unwrap());
    let stderr = bench.refused(&["events", "--angles", "angles.csv"]);
    assert!(
        stderr.contains("expected lines of frames, found none in events"),
        "{stderr}"
    );
    let stderr = bench.refused(&["gone", "--angles", "angles.csv"]);
    assert!(stderr.contains("gone: "), "{stderr}");
}
