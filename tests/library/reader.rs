//! Recordings on disk: what is read, and what is refused.
#![cfg(feature = "recording")]

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, RgbImage};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::recording::{Reader, RecordingError, Sample, SourceKind};

const WIDTH: u32 = 16;
const HEIGHT: u32 = 12;

/// A recording of a real robot with two joints: two samples with it, one without.
struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        let folder = Self(TempDir::new().unwrap());
        folder.write_header(&header());
        folder.write_lines(&[sample(0), sample(1), empty(2)]);
        for inside in ["image", "mask"] {
            fs::create_dir(folder.path(inside)).unwrap();
        }
        for id in 0..3 {
            let image = RgbImage::from_pixel(WIDTH, HEIGHT, [10, 20, 30].into());
            image.save(folder.path(&format!("image/{id}.jpg"))).unwrap();
            let mask = GrayImage::from_fn(WIDTH, HEIGHT, |x, _| {
                Luma([if id < 2 && x < 4 { 255 } else { 0 }])
            });
            mask.save(folder.path(&format!("mask/{id}.png"))).unwrap();
        }
        folder
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write_header(&self, header: &Value) {
        fs::write(self.path("recording.json"), header.to_string()).unwrap();
    }

    fn write_lines(&self, lines: &[Value]) {
        let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
        fs::write(self.path("samples.jsonl"), text).unwrap();
    }

    fn open(&self) -> Result<Reader, RecordingError> {
        Reader::open(self.0.path())
    }
}

fn header() -> Value {
    json!({"format": "whereabot-recording", "version": 1, "robot": "arm", "joints": ["pan", "lift"],
        "width": WIDTH, "height": HEIGHT, "frame": "camera_optical",
        "source": {"kind": "real", "generator": "a lab's script"}})
}

fn sample(id: u64) -> Value {
    json!({"id": id, "image": format!("image/{id}.jpg"), "mask": format!("mask/{id}.png"),
        "intrinsics": {"fx": 10.0, "fy": 11.0, "cx": 7.5, "cy": 5.5},
        "camera_from_base": [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 2.0, 0, 0, 0, 1],
        "joint_angles_rad": [0.5, -0.5],
        "joints_m": [[0.1, 0.2, 2.0], [-0.4, 0.0, 1.0]],
        "joints_px": [[8.0, 6.6], [3.5, 5.5]],
        "coverage": 0.25})
}

fn empty(id: u64) -> Value {
    json!({"id": id, "image": format!("image/{id}.jpg"), "mask": format!("mask/{id}.png"),
        "intrinsics": {"fx": 10.0, "fy": 11.0, "cx": 7.5, "cy": 5.5}, "coverage": 0.0})
}

#[test]
fn a_recording_is_read() {
    let folder = Folder::new();
    let reader = folder.open().unwrap();
    assert_eq!(reader.header().robot, "arm");
    assert_eq!(reader.header().source.kind, SourceKind::Real);
    assert_eq!(reader.header().source.seed, None);
    let ids: Vec<u64> = reader.samples().iter().map(|s| s.id).collect();
    assert_eq!(ids, [0, 1, 2]);
    for sample in reader.samples() {
        assert_eq!(reader.image(sample).unwrap().dimensions(), (WIDTH, HEIGHT));
        let mask = reader.mask(sample).unwrap();
        let robot = mask.iter().filter(|&&m| m == 255).count();
        assert_eq!(robot, if sample.id < 2 { 48 } else { 0 });
        assert_eq!(sample.joints_m.is_some(), sample.id < 2);
    }
}

#[test]
fn a_fifth_of_the_samples_is_for_tests() {
    let sample = |id| -> Sample { serde_json::from_value(empty(id)).unwrap() };
    let tests: Vec<u64> = (0..20).filter(|&id| sample(id).is_test()).collect();
    assert_eq!(tests, [0, 1, 5, 7, 9, 16]);
    let count = (0..1000).filter(|&id| sample(id).is_test()).count();
    assert_eq!(count, 201);
}

