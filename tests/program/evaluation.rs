//! How good models are: measures with known answers, and `whereabot evaluate` from end to end.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};

use crate::common::{description, device, difference, model_file, noise};
use crate::known::{JOINTS, XYZ, command};
use image::{GrayImage, Luma, Rgb, RgbImage, RgbaImage};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::camera::{Camera, Distortion};
use whereabot::cascade::{LocateError, Locator, Mask, Output, Status};
use whereabot::draw::{self, BarChart, BarGroup, Line, LineChart, SheetRow};
use whereabot::evaluation::{
    EvaluationError, Figures, JointErrors, JointScore, MaskCounts, Score, Summary, distances_cm,
    distances_px, network_mask, read_annotations,
};
use whereabot::gpu::Precision;
use whereabot::network::Model;
use whereabot::recorder::{HEIGHT, INTRINSICS, WIDTH};

// --- measures ----------------------------------------------------------------------------------------

#[test]
fn masks_are_counted() {
    let counts: MaskCounts = [(true, true), (true, false), (false, true), (false, false)]
        .into_iter()
        .zip([3_usize, 1, 2, 4])
        .flat_map(|(pair, times)| std::iter::repeat_n(pair, times))
        .collect();
    assert_eq!(counts.accuracy(), Some(0.7));
    assert_eq!(counts.iou(), Some(0.5));
    assert_eq!(counts.precision(), Some(0.6));
    assert_eq!(counts.recall(), Some(0.75));
    assert_eq!(counts.coverage(), Some(0.4));
    // Of nothing there is no share, rather than 0 or 1.
    let nothing = MaskCounts::default();
    assert_eq!(nothing.accuracy(), None);
    let background: MaskCounts = [(false, false)].into_iter().collect();
    assert_eq!(background.accuracy(), Some(1.0));
    assert_eq!(
        (
            background.iou(),
            background.precision(),
            background.recall()
        ),
        (None, None, None)
    );
}

#[test]
fn values_are_summed_up() {
    let summary = Summary::of((0..=100).rev().map(f64::from)).unwrap();
    assert_eq!(summary.count, 101);
    assert_eq!((summary.mean, summary.median), (50.0, 50.0));
    assert!((summary.p95 - 95.0).abs() < 1e-9);
    // Between 1 and 4.
    let summary = Summary::of([4.0, 1.0]).unwrap();
    assert_eq!((summary.mean, summary.median), (2.5, 2.5));
    assert!((summary.p95 - 3.85).abs() < 1e-9);
    assert_eq!(Summary::of([]), None);
}

#[test]
fn distances_are_euclidean_and_finite() {
    let truth = [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]];
    let estimate = [[0.03, 0.04, 1.0], [1.0, 1.0, 0.5]];
    let found = distances_cm(&truth, &estimate).unwrap();
    assert!((found[0] - 5.0).abs() < 1e-9 && (found[1] - 50.0).abs() < 1e-9);
    assert_eq!(distances_px(&[[1.0, 2.0]], &[[4.0, 6.0]]), Ok(vec![5.0]));
    for bad in [f64::NAN, f64::INFINITY] {
        assert!(distances_cm(&truth, &[[bad, 0.0, 0.0], [0.0; 3]]).is_err());
    }
}

fn score(id: u64, pairs: &[(bool, bool)], status: Status, joints: Option<[f64; 2]>) -> Score {
    let errors = |cm: f64| JointErrors {
        cm: vec![cm, 3.0 * cm],
        px: vec![cm; 2],
    };
    Score {
        id,
        mask: pairs.iter().copied().collect(),
        status,
        joints: joints.map(|[separate, whole]| JointScore {
            true_mask: errors(separate),
            estimated_mask: errors(whole),
        }),
    }
}

#[test]
fn scores_come_to_figures() {
    let names = ["base".to_owned(), "tip".to_owned()];
    let scores = [
        score(
            0,
            &[(true, true), (false, false)],
            Status::Found,
            Some([1.0, 2.0]),
        ),
        score(
            1,
            &[(true, false), (false, false)],
            Status::NotFound,
            Some([3.0, 6.0]),
        ),
        // Barely in view: its mask counts, its status does not.
        score(2, &[(true, true), (false, true)], Status::Found, None),
        score(3, &[(false, false), (false, false)], Status::NotFound, None),
        score(4, &[(false, true), (false, false)], Status::Found, None),
    ];
    let figures = Figures::new(&names, &scores);
    assert_eq!(
        (figures.images, figures.robots, figures.barely_in_view),
        (5, 3, 1)
    );
    assert_eq!(figures.mask.accuracy, Some(0.7));
    assert_eq!(figures.mask.iou, Some(0.5));
    assert_eq!(figures.mask.precision, Some(0.5));
    assert_eq!(figures.mask.recall, Some(2.0 / 3.0));
    let presence = figures.presence;
    assert_eq!((presence.robot.found, presence.robot.images()), (1, 2));
    assert_eq!(
        (presence.no_robot.not_found, presence.no_robot.images()),
        (1, 2)
    );
    // An image's error is the mean over its joints: 2 and 6; behind its own mask 4 and 12.
    let mean = |joints: &whereabot::evaluation::JointFigures| joints.error_cm.unwrap().mean;
    assert_eq!(mean(&figures.true_mask), 4.0);
    assert_eq!(mean(&figures.estimated_mask), 8.0);
    assert_eq!(mean(&figures.estimated_mask_found), 4.0);
    let tip = &figures.true_mask.joints[1];
    assert_eq!(
        (tip.name.as_str(), tip.error_cm.unwrap().mean),
        ("tip", 6.0)
    );
    assert_eq!(figures.true_mask.reprojection_px.unwrap().mean, 2.0);
    assert_eq!(figures.true_mask.behind_camera, 0);
}