/// `value` with what is at a JSON pointer replaced, or removed.
fn with(mut value: Value, pointer: &str, new: Option<Value>) -> Value {
    let (parent, key) = pointer.rsplit_once('/').unwrap();
    let parent = value.pointer_mut(parent).unwrap();
    match (new, parent) {
        (Some(new), Value::Object(map)) => drop(map.insert(key.into(), new)),
        (Some(new), Value::Array(items)) => items[key.parse::<usize>().unwrap()] = new,
        (None, Value::Object(map)) => drop(map.shift_remove(key).unwrap()),
        (None, Value::Array(items)) => drop(items.remove(key.parse::<usize>().unwrap())),
        _ => panic!("{pointer}"),
    }
    value
}

#[test]
fn a_header_must_be_one() {
    let folder = Folder::new();
    for (pointer, new, told) in [
        (
            "/format",
            Some(json!("other")),
            "format: expected \"whereabot-recording\", found \"other\"",
        ),
        ("/version", Some(json!(2)), "version: expected 1, found 2"),
        ("/version", None, "version: expected 1, found null"),
        (
            "/frame",
            Some(json!("base")),
            "frame: expected \"camera_optical\", found \"base\"",
        ),
        ("/width", Some(json!(0)), "found 0 x 12"),
        ("/joints", Some(json!([])), "joints: expected at least one"),
        ("/source/kind", Some(json!("dreamt")), "dreamt"),
        ("/source/kind", Some(json!("synthetic")), "expected seed"),
        ("/colour", Some(json!("red")), "colour"),
    ] {
        folder.write_header(&with(header(), pointer, new));
        let error = folder.open().unwrap_err().to_string();
        assert!(
            error.contains(told) && error.contains("recording.json"),
            "{error}"
        );
    }
    fs::write(folder.path("recording.json"), "{\"format\": ").unwrap();
    let error = folder.open().unwrap_err().to_string();
    assert!(
        error.contains("recording.json: EOF") && error.contains("line 1"),
        "{error}"
    );
    fs::remove_file(folder.path("recording.json")).unwrap();
    assert!(matches!(folder.open(), Err(RecordingError::Io { .. })));
    folder.write_header(&header());
    assert!(folder.open().is_ok());
}

#[test]
fn a_wrong_line_is_named() {
    let folder = Folder::new();
    for (pointer, new, told) in [
        ("/id", Some(json!(5)), "id: expected 1, found 5"),
        (
            "/joints_m/1/2",
            Some(json!(-1.0)),
            "lift: expected a point before the camera",
        ),
        (
            "/joints_m/1/2",
            Some(json!(0.0)),
            "lift: expected a point before the camera",
        ),
        ("/joints_m/1/2", Some(json!(null)), "null"),
        ("/joints_m/1", None, "joints_m: expected 2 joints, found 1"),
        (
            "/joint_angles_rad/0",
            None,
            "joint_angles_rad: expected 2 joints, found 1",
        ),
        (
            "/joints_px/0/1",
            Some(json!(9.0)),
            "joints_px: pan: expected [8.0, 6.6]",
        ),
        (
            "/joints_px",
            None,
            "joints_px: expected with camera_from_base",
        ),
        (
            "/camera_from_base",
            None,
            "camera_from_base: expected with joint_angles_rad",
        ),
        ("/camera_from_base/3", Some(json!("x")), "column"),
        (
            "/camera_from_base/0",
            Some(json!(0.5)),
            "expected a rotation",
        ),
        (
            "/camera_from_base/12",
            Some(json!(0.5)),
            "expected a rotation",
        ),
        (
            "/intrinsics/fx",
            Some(json!(0.0)),
            "intrinsics: expected finite",
        ),
        (
            "/coverage",
            Some(json!(1.5)),
            "coverage: expected 0 to 1, found 1.5",
        ),
        (
            "/coverage",
            Some(json!(-0.1)),
            "coverage: expected 0 to 1, found -0.1",
        ),
        (
            "/image",
            Some(json!("/etc/passwd")),
            "image: expected a path inside",
        ),
        (
            "/mask",
            Some(json!("../mask/1.png")),
            "mask: expected a path inside",
        ),
        ("/mask", Some(json!("")), "mask: expected a path inside"),
        ("/mask", None, "missing field `mask`"),
        ("/colour", Some(json!("red")), "unknown field `colour`"),
    ] {
        folder.write_lines(&[sample(0), with(sample(1), pointer, new), empty(2)]);
        let error = folder.open().unwrap_err().to_string();
        assert!(
            error.contains(told) && error.contains("samples.jsonl:2: "),
            "{error}"
        );
    }
    folder.write_lines(&[with(empty(0), "/coverage", Some(json!(0.5)))]);
    let error = folder.open().unwrap_err().to_string();
    assert!(
        error.contains(":1: coverage: expected 0 without a robot"),
        "{error}"
    );

    let good = sample(0).to_string();
    for (text, told) in [
        (
            "{\"id\": 0, \"image\": \"image/0.j\n".to_owned(),
            ":1: column",
        ),
        (good.replace("0.25", "NaN") + "\n", ":1: column"),
        (good.replace("0.25", "1e999") + "\n", ":1: column"),
        (format!("{good}\n\n"), ":2: column"),
        (
            format!("{good}\n{}", sample(1)),
            ":2: expected a whole line",
        ),
        (format!("{good}\n{{\"id\""), ":2: expected a whole line"),
        (String::new(), "expected at least one sample, found none"),
    ] {
        fs::write(folder.path("samples.jsonl"), &text).unwrap();
        let error = folder.open().unwrap_err().to_string();
        assert!(
            error.contains(told) && error.contains("samples.jsonl"),
            "{error}"
        );
    }
    fs::remove_file(folder.path("samples.jsonl")).unwrap();
    assert!(matches!(folder.open(), Err(RecordingError::Io { .. })));

    // A pixel is near enough.
    let near = with(sample(1), "/joints_px/0/1", Some(json!(7.5)));
    folder.write_lines(&[sample(0), near, empty(2)]);
    assert!(folder.open().is_ok());
}

#[test]
fn all_wrong_lines_are_told() {
    let folder = Folder::new();
    let wrong = |id| with(sample(id), "/coverage", Some(json!(2.0)));
    folder.write_lines(&[wrong(0), sample(1), wrong(2)]);
    let (reader, faults) = Reader::open_with_faults(folder.0.path()).unwrap();
    assert_eq!(reader.samples().len(), 1);
    let lines: Vec<u64> = faults
        .iter()
        .map(|fault| match fault {
            RecordingError::Line { line, .. } => *line,
            other => panic!("{other}"),
        })
        .collect();
    assert_eq!(lines, [1, 3]);
}

/// What is wrong with the second sample's pictures.
fn picture_fault(folder: &Path) -> String {
    let reader = Reader::open(folder).unwrap();
    let sample = &reader.samples()[1];
    let image = reader.image(sample).map(drop);
    let fault = image.and(reader.mask(sample).map(drop)).unwrap_err();
    let text = fault.to_string();
    assert!(text.contains("samples.jsonl:2: "), "{text}");
    text
}