fn recorders_camera() -> Camera {
    Camera {
        width: WIDTH,
        height: HEIGHT,
        intrinsics: INTRINSICS,
        distortion: Distortion::None,
    }
}

#[test]
fn a_true_mask_is_halved_as_the_trainer_does() {
    let model = Model::from_bytes(&model_file(&description(256, 212, 2), 1), "random").unwrap();
    let grain = noise((WIDTH * HEIGHT) as usize, 7);
    let at = |x: u32, y: u32| grain[(y * WIDTH + x) as usize] > 0.0;
    let mask = GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([if at(x, y) { 255 } else { 0 }]));
    let halved = |dx: u32| -> Vec<f32> {
        let block = |x: u32, y: u32| {
            let inside = |x: u32| (x + dx).min(WIDTH - 1);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)];
            let robot = four
                .iter()
                .filter(|(i, j)| at(inside(2 * x + i), 2 * y + j));
            if robot.count() >= 2 { 1.0 } else { 0.0 }
        };
        (0..212)
            .flat_map(|y| (0..256).map(move |x| (x, y)))
            .map(|(x, y)| block(x, y))
            .collect()
    };
    let seen = network_mask(&mask, &recorders_camera(), &model.description);
    assert_eq!((seen.width, seen.height), (256, 212));
    assert!(seen.probability == halved(0));
    // Negative control: a pixel to the side.
    assert!(seen.probability != halved(1));
}

#[test]
fn joints_follow_the_mask_that_is_given() {
    let mut description = description(48, 40, 5);
    description["presence"]["min_sure"] = 0.0.into();
    let model = Model::from_bytes(&model_file(&description, 4), "random").unwrap();
    let camera = Camera::from_hfov(61, 50, 1.2);
    let grain = noise(3 * 61 * 50, 3);
    let image = RgbaImage::from_fn(61, 50, |x, y| {
        let value = |c: usize| (127.0 + 120.0 * grain[((y * 61 + x) as usize) * 3 + c]) as u8;
        image::Rgba([value(0), value(1), value(2), 255])
    });
    let flat =
        |joints: &[[f64; 3]]| -> Vec<f32> { joints.iter().flatten().map(|&v| v as f32).collect() };
    let all = Output {
        mask: true,
        mask_only: false,
    };
    let mut answers = Vec::new();
    for mut locator in [
        Locator::on_gpu(device(), &model, Precision::F32).unwrap(),
        Locator::on_cpu(&model),
    ] {
        let estimate = locator.locate(&image, &camera, all).unwrap();
        let own = estimate.mask.unwrap();
        let joints: Vec<[f64; 3]> = estimate.joints.iter().map(|j| j.xyz_m).collect();
        assert_eq!(
            locator.joints_with_mask(&image, &camera, &own).unwrap(),
            joints
        );
        let half = Mask {
            probability: (0..48 * 40).map(|i| f32::from(i < 24 * 40)).collect(),
            ..own.clone()
        };
        let other = locator.joints_with_mask(&image, &camera, &half).unwrap();
        // Negative control: the joints do depend on the mask.
        assert!(difference(&flat(&other), &flat(&joints)).unwrap() > 1e-3);
        // And the next image gets its own mask again.
        let again = locator.locate(&image, &camera, all).unwrap();
        assert_eq!(again.mask.as_ref(), Some(&own));
        let short = Mask {
            probability: vec![0.0; 7],
            ..own
        };
        assert!(matches!(
            locator.joints_with_mask(&image, &camera, &short),
            Err(LocateError::Mask {
                expected: 1920,
                found: 7
            })
        ));
        answers.push(flat(&other));
    }
    // 0.1 mm
    assert!(difference(&answers[0], &answers[1]).unwrap() <= 1e-4);
}

// --- annotations -------------------------------------------------------------------------------------

fn annotation() -> Value {
    json!({
        "file": "photo.png", "width": 40, "height": 30, "robot": "cube", "scene": "room",
        "polygons": [[[10, 10], [19, 10], [19, 19], [10, 19]], [[15, 15], [24, 15], [24, 19], [15, 19]]],
        "holes": [[[11.6, 11.6], [13.4, 11.6], [13.4, 13.4], [11.6, 13.4]]],
        "ignore_polygons": [],
        "joints2d": {"shoulder_pan": [12.5, 13.5, 2], "elbow": [1, 1, 1], "wrist_1": [0, 0, 0]},
        "notes": "what is not known is left alone"
    })
}

#[test]
fn annotations_become_masks_and_marks() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("annotations.json");
    std::fs::write(&file, json!([annotation()]).to_string()).unwrap();
    let read = read_annotations(&file).unwrap();
    let mask = read[0].mask();
    assert_eq!(mask.dimensions(), (40, 30));
    let robot = |x: u32, y: u32| mask.get_pixel(x, y).0[0] > 0;
    // Inside both polygons, in one, in the hole, outside.
    assert!(robot(16, 16) && robot(11, 11) && robot(22, 17));
    assert!(!robot(12, 12) && !robot(9, 15) && !robot(22, 12) && !robot(26, 17));
    let count = mask.iter().filter(|&&v| v > 0).count();
    // 9 x 9 and 5 x 4 pixels, less a hole of 2 x 2; a border's pixels may fall to either side.
    assert!((90..=125).contains(&count), "{count}");
    let seen: Vec<_> = read[0]
        .joints
        .iter()
        .map(|mark| (mark.name.as_str(), mark.seen))
        .collect();
    assert_eq!(seen, [("elbow", false), ("shoulder_pan", true)]);
}

#[test]
fn bad_annotations_are_refused_with_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("annotations.json");
    let refused = |text: &str| -> String {
        std::fs::write(&file, text).unwrap();
        let error = read_annotations(&file).unwrap_err();
        assert!(
            matches!(error, EvaluationError::Annotation { .. }),
            "{error}"
        );
        error.to_string()
    };
    let broken = |key: &str, value: Value| {
        let mut entry = annotation();
        entry[key] = value;
        serde_json::to_string_pretty(&json!([annotation(), entry])).unwrap()
    };
    let short = json!([[[1, 1], [2, 2]]]);
    for (text, expected) in [
        (broken("polygons", json!([])), "expected at least one"),
        (
            broken("holes", short),
            "expected at least three points, found 2",
        ),
        (
            broken("width", json!(0)),
            "expected sides of 1 to 32768 pixels, found 0 x 30",
        ),
        (
            broken("joints2d", json!({"elbow": [1, 1, 3]})),
            "expected v = 0, 1 or 2, found 3",
        ),
        (broken("robot", Value::Null), "invalid type: null"),
        ("[{}".to_owned(), "missing field"),
        ("[]".to_owned(), "expected at least one photo"),
    ] {
        let message = refused(&text);
        assert!(message.contains(expected), "{message}");
        let line: usize = message.split(':').nth(1).unwrap().parse().unwrap();
        // What is wrong is in the second entry.
        let first = if text.len() > 10 {
            text.lines().count() / 2
        } else {
            1
        };
        assert!((first..=text.lines().count()).contains(&line), "{message}");
    }
    let missing = read_annotations(&folder.path().join("none.json")).unwrap_err();
    assert!(matches!(missing, EvaluationError::Io { .. }));
}

// --- pictures ----------------------------------------------------------------------------------------

fn coloured(image: &RgbImage) -> usize {
    let vivid = |p: &&Rgb<u8>| p.0.iter().max().unwrap() - p.0.iter().min().unwrap() > 60;
    image.pixels().filter(vivid).count()
}

fn dark(image: &RgbImage) -> usize {
    image
        .pixels()
        .filter(|p| p.0.iter().all(|&v| v < 100))
        .count()
}