#[test]
fn a_wrong_picture_is_named() {
    let folder = Folder::new();
    let path = folder.0.path();
    let (image, mask) = (folder.path("image/1.jpg"), folder.path("mask/1.png"));
    let (good_image, good_mask) = (fs::read(&image).unwrap(), fs::read(&mask).unwrap());

    fs::remove_file(&mask).unwrap();
    assert!(picture_fault(path).contains("mask/1.png: "));
    fs::write(&mask, &good_mask[..good_mask.len() / 2]).unwrap();
    assert!(picture_fault(path).contains("mask/1.png: "));
    GrayImage::new(WIDTH, HEIGHT + 1).save(&mask).unwrap();
    assert!(picture_fault(path).contains("mask/1.png: expected 16 x 12 pixels, found 16 x 13"));
    GrayImage::from_pixel(WIDTH, HEIGHT, Luma([128]))
        .save(&mask)
        .unwrap();
    assert!(picture_fault(path).contains("expected the values 0 and 255, found 128"));
    GrayImage::from_pixel(WIDTH, HEIGHT, Luma([255]))
        .save(&mask)
        .unwrap();
    assert!(picture_fault(path).contains("expected 0.2500 robot pixels (coverage), found 1.0000"));
    fs::write(&mask, &good_mask).unwrap();

    fs::write(&image, "no picture").unwrap();
    assert!(picture_fault(path).contains("image/1.jpg: "));
    RgbImage::new(WIDTH - 1, HEIGHT).save(&image).unwrap();
    assert!(picture_fault(path).contains("image/1.jpg: expected 16 x 12 pixels, found 15 x 12"));
    fs::remove_file(&image).unwrap();
    assert!(picture_fault(path).contains("image/1.jpg: "));
    fs::write(&image, &good_image).unwrap();

    let reader = Reader::open(path).unwrap();
    assert!(reader.image(&reader.samples()[1]).is_ok());
    assert!(reader.mask(&reader.samples()[1]).is_ok());
}

#[cfg(feature = "cli")]
mod check {
    use assert_cmd::Command;
    use image::GenericImageView;
    use std::process::Output;

    use super::*;