#[test]
fn charts_and_sheets_are_drawn() {
    let chart = |points: Vec<[f64; 2]>| LineChart {
        title: "mask accuracy, %".into(),
        x: "training iteration".into(),
        lines: vec![Line {
            name: "ur5".into(),
            points,
        }],
    };
    let wave = chart(
        (0..20)
            .map(|i| [f64::from(i), f64::from(i).sin()])
            .collect(),
    );
    let image = draw::line_charts(&[wave, chart(vec![[5.0, 0.0]])]).unwrap();
    assert!(coloured(&image) > 500 && dark(&image) > 500);
    let bars = |bars: [f64; 2]| BarChart {
        title: "joint error, cm".into(),
        legend: vec!["true mask".into()],
        groups: vec![BarGroup {
            name: "elbow".into(),
            bars: vec![bars],
        }],
    };
    let area = |median: f64| coloured(&draw::bar_charts(&[bars([median, 9.0])]).unwrap());
    // A bar's area grows with its value.
    assert!(area(6.0) > 3 * area(1.5));
    let picture = RgbImage::from_pixel(40, 20, Rgb([200, 0, 0]));
    let row = SheetRow {
        caption: "a row".into(),
        pictures: vec![picture.clone(), picture],
    };
    let sheet = draw::sheet(&["image", "truth"], &[row]).unwrap();
    // Two pictures of 384 x 192.
    assert!(coloured(&sheet) >= 2 * 384 * 192);
    assert!(dark(&sheet) > 50);
}

// --- the command ---------------------------------------------------------------------------------------

struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let bench = Self { folder };
        bench.write("cube.safetensors", &known_model("cube", 0.0));
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// stdout, stderr and the exit code.
    fn evaluate(&self, arguments: &[&str]) -> (String, String, i32) {
        let mut command = command(self.folder.path());
        let output = command.arg("evaluate").args(arguments).output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        let code = output.status.code().unwrap();
        (text(output.stdout), text(output.stderr), code)
    }

    /// On the CPU, with the known model, as JSON.
    fn json(&self, arguments: &[&str]) -> Value {
        let known = [
            "--weights",
            "cube.safetensors",
            "--adapter",
            "cpu",
            "--json",
        ];
        let (stdout, stderr, code) = self.evaluate(&[&known, arguments].concat());
        assert_eq!(code, 0, "{stderr}");
        serde_json::from_str(&stdout).unwrap()
    }

    /// What is said to what cannot be judged: exit code and stderr.
    fn refused(&self, arguments: &[&str]) -> (i32, String) {
        let (stdout, stderr, code) = self.evaluate(&[arguments, &["--adapter", "cpu"]].concat());
        assert_eq!(stdout, "");
        (code, stderr)
    }

    /// A recording of 96 x 72 pixels with a right angle of view.
    fn recording(&self, name: &str, robot: &str, samples: &[Known]) {
        let folder = self.path(name);
        for inside in ["image", "mask"] {
            std::fs::create_dir_all(folder.join(inside)).unwrap();
        }
        let header = json!({
            "format": "whereabot-recording", "version": 1, "robot": robot, "joints": JOINTS,
            "width": 96, "height": 72, "frame": "camera_optical",
            "source": {"kind": "real", "generator": "a test"}
        });
        std::fs::write(folder.join("recording.json"), header.to_string()).unwrap();
        let mut lines = String::new();
        for (id, sample) in samples.iter().enumerate() {
            let pixels = |shown: fn(u32) -> bool| {
                GrayImage::from_fn(96, 72, |x, _| Luma([if shown(x) { 255 } else { 0 }]))
            };
            let (image, mask) = (pixels(sample.image), pixels(sample.mask));
            // Without loss, whatever the name says.
            let (image_file, mask_file) = (format!("image/{id}.png"), format!("mask/{id}.png"));
            image.save(folder.join(&image_file)).unwrap();
            mask.save(folder.join(&mask_file)).unwrap();
            let robot = mask.iter().filter(|&&v| v > 0).count();
            let mut line = json!({
                "id": id, "image": image_file, "mask": mask_file,
                "intrinsics": {"fx": 48.0, "fy": 48.0, "cx": 47.5, "cy": 35.5},
                "coverage": robot as f64 / (96.0 * 72.0)
            });
            if robot > 0 {
                let joints = XYZ.map(|[x, y, z]| [x, y, z + sample.nearer]);
                add_robot(&mut line, &joints, |[x, y, z]| {
                    [48.0 * x / z + 47.5, 48.0 * y / z + 35.5]
                });
            }
            lines += &format!("{line}\n");
        }
        std::fs::write(folder.join("samples.jsonl"), lines).unwrap();
    }
}

fn add_robot(line: &mut Value, joints: &[[f64; 3]], pixel: impl Fn([f64; 3]) -> [f64; 2]) {
    let identity: [f64; 16] = std::array::from_fn(|i| f64::from(u8::from(i % 5 == 0)));
    line["camera_from_base"] = json!(identity);
    line["joint_angles_rad"] = json!(vec![0.0; 6]);
    line["joints_m"] = json!(joints);
    line["joints_px"] = json!(joints.iter().map(|&j| pixel(j)).collect::<Vec<_>>());
}

/// A sample: which columns of its image are white, which are robot, and how much nearer than the truth
/// the model says that the robot is, in metres.
struct Known {
    image: fn(u32) -> bool,
    mask: fn(u32) -> bool,
    nearer: f64,
}

/// With the curves of a short training.
fn known_model(robot: &str, gain: f32) -> Vec<u8> {
    let card = json!({"curves": {
        "mask_accuracy": [[100, 0.8], [200, 0.95], [300, 0.97]],
        "true_mask_cm": [[100, 20.0], [200, 5.0]]}});
    crate::known::model(robot, XYZ, gain, &card)
}

fn left_half(x: u32) -> bool {
    x < 48
}

fn everywhere(_: u32) -> bool {
    true
}

fn nowhere(_: u32) -> bool {
    false
}

const SAMPLES: [Known; 4] = [
    // All right, but 3 cm too near.
    Known {
        image: left_half,
        mask: left_half,
        nearer: 0.03,
    },
    // Half of the robot is missed, and it is 5 cm too near.
    Known {
        image: left_half,
        mask: everywhere,
        nearer: 0.05,
    },
    // The robot is missed.
    Known {
        image: nowhere,
        mask: left_half,
        nearer: 0.04,
    },
    Known {
        image: nowhere,
        mask: nowhere,
        nearer: 0.0,
    },
];

fn close(a: &Value, b: f64, tolerance: f64) -> bool {
    (a.as_f64().unwrap() - b).abs() <= tolerance
}

#[test]
fn a_known_model_gets_the_figures_that_it_earns() {
    let bench = Bench::new();
    bench.recording("a", "cube", &SAMPLES);
    bench.recording("b", "cube", &SAMPLES[..1]);
    let report = bench.json(&["--recording", "a", "b", "--plots", "plots"]);
    assert_eq!(report["schema"], 1);
    let [a, b] = [&report["recordings"][0], &report["recordings"][1]];
    assert_eq!(
        (&a["recording"], &a["robot"], &a["samples"]),
        (&json!("a"), &json!("cube"), &json!(4))
    );
    assert_eq!((&a["source"], &a["split"]), (&json!("real"), &json!("all")));
    // 192 pixels an image; 0 + 96 + 96 + 0 are wrong.
    assert!(close(&a["mask"]["accuracy"], 0.75, 1e-9));
    assert!(close(&a["mask"]["iou"], 0.5, 1e-9));
    assert!(close(&a["mask"]["precision"], 1.0, 1e-9));
    assert!(close(&a["mask"]["recall"], 0.5, 1e-9));
    assert_eq!(
        a["presence"]["robot"],
        json!({"found": 2, "not_found": 1, "invalid": 0})
    );
    assert_eq!(
        a["presence"]["no_robot"],
        json!({"found": 0, "not_found": 1, "invalid": 0})
    );
    for (key, mean, count) in [
        ("true_mask", 4.0, 3),
        ("estimated_mask", 4.0, 3),
        ("estimated_mask_found", 4.0, 2),
    ] {
        let errors = &a[key];
        assert!(close(&errors["error_cm"]["mean"], mean, 1e-3), "{errors}");
        assert_eq!(errors["error_cm"]["count"], count);
        assert!(close(&errors["joints"][2]["error_cm"]["median"], 4.0, 1e-3));
        assert_eq!(errors["joints"][2]["name"], "elbow");
        assert!(errors["reprojection_px"]["mean"].as_f64().unwrap() > 0.01);
    }
    // Negative control: other samples, other figures.
    assert!(close(&b["mask"]["iou"], 1.0, 1e-9));
    assert!(close(&b["true_mask"]["error_cm"]["mean"], 3.0, 1e-3));
    let all = &report["robots"][0];
    assert_eq!((&all["recordings"], &all["images"]), (&json!(2), &json!(5)));
    assert!(close(&all["mask"]["accuracy"], 0.8, 1e-9));
    assert!(close(
        &all["estimated_mask"]["error_cm"]["mean"],
        3.75,
        1e-3
    ));

    // Two curves of three are in the card.
    let training = image::open(bench.path("plots/training.png"))
        .unwrap()
        .into_rgb8();
    assert_eq!(training.width(), 2 * 560);
    for name in [
        "joint_errors",
        "worst_masks_cube",
        "worst_joints_cube",
        "masks_cube",
    ] {
        let picture = image::open(bench.path(&format!("plots/{name}.png")))
            .unwrap()
            .into_rgb8();
        assert!(dark(&picture) > 100, "{name}");
    }
    // Nothing is overwritten.
    let again = [
        "--recording",
        "a",
        "--weights",
        "cube.safetensors",
        "--plots",
        "plots",
    ];
    let (code, message) = bench.refused(&again);
    assert_eq!(code, 1);
    assert!(message.contains("plots: holds files; --force"), "{message}");
    bench.json(&["--recording", "a", "--plots", "plots", "--force"]);
}