    fn run(arguments: &[&str], folder: &Folder) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_whereabot"));
        command.current_dir(folder.0.path());
        command.args(["recording", "check"]).args(arguments);
        command.output().unwrap()
    }

    fn text(bytes: &[u8]) -> &str {
        str::from_utf8(bytes).unwrap()
    }

    #[test]
    fn a_good_recording_passes() {
        let folder = Folder::new();
        let output = run(&["."], &folder);
        assert_eq!(output.status.code(), Some(0));
        assert!(output.stderr.is_empty(), "{}", text(&output.stderr));
        let found = text(&output.stdout);
        for told in [
            "arm, real, 16 x 12",
            "samples     3: 1 to train, 2 to test with",
            "with robot  2",
            "25.0 % to 25.0 %",
            "0 % of these are within 6 % to 17 %",
            "1.08 m to 2.01 m",
            "faults      none",
        ] {
            assert!(found.contains(told), "{told}: {found}");
        }

        let output = run(&[".", "--json"], &folder);
        let line: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(line["schema"], 1);
        assert_eq!(
            (&line["samples"], &line["train"], &line["test"]),
            (&json!(3), &json!(1), &json!(2))
        );
        assert_eq!(line["coverage"]["median"], 0.25);
        assert_eq!(line["faults"], json!([]));
    }

    #[test]
    fn all_faults_are_told_with_file_and_line() {
        let folder = Folder::new();
        folder.write_lines(&[
            sample(0),
            with(sample(1), "/joints_m/1/2", Some(json!(-1.0))),
            empty(2),
        ]);
        fs::remove_file(folder.path("mask/0.png")).unwrap();
        fs::write(folder.path("image/0.jpg"), "no picture").unwrap();
        RgbImage::new(3, 3)
            .save(folder.path("image/2.jpg"))
            .unwrap();
        let output = run(&["."], &folder);
        assert_eq!(output.status.code(), Some(1));
        let told = text(&output.stderr);
        let starts = [
            "error: ./samples.jsonl:1: image/0.jpg: ",
            "error: ./samples.jsonl:1: mask/0.png: ",
            "error: ./samples.jsonl:2: joints_m: lift: ",
            "error: ./samples.jsonl:3: image/2.jpg: expected 16 x 12 pixels, found 3 x 3",
        ];
        assert_eq!(told.lines().count(), starts.len(), "{told}");
        for (line, start) in told.lines().zip(starts) {
            assert!(line.starts_with(start), "{told}");
        }
        assert!(text(&output.stdout).contains("faults      4"));
        let line: Value = serde_json::from_slice(&run(&[".", "--json"], &folder).stdout).unwrap();
        assert_eq!(line["fault_count"], 4);
        assert_eq!(line["faults"].as_array().unwrap().len(), 4);

        // Also where nobody reads it.
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let status = std::process::Command::new(env!("CARGO_BIN_EXE_whereabot"))
            .current_dir(folder.0.path())
            .args(["recording", "check", ".", "--sheet", "sheet.png"])
            .stdout(writer)
            .stderr(std::process::Stdio::null())
            .status();
        assert_eq!(status.unwrap().code(), Some(1));
        assert!(folder.path("sheet.png").exists());

        let wrong = (0..50).map(|id| with(sample(id), "/coverage", Some(json!(2.0))));
        folder.write_lines(&wrong.collect::<Vec<_>>());
        let output = run(&["."], &folder);
        let told = text(&output.stderr);
        assert!(
            told.lines().count() == 21 && told.contains("and 30 more"),
            "{told}"
        );
    }

    #[test]
    fn what_is_no_whole_recording_fails() {
        let folder = Folder::new();
        let fails = |told: &str| {
            let output = run(&["."], &folder);
            assert_eq!(output.status.code(), Some(1));
            assert!(
                text(&output.stderr).contains(told),
                "{}",
                text(&output.stderr)
            );
        };
        let lines = fs::read(folder.path("samples.jsonl")).unwrap();
        fs::write(folder.path("samples.jsonl"), &lines[..lines.len() - 1]).unwrap();
        fails("samples.jsonl:3: expected a whole line");
        fs::write(folder.path("samples.jsonl"), "").unwrap();
        fails("samples.jsonl: expected at least one sample, found none");
        fs::write(folder.path("samples.jsonl"), lines).unwrap();
        folder.write_header(&with(header(), "/source/planned", Some(json!(4))));
        fails("recording.json: source.planned: expected 4 samples, found 3 good ones");
        folder.write_header(&with(header(), "/source/planned", Some(json!(3))));
        assert_eq!(run(&["."], &folder).status.code(), Some(0));
        fs::remove_dir_all(folder.path("image")).unwrap();
        fails("samples.jsonl:1: image/0.jpg: ");
        fs::remove_file(folder.path("recording.json")).unwrap();
        fails("recording.json: ");
        assert_eq!(run(&[], &folder).status.code(), Some(2));
    }

    #[test]
    fn a_contact_sheet_is_drawn_and_kept() {
        let folder = Folder::new();
        let sheet = folder.path("sheet");
        assert_eq!(
            run(&[".", "--sheet", "sheet"], &folder).status.code(),
            Some(0)
        );
        let bytes = fs::read(&sheet).unwrap();
        let picture = image::load_from_memory(&bytes).unwrap();
        assert_eq!(picture.dimensions(), (6 * 256, 192));
        // The mask's tint on the left of the first picture, no robot in the third, no fourth.
        let green = |x, y| {
            let [r, g, _, _] = picture.get_pixel(x, y).0;
            g > r.saturating_add(40)
        };
        assert!(green(20, 20) && !green(200, 20) && !green(2 * 256 + 20, 20));
        assert_eq!(picture.get_pixel(3 * 256 + 20, 20).0[..3], [0; 3]);

        fs::write(&sheet, "mine").unwrap();
        let output = run(&[".", "--sheet", "sheet"], &folder);
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output.stderr).contains("--force"));
        assert_eq!(fs::read(&sheet).unwrap(), b"mine");
        assert_eq!(
            run(&[".", "--sheet", "sheet", "--force"], &folder)
                .status
                .code(),
            Some(0)
        );
        assert_eq!(fs::read(&sheet).unwrap(), bytes);

        // Before anything is checked.
        let output = run(&[".", "--sheet", "nowhere/sheet"], &folder);
        assert_eq!(output.status.code(), Some(1));
        assert!(output.stdout.is_empty());
        assert!(text(&output.stderr).contains("nowhere: no such folder"));
    }
}