#[test]
fn a_split_is_judged_alone() {
    let bench = Bench::new();
    let samples: Vec<Known> = (0..12)
        .map(|_| Known {
            image: nowhere,
            mask: nowhere,
            nearer: 0.0,
        })
        .collect();
    bench.recording("a", "cube", &samples);
    let images = |split: &str| {
        let report = bench.json(&["--recording", "a", "--split", split]);
        report["robots"][0]["images"].as_u64().unwrap()
    };
    let (test, train, all) = (images("test"), images("train"), images("all"));
    assert!(test > 0 && train > test);
    assert_eq!((test + train, all), (12, 12));
}

#[test]
fn photos_are_judged_in_their_own_pixels() {
    let bench = Bench::new();
    for folder in ["photos", "empty"] {
        std::fs::create_dir(bench.path(folder)).unwrap();
    }
    // White where the robot is: columns 36 to 59 of 96, all rows; and another photo that is black.
    let white = |x: u32| (36..60).contains(&x);
    let photo = GrayImage::from_fn(96, 72, |x, _| Luma([if white(x) { 255 } else { 0 }]));
    photo.save(bench.path("photos/seen.png")).unwrap();
    photo.save(bench.path("empty/white.png")).unwrap();
    let black = GrayImage::new(96, 72);
    black.save(bench.path("photos/missed.png")).unwrap();
    black.save(bench.path("empty/black.png")).unwrap();
    // The model sees the joints through the assumed camera.
    let camera = Camera::assumed(96, 72);
    let [u, v] = camera.lens().project(XYZ[2]).unwrap();
    let entry = |file: &str, scene: &str, robot: &str| {
        json!({
            "file": file, "width": 96, "height": 72, "robot": robot, "scene": scene,
            "polygons": [[[35.5, -0.5], [83.5, -0.5], [83.5, 71.5], [35.5, 71.5]]],
            // The right half of the robot counts neither way.
            "ignore_polygons": [[[59.5, -0.5], [83.5, -0.5], [83.5, 71.5], [59.5, 71.5]]],
            "joints2d": {"elbow": [u + 3.0, v + 4.0, 2], "wrist_1": [u, v, 0]}
        })
    };
    let entries = json!([
        entry("seen.png", "hall", "cube"),
        entry("missed.png", "yard", "ball")
    ]);
    bench.write("annotations.json", entries.to_string().as_bytes());
    let arguments = [
        "--photos",
        "photos",
        "--annotations",
        "annotations.json",
        "--without",
        "empty",
    ];
    let report = bench.json(&[&arguments[..], &["--plots", "plots"]].concat());
    let photos = &report["photos"];
    assert_eq!(
        (&photos["photos"], &photos["found"]),
        (&json!(2), &json!(1))
    );
    let [seen, missed] = [&photos["each"][0], &photos["each"][1]];
    assert_eq!(
        (&seen["status"], &missed["status"]),
        (&json!("found"), &json!("not_found"))
    );
    // A pixel of the network is nine of the photo's wide: borders are off by some of these.
    assert!(
        close(&seen["iou"], 0.8, 0.2) && close(&missed["iou"], 0.0, 0.0),
        "{photos}"
    );
    assert!(close(&seen["seen_px"], 5.0, 1e-3));
    assert!(close(&photos["seen_share"]["median"], 5.0 / 120.0, 1e-4));
    assert_eq!(photos["scenes"].as_array().unwrap().len(), 2);
    assert_eq!(
        (&missed["robot"], &missed["weights_of"]),
        (&json!("ball"), &json!("cube"))
    );
    let without = &report["without"][0];
    assert_eq!(
        (&without["images"], &without["found_share"]),
        (&json!(2), &json!(0.5))
    );
    assert!(without["found"][0].as_str().unwrap().ends_with("white.png"));
    assert!(bench.path("plots/photos.png").is_file());

    let table = [
        &arguments[..],
        &["--weights", "cube.safetensors", "--adapter", "cpu"],
    ]
    .concat();
    let (table, _, code) = bench.evaluate(&table);
    assert_eq!(code, 0);
    for part in [
        "all photos",
        "scene hall",
        "the only ones given: missed.png (ball)",
        "1 of 2",
    ] {
        assert!(table.contains(part), "{part}: {table}");
    }
}

#[test]
fn what_cannot_be_judged_is_refused() {
    let bench = Bench::new();
    bench.recording("a", "cube", &SAMPLES[..1]);
    bench.recording("other", "ball", &SAMPLES[..1]);
    bench.write("same.safetensors", &known_model("cube", 0.0));
    // Sums beyond what single precision holds.
    bench.write("huge.safetensors", &known_model("cube", 3e38));
    bench.recording("cut", "cube", &SAMPLES[..1]);
    bench.write("cut/samples.jsonl", b"{\"id\": 0, \"image\"");
    bench.recording("lost", "cube", &SAMPLES[..1]);
    std::fs::remove_file(bench.path("lost/mask/0.png")).unwrap();
    bench.write(
        "annotations.json",
        json!([annotation()]).to_string().as_bytes(),
    );
    std::fs::create_dir(bench.path("photos")).unwrap();
    let weights = ["--weights", "cube.safetensors"];
    let photos = ["--photos", "photos", "--annotations", "annotations.json"];
    for (arguments, code, parts) in [
        (
            vec!["--recording", "other"],
            1,
            vec!["recording.json", "ball", "cube.safetensors"],
        ),
        (
            vec!["--recording", "a", "--weights", "same.safetensors"],
            1,
            vec!["cube.safetensors and same.safetensors"],
        ),
        (vec!["--recording", "cut"], 1, vec!["samples.jsonl:1"]),
        (
            vec!["--recording", "lost"],
            1,
            vec!["samples.jsonl:1", "mask/0.png"],
        ),
        (
            vec!["--recording", "nowhere"],
            1,
            vec!["nowhere/recording.json"],
        ),
        (
            photos.to_vec(),
            1,
            vec!["photos/photo.png", "cannot be read"],
        ),
        (vec!["--without", "nowhere"], 1, vec!["nowhere"]),
        (vec!["--photos", "photos"], 2, vec!["--annotations"]),
        (vec!["--recording", "a", "--split", "most"], 2, vec!["most"]),
        (vec![], 2, vec!["--recording"]),
    ] {
        let (found, message) = bench.refused(&[&weights[..], &arguments].concat());
        assert_eq!(found, code, "{message}");
        for part in parts {
            assert!(message.contains(part), "{part}: {message}");
        }
    }
    let (code, message) = bench.refused(&["--recording", "a", "--weights", "huge.safetensors"]);
    assert_eq!(code, 1);
    assert!(message.contains("samples.jsonl:1"), "{message}");
    assert!(message.contains("expected finite numbers"), "{message}");
    assert_eq!(bench.refused(&["--recording", "a"]).0, 2);
}

// --- the shipped weights -------------------------------------------------------------------------------

/// A recording of two of the bundled images with a robot, and one without.
fn bundled(bench: &Bench) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = bench.path("bundled");
    for inside in ["image", "mask"] {
        std::fs::create_dir_all(folder.join(inside)).unwrap();
    }
    let header = json!({
        "format": "whereabot-recording", "version": 1, "robot": "ur5", "joints": JOINTS,
        "width": WIDTH, "height": HEIGHT, "frame": "camera_optical",
        "source": {"kind": "synthetic", "generator": "whereabot", "seed": 1, "urdf": "ur5.urdf",
                   "protocol": "free_camera"}
    });
    std::fs::write(folder.join("recording.json"), header.to_string()).unwrap();
    let truth = std::fs::read(root.join("tests/data/samples/truth.json")).unwrap();
    let truth: Value = serde_json::from_slice(&truth).unwrap();
    let mut lines = String::new();
    for (id, name) in ["ur5_1", "ur5_4", "no_robot"].into_iter().enumerate() {
        let image = format!("image/{name}.jpg");
        std::fs::copy(
            root.join(format!("examples/images/{name}.jpg")),
            folder.join(&image),
        )
        .unwrap();
        let mask = format!("mask/{name}.png");
        let mut line = json!({"id": id, "image": image, "mask": mask, "intrinsics": INTRINSICS});
        if truth[name].is_null() {
            GrayImage::new(WIDTH, HEIGHT)
                .save(folder.join(&mask))
                .unwrap();
            line["coverage"] = 0.0.into();
        } else {
            let from = root.join(format!("tests/data/samples/{name}.mask.png"));
            std::fs::copy(from, folder.join(&mask)).unwrap();
            line["coverage"] = truth[name]["coverage"].clone();
            let joints: Vec<[f64; 3]> =
                serde_json::from_value(truth[name]["joints_m"].clone()).unwrap();
            add_robot(&mut line, &joints, |joint| {
                INTRINSICS.project(joint).unwrap()
            });
        }
        lines += &format!("{line}\n");
    }
    std::fs::write(folder.join("samples.jsonl"), lines).unwrap();
}

#[test]
fn the_shipped_weights_are_judged_on_the_gpu() {
    let bench = Bench::new();
    bundled(&bench);
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("weights/ur5.safetensors");
    let weights = weights.to_str().unwrap();
    let arguments = ["--recording", "bundled", "--weights", weights];
    let (stdout, stderr, code) =
        bench.evaluate(&[&arguments[..], &["--json", "--plots", "plots"]].concat());
    assert_eq!(code, 0, "{stderr}");
    let report: Value = serde_json::from_str(&stdout).unwrap();
    let figures = &report["robots"][0];
    assert_eq!(
        (&figures["images"], &figures["robots"]),
        (&json!(3), &json!(2))
    );
    assert!(figures["mask"]["iou"].as_f64().unwrap() > 0.5, "{figures}");
    assert!(figures["mask"]["accuracy"].as_f64().unwrap() > 0.9);
    for key in ["true_mask", "estimated_mask"] {
        let error = figures[key]["error_cm"]["mean"].as_f64().unwrap();
        assert!((0.1..30.0).contains(&error), "{key}: {error}");
    }
    assert!(bench.path("plots/worst_masks_ur5.png").is_file());
    assert_eq!(report["models"][0]["kinematic_fit"], true);
    // On the same adapter: another one rounds otherwise, and a pixel of the mask may lie on the other side.
    let (unfitted, _, _) = bench.evaluate(&[&arguments[..], &["--json", "--no-fit"]].concat());
    let unfitted: Value = serde_json::from_str(&unfitted).unwrap();
    assert_eq!(unfitted["models"][0]["kinematic_fit"], false);
    let same = |key: &str| unfitted["robots"][0][key] == figures[key];
    assert!(same("mask") && same("presence") && !same("true_mask") && !same("estimated_mask"));

    let (table, _, code) = bench.evaluate(&[&arguments[..], &["--adapter", "cpu"]].concat());
    assert_eq!(code, 0);
    for part in [
        "ur5 bundled",
        "synthetic, free camera",
        "the paper",
        "98.1 %",
        "wrist_3",
        "ur5: moved to where an arm can have them",
    ] {
        assert!(table.contains(part), "{part}: {table}");
    }
}

#[test]
fn cameras_at_once_are_judged_together() {
    let bench = Bench::new();
    let near = |nearer: f64| {
        let sample = |_| Known {
            image: left_half,
            mask: left_half,
            nearer,
        };
        (0..6).map(sample).collect::<Vec<_>>()
    };
    bench.recording("rig/camera_1", "cube", &near(0.03));
    bench.recording("rig/camera_2", "cube", &near(0.03));
    let found = bench.json(&["--rig", "rig"]);
    let rig = &found["rigs"][0];
    assert_eq!(
        (&rig["instants"], &rig["found"]),
        (&json!(6), &json!([6, 6]))
    );
    for (line, tries) in [(0, 12), (1, 2), (3, 2)] {
        let line = &rig["poses"][line];
        assert_eq!(
            (&line["tries"], &line["undetermined"]),
            (&json!(tries), &json!(0))
        );
        // The camera stands where the joints put it: all of them are 3 cm too near.
        assert!(close(&line["place_cm"]["median"], 3.0, 1e-3), "{line}");
        assert!(close(&line["turn_deg"]["p95"], 0.0, 1e-3), "{line}");
    }
    assert_eq!(rig["poses"][2]["tries"], 0);
    for (line, cameras) in [(0, 1), (1, 2)] {
        let line = &rig["together"][line];
        assert_eq!(line["cameras"], cameras);
        assert!(close(&line["first_camera_cm"]["mean"], 3.0, 1e-3), "{line}");
        // Calibrated, what is wrong always is not wrong any more.
        assert!(close(&line["base_cm"]["mean"], 0.0, 1e-3), "{line}");
    }
    let arguments = [
        "--rig",
        "rig",
        "--weights",
        "cube.safetensors",
        "--adapter",
        "cpu",
    ];
    let (text, _, code) = bench.evaluate(&arguments);
    assert_eq!(code, 0);
    assert!(
        text.contains("cube, 2 cameras, 6 instants, found in 6, 6"),
        "{text}"
    );

    bench.recording("rig/camera_2", "cube", &near(0.03)[..5]);
    let (code, stderr) = bench.refused(&["--rig", "rig", "--weights", "cube.safetensors"]);
    assert!(
        code == 1 && stderr.contains("expected 6 samples of cube"),
        "{stderr}"
    );
    let lines = bench.path("rig/camera_2/samples.jsonl");
    let text = std::fs::read_to_string(&lines).unwrap();
    let (first, second) = text.split_once('\n').unwrap();
    let moved = second.replacen("1.0,0.0,0.0,0.0,0.0", "1.0,0.0,0.0,0.5,0.0", 1);
    assert_ne!(moved, second);
    std::fs::write(&lines, format!("{first}\n{moved}")).unwrap();
    let (code, stderr) = bench.refused(&["--rig", "rig", "--weights", "cube.safetensors"]);
    let told = "samples.jsonl:2: camera_from_base: expected a camera that stands still";
    assert!(code == 1 && stderr.contains(told), "{stderr}");
    let (code, stderr) = bench.refused(&["--rig", "nothing", "--weights", "cube.safetensors"]);
    assert!(code == 1 && stderr.contains("camera_1"), "{stderr}");
}
