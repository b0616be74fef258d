//! The command line: answers, pictures, exit codes, and what it says to bad input.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};

use crate::known::{JOINTS, XYZ, command, model};
use assert_cmd::Command;
use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use tempfile::TempDir;

const WHITE: [u8; 3] = [255; 3];
const BLACK: [u8; 3] = [0; 3];

/// A folder with a model whose mask is what is red at least by half: a white image is all robot, a
/// black one none.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self::with_joints(XYZ)
    }

    fn with_joints(xyz: [[f64; 3]; 6]) -> Self {
        let bench = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        let card = json!({"figures": {"mask_iou": 0.5}});
        bench.write("model.safetensors", &model("cube", xyz, 0.0, &card));
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    fn image(&self, name: &str, width: u32, height: u32, colour: [u8; 3]) {
        let image = RgbImage::from_pixel(width, height, Rgb(colour));
        image.save(self.path(name)).unwrap();
    }

    fn command(&self) -> Command {
        command(self.folder.path())
    }

    /// `locate --json` in plain Rust: the lines and the exit code.
    fn locate(&self, arguments: &[&str]) -> (Vec<Value>, i32) {
        let output = self
            .command()
            .args(["locate", "--json", "--adapter", "cpu"])
            .args(["--weights", "model.safetensors"])
            .args(arguments)
            .output()
            .unwrap();
        let stdout = String::from_utf8(output.stdout).unwrap();
        let lines = stdout
            .lines()
            .map(|line| serde_json::from_str(line).unwrap());
        (lines.collect(), output.status.code().unwrap())
    }

    /// A usage or start-up error: exit code and stderr; stdout stays empty.
    fn fail(&self, arguments: &[&str]) -> (i32, String) {
        let output = self.command().args(arguments).output().unwrap();
        assert!(output.stdout.is_empty(), "{:?}", output.stdout);
        (
            output.status.code().unwrap(),
            String::from_utf8(output.stderr).unwrap(),
        )
    }

    fn picture(&self, path: &Value) -> DynamicImage {
        image::open(self.path(path.as_str().unwrap())).unwrap()
    }
}

fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn noise(width: u32, height: u32) -> DynamicImage {
    let hash = |x: u32, y: u32, c: u32| (x * 7919 + y * 104_729 + c * 15_485_863) % 251;
    RgbImage::from_fn(width, height, |x, y| {
        Rgb([0, 1, 2].map(|c| hash(x, y, c) as u8))
    })
    .into()
}

/// A PNG of 8-bit RGB whose header claims a size, and that has nothing else.
fn png_header(width: u32, height: u32) -> Vec<u8> {
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut header = b"IHDR".to_vec();
    header.extend(width.to_be_bytes());
    header.extend(height.to_be_bytes());
    header.extend([8, 2, 0, 0, 0]);
    let mut crc = !0_u32;
    for &byte in &header {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xedb8_8320 * (crc & 1));
        }
    }
    png.extend(13_u32.to_be_bytes());
    png.extend(&header);
    png.extend((!crc).to_be_bytes());
    // The decoder reads on to the first data chunk before it tells the size.
    png.extend([0, 0, 0, 0]);
    png.extend(b"IDAT");
    png
}

/// A JPEG with an EXIF segment of two entries: orientation, and focal length on 35 mm film.
fn jpeg_with_exif(image: &DynamicImage, orientation: u16, focal_35mm: u16) -> Vec<u8> {
    let entry = |tag: u16, value: u16| {
        let mut entry = Vec::new();
        entry.extend(tag.to_be_bytes());
        entry.extend(3_u16.to_be_bytes());
        entry.extend(1_u32.to_be_bytes());
        entry.extend(value.to_be_bytes());
        entry.extend([0, 0]);
        entry
    };
    let mut exif = b"Exif\0\0MM\0\x2a\0\0\0\x08".to_vec();
    exif.extend(2_u16.to_be_bytes());
    exif.extend(entry(0x0112, orientation));
    // The pointer to the EXIF directory, behind this one: 8 + 2 + 2 * 12 + 4.
    exif.extend([0x87, 0x69, 0, 4, 0, 0, 0, 1, 0, 0, 0, 38]);
    exif.extend([0; 4]);
    exif.extend(1_u16.to_be_bytes());
    exif.extend(entry(0xa405, focal_35mm));
    exif.extend([0; 4]);

    let plain = encoded(image, ImageFormat::Jpeg);
    let mut jpeg = plain[..2].to_vec();
    jpeg.extend([0xff, 0xe1]);
    jpeg.extend((exif.len() as u16 + 2).to_be_bytes());
    jpeg.extend(exif);
    jpeg.extend(&plain[2..]);
    jpeg
}

fn close(a: &Value, b: f64, tolerance: f64) -> bool {
    (a.as_f64().unwrap() - b).abs() <= tolerance
}

#[test]
fn a_robot_is_found_and_told_as_one_line_of_json() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let (lines, code) = bench.locate(&["white.png", "--hfov", "90", "--out", "pictures"]);
    assert_eq!((lines.len(), code), (1, 0));
    let line = &lines[0];
    let keys: Vec<_> = line.as_object().unwrap().keys().cloned().collect();
    assert_eq!(
        keys,
        [
            "schema",
            "file",
            "robot",
            "status",
            "coverage",
            "field",
            "bbox_px",
            "frame",
            "joints",
            "intrinsics",
            "adapter",
            "ms",
            "mask",
            "annotated"
        ]
    );
    assert_eq!(line["schema"], 1);
    assert_eq!(line["file"], "white.png");
    assert_eq!(line["robot"], "cube");
    assert_eq!(line["status"], "found");
    assert_eq!(line["frame"], "camera_optical");
    assert_eq!(line["adapter"], "cpu");
    assert_eq!(line["intrinsics"]["source"], "hfov");
    assert!(close(&line["intrinsics"]["fx"], 48.0, 1e-3));
    assert!(close(&line["coverage"], 1.0, 0.01));
    assert!(close(&line["field"], 1.0, 0.01));
    for (joint, (name, xyz)) in line["joints"]
        .as_array()
        .unwrap()
        .iter()
        .zip(JOINTS.iter().zip(XYZ))
    {
        assert_eq!(&joint["name"], name);
        let [x, y, z] = xyz;
        for (found, expected) in joint["xyz_m"].as_array().unwrap().iter().zip([x, y, z]) {
            assert!(close(found, expected, 1e-4), "{joint}");
        }
        let pixel = [48.0 * x / z + 47.5, 48.0 * y / z + 35.5];
        for (found, expected) in joint["px"].as_array().unwrap().iter().zip(pixel) {
            assert!(close(found, expected, 0.01), "{joint}");
        }
    }
    for key in ["decode", "locate", "draw"] {
        assert!(line["ms"][key].is_f64(), "{key}");
    }
    assert_eq!(line["mask"], "pictures/white.mask.png");
    assert_eq!(line["annotated"], "pictures/white.annotated.png");
    let mask = bench.picture(&line["mask"]);
    assert_eq!(mask.color(), image::ColorType::L8);
    assert_eq!((mask.width(), mask.height()), (96, 72));
    assert!(mask.to_luma8().pixels().all(|p| p.0[0] == 255));
}

#[test]
fn without_a_robot_there_are_no_joints_but_both_pictures() {
    let bench = Bench::new();
    bench.image("black.png", 96, 72, BLACK);
    let (lines, code) = bench.locate(&["black.png", "--out", "pictures"]);
    assert_eq!(code, 0);
    assert_eq!(lines[0]["status"], "not_found");
    assert!(lines[0].get("joints").is_none());
    assert!(lines[0].get("bbox_px").is_none());
    let mask = bench.picture(&lines[0]["mask"]).to_luma8();
    assert!(mask.pixels().all(|p| p.0[0] == 0));
    let annotated = bench.picture(&lines[0]["annotated"]).to_rgb8();
    assert_eq!(annotated, RgbImage::from_pixel(96, 72, Rgb(BLACK)));
}

#[test]
fn joints_that_cannot_be_are_not_told() {
    let mut behind = XYZ;
    behind[3][2] = -1.0;
    let bench = Bench::with_joints(behind);
    bench.image("white.png", 96, 72, WHITE);
    let (lines, code) = bench.locate(&["white.png", "--out", "pictures"]);
    assert_eq!(code, 0);
    assert_eq!(lines[0]["status"], "invalid");
    assert!(lines[0].get("joints").is_none());
    assert!(bench.path("pictures/white.mask.png").is_file());
    assert!(bench.path("pictures/white.annotated.png").is_file());
}

#[test]
fn the_mask_alone_can_be_asked_for() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let (lines, code) = bench.locate(&["white.png", "--mask-only"]);
    assert_eq!(code, 0);
    assert_eq!(lines[0]["status"], "found");
    assert!(lines[0].get("joints").is_none());
    assert!(lines[0].get("mask").is_none());
}

#[test]
fn a_soft_mask_holds_probabilities() {
    let bench = Bench::new();
    let ramp = RgbImage::from_fn(96, 72, |x, _| Rgb([80 + x as u8, 0, 0]));
    ramp.save(bench.path("ramp.png")).unwrap();
    let levels = |arguments: &[&str]| {
        let (lines, code) = bench.locate(&[&["ramp.png", "--hfov", "90"], arguments].concat());
        assert_eq!(code, 0);
        let mask = bench.picture(&lines[0]["mask"]).to_luma8();
        let between = mask.pixels().filter(|p| !matches!(p.0[0], 0 | 255)).count();
        (mask, between)
    };
    let (hard, between) = levels(&["--out", "hard"]);
    assert_eq!(between, 0);
    let (soft, between) = levels(&["--out", "soft", "--soft-mask"]);
    assert!(between > 1000, "{between}");
    for (hard, soft) in hard.pixels().zip(soft.pixels()) {
        assert!((hard.0[0] == 255) == (soft.0[0] >= 128) || soft.0[0] == 127);
    }
}

#[test]
fn people_get_a_summary() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    bench.image("black.png", 96, 72, BLACK);
    let output = bench
        .command()
        .args(["locate", "white.png", "black.png", "--adapter", "cpu"])
        .args(["--weights", "model.safetensors"])
        .output()
        .unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("white.png: cube found"), "{text}");
    assert!(text.contains("black.png: cube not found"), "{text}");
    assert!(text.contains("wrist_3"), "{text}");
    // No progress bar where there is no terminal.
    assert!(output.stderr.is_empty(), "{:?}", output.stderr);
}

#[test]
fn without_a_wish_the_best_adapter_gives_the_same_answer() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let output = bench
        .command()
        .args([
            "locate",
            "--json",
            "white.png",
            "--weights",
            "model.safetensors",
        ])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let line: Value = serde_json::from_slice(&output.stdout).unwrap();
    let (reference, _) = bench.locate(&["white.png"]);
    assert_eq!(line["joints"], reference[0]["joints"]);
    assert_eq!(line["status"], "found");
}

#[test]
fn broken_images_are_told_one_by_one() {
    let bench = Bench::new();
    let noise = noise(64, 48);
    let jpeg = encoded(&noise, ImageFormat::Jpeg);
    let png = encoded(&noise, ImageFormat::Png);
    bench.write("good.jpg", &jpeg);
    bench.write("good.png", &png);
    bench.write("half.jpg", &jpeg[..jpeg.len() / 2]);
    bench.write("no_end.jpg", &jpeg[..jpeg.len() - 2]);
    bench.write("head.jpg", &jpeg[..100]);
    bench.write("half.png", &png[..png.len() / 2]);
    bench.write("huge.png", &png_header(100_000, 100_000));
    bench.write("large.png", &png_header(32_000, 32_000));
    bench.write("empty.jpg", b"");
    bench.write("text.png", b"this is no picture");
    std::fs::create_dir(bench.path("empty_folder")).unwrap();
    let cases = [
        ("half.jpg", "truncated"),
        ("no_end.jpg", "truncated"),
        ("head.jpg", "decoded"),
        ("half.png", "decoded"),
        ("huge.png", "100000 x 100000"),
        ("large.png", "32000 x 32000"),
        ("empty.jpg", "found none of these formats"),
        ("text.png", "found none of these formats"),
        ("missing.png", "cannot be read"),
        ("empty_folder", "no images"),
    ];
    let mut arguments: Vec<_> = cases.iter().map(|&(name, _)| name).collect();
    arguments.extend(["good.jpg", "good.png"]);
    let (lines, code) = bench.locate(&arguments);
    assert_eq!((lines.len(), code), (12, 1));
    for (line, (name, part)) in lines.iter().zip(cases) {
        assert_eq!(line["schema"], 1);
        assert_eq!(line["file"], name);
        assert_eq!(line["status"], "error", "{line}");
        let message = line["message"].as_str().unwrap();
        assert!(message.contains(part), "{name}: {message}");
    }
    // The others are still done.
    for line in &lines[cases.len()..] {
        assert_ne!(line["status"], "error", "{line}");
    }
    let (_, code) = bench.locate(&["good.jpg", "good.png"]);
    assert_eq!(code, 0);
}

#[test]
fn without_json_a_failed_file_is_told_on_stderr() {
    let bench = Bench::new();
    let arguments = [
        "locate",
        "missing.png",
        "--adapter",
        "cpu",
        "--weights",
        "model.safetensors",
    ];
    let (code, message) = bench.fail(&arguments);
    assert_eq!(code, 1);
    assert!(message.contains("missing.png: error:"), "{message}");
}

#[test]
fn images_of_every_kind_are_read_in_their_colours() {
    let bench = Bench::new();
    let colour = [40_u8, 60, 200];
    let solid = |colour| RgbImage::from_pixel(32, 24, Rgb(colour));
    let rgb = DynamicImage::from(solid(colour));
    let grey = DynamicImage::from(GrayImage::from_pixel(32, 24, Luma([90])));
    bench.write(
        "rgb16.png",
        &encoded(&rgb.to_rgb16().into(), ImageFormat::Png),
    );
    bench.write("grey.png", &encoded(&grey, ImageFormat::Png));
    bench.write(
        "grey16.png",
        &encoded(&grey.to_luma16().into(), ImageFormat::Png),
    );
    bench.write("grey.jpg", &encoded(&grey, ImageFormat::Jpeg));
    bench.write("rgb.jpg", &encoded(&rgb, ImageFormat::Jpeg));
    bench.write(
        "rgb.gif",
        &encoded(&rgb.to_rgba8().into(), ImageFormat::Gif),
    );
    bench.write("rgb.bmp", &encoded(&rgb, ImageFormat::Bmp));
    bench.write("rgb.tiff", &encoded(&rgb, ImageFormat::Tiff));
    bench.write("rgb.webp", &encoded(&rgb, ImageFormat::WebP));
    bench.write(
        "one.png",
        &encoded(&rgb.crop_imm(0, 0, 1, 1), ImageFormat::Png),
    );
    // A JPEG's content counts, not its name.
    bench.write("jpeg.png", &encoded(&rgb, ImageFormat::Jpeg));
    let cases = [
        ("rgb16.png", colour),
        ("grey.png", [90; 3]),
        ("grey16.png", [90; 3]),
        ("grey.jpg", [90; 3]),
        ("rgb.jpg", colour),
        ("rgb.gif", colour),
        ("rgb.bmp", colour),
        ("rgb.tiff", colour),
        ("rgb.webp", colour),
        ("one.png", colour),
        ("jpeg.png", colour),
    ];
    let mut arguments: Vec<_> = cases.iter().map(|&(name, _)| name).collect();
    arguments.extend(["--out", "pictures"]);
    let (lines, code) = bench.locate(&arguments);
    assert_eq!((lines.len(), code), (cases.len(), 0));
    let differs = |line: &Value, colour: [u8; 3]| {
        let picture = bench.picture(&line["annotated"]).to_rgb8();
        let channels = picture.pixels().flat_map(|p| p.0.into_iter().zip(colour));
        channels.map(|(a, b)| a.abs_diff(b)).max().unwrap()
    };
    for (line, (name, colour)) in lines.iter().zip(cases) {
        assert_eq!(line["status"], "not_found", "{name}");
        assert!(differs(line, colour) <= 4, "{name}");
        let [r, g, b] = colour;
        assert!(differs(line, [r, g, b - 20]) > 4, "{name}");
    }
}

#[test]
fn a_cmyk_jpeg_is_read_in_its_colours() {
    // Made from (200, 60, 40), which the model takes for robot.
    let cmyk = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/images/cmyk.jpg");
    let bench = Bench::new();
    bench.write("cmyk.jpg", &std::fs::read(cmyk).unwrap());
    let (lines, code) = bench.locate(&["cmyk.jpg", "--hfov", "90", "--out", "pictures"]);
    assert_eq!(code, 0);
    assert_eq!(lines[0]["status"], "found");
    // The same colours inverted, as a reader would have them that ignores Adobe's marker.
    bench.image("inverted.png", 32, 24, [55, 195, 215]);
    let (lines, _) = bench.locate(&["inverted.png"]);
    assert_eq!(lines[0]["status"], "not_found");
}

#[test]
fn exifs_orientation_and_focal_length_are_honoured() {
    let bench = Bench::new();
    // The left half of the stored image is robot: upright, that is the upper half.
    let stored: DynamicImage =
        RgbImage::from_fn(96, 64, |x, _| Rgb(if x < 48 { WHITE } else { BLACK })).into();
    bench.write("rotated.jpg", &jpeg_with_exif(&stored, 6, 28));
    bench.write("plain.jpg", &jpeg_with_exif(&stored, 1, 0));
    let (lines, code) = bench.locate(&["rotated.jpg", "plain.jpg", "--out", "pictures"]);
    assert_eq!(code, 0);
    let mask = |line: &Value| bench.picture(&line["mask"]).to_luma8();

    let rotated = mask(&lines[0]);
    assert_eq!(rotated.dimensions(), (64, 96));
    assert_eq!(rotated.get_pixel(32, 36).0[0], 255);
    assert_eq!(rotated.get_pixel(32, 60).0[0], 0);
    assert_eq!(lines[0]["intrinsics"]["source"], "exif");
    let focal = 64_f64.hypot(96.0) * 28.0 / 36_f64.hypot(24.0);
    assert!(close(&lines[0]["intrinsics"]["fx"], focal, 1e-2));

    let plain = mask(&lines[1]);
    assert_eq!(plain.dimensions(), (96, 64));
    assert_eq!(plain.get_pixel(36, 32).0[0], 255);
    assert_eq!(plain.get_pixel(60, 32).0[0], 0);
    assert_eq!(lines[1]["intrinsics"]["source"], "assumed");
}

#[test]
fn what_the_networks_do_not_see_is_background() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    // tan(63.43 degrees) = 2: the networks see half of it each way.
    let (lines, _) = bench.locate(&["white.png", "--hfov", "126.87", "--out", "pictures"]);
    assert!(close(&lines[0]["field"], 0.25, 0.03), "{}", lines[0]);
    assert!(close(&lines[0]["coverage"], 0.25, 0.03), "{}", lines[0]);
    let mask = bench.picture(&lines[0]["mask"]).to_luma8();
    assert_eq!(mask.get_pixel(48, 36).0[0], 255);
    assert_eq!(mask.get_pixel(5, 5).0[0], 0);
}

fn camera_info(width: u32, focal: u32, last: u32) -> String {
    format!(
        "image_width: {width}\nimage_height: 72\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
         data: [{focal}, 0, {focal}, 0, {focal}, {focal}, 0, 0, {last}]\n\
         distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  \
         data: [-0.1, 0, 0, 0, 0]\n"
    )
}

#[test]
fn a_camera_file_gives_the_intrinsics() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    bench.write("camera.yaml", camera_info(96, 50, 1).as_bytes());
    let (lines, code) = bench.locate(&["white.png", "--camera", "camera.yaml"]);
    assert_eq!(code, 0);
    assert_eq!(lines[0]["intrinsics"]["source"], "camera_info");
    assert_eq!(lines[0]["intrinsics"]["cx"], 50.0);
}

#[test]
fn a_camera_of_another_size_fails_the_image_it_does_not_fit() {
    let bench = Bench::new();
    bench.image("fits.png", 96, 72, WHITE);
    bench.image("other.png", 72, 96, WHITE);
    bench.write("camera.yaml", camera_info(96, 50, 1).as_bytes());
    let (lines, code) = bench.locate(&["other.png", "fits.png", "--camera", "camera.yaml"]);
    assert_eq!(code, 1);
    let message = lines[0]["message"].as_str().unwrap();
    assert!(
        message.contains("96 x 72") && message.contains("72 x 96"),
        "{message}"
    );
    assert_eq!(lines[1]["status"], "found");
}

#[test]
fn camera_files_that_are_none_are_refused() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    bench.write("zero.yaml", camera_info(96, 0, 0).as_bytes());
    bench.write("text.yaml", b"a camera");
    let cases = [
        ("zero.yaml", "not calibrated"),
        ("text.yaml", "camera_info"),
        ("missing.yaml", "missing.yaml"),
    ];
    for (file, part) in cases {
        let arguments = ["locate", "white.png", "--weights", "model.safetensors"];
        let camera = ["--adapter", "cpu", "--camera", file];
        let (code, message) = bench.fail(&[&arguments[..], &camera].concat());
        assert_eq!(code, 1, "{file}");
        assert!(
            message.contains(part) && message.contains(file),
            "{file}: {message}"
        );
    }
}

#[test]
fn wrong_usage_exits_with_2() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let cases: [(&[&str], &str); 10] = [
        (&["--adapter", "voodoo"], "there are:"),
        (&["--soft-mask"], "--out"),
        (&["--backend", "glide"], "vulkan, metal, dx12, gl"),
        (&["--camera", "a.yaml", "--hfov", "70"], "--hfov"),
        (&["--hfov", "180"], "between 0 and 180"),
        (&["--hfov", "wide"], "between 0 and 180"),
        (&["--hfov", "nan"], "between 0 and 180"),
        (&["--robot", "../ur5"], "letters, digits"),
        (&["--robot", ""], "letters, digits"),
        (&["--colour"], "--colour"),
    ];
    for (arguments, part) in cases {
        let all = [
            &["locate", "white.png", "--weights", "model.safetensors"],
            arguments,
        ]
        .concat();
        let (code, message) = bench.fail(&all);
        assert_eq!(code, 2, "{arguments:?}: {message}");
        assert!(message.contains(part), "{arguments:?}: {message}");
    }
    let (code, _) = bench.fail(&["locate"]);
    assert_eq!(code, 2);
    let (code, _) = bench.fail(&["find"]);
    assert_eq!(code, 2);
}

#[test]
fn an_adapter_named_by_the_environment_is_held_to_the_same_rule() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let output = bench
        .command()
        .args(["locate", "white.png", "--weights", "model.safetensors"])
        .env("WGPU_ADAPTER_NAME", "voodoo")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(message.contains("WGPU_ADAPTER_NAME"), "{message}");
}

#[test]
fn images_with_the_same_stem_keep_pictures_of_their_own() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("a")).unwrap();
    std::fs::create_dir(bench.path("b")).unwrap();
    bench.image("a/photo.png", 96, 72, WHITE);
    bench.image("b/photo.png", 96, 72, BLACK);
    bench.image("b/photo.bmp", 96, 72, BLACK);
    bench.image("Photo_2.png", 96, 72, BLACK);
    let (lines, code) = bench.locate(&[
        "a",
        "b/photo.png",
        "Photo_2.png",
        "b/photo.bmp",
        "--out",
        "o",
    ]);
    assert_eq!(code, 0);
    let names: Vec<_> = lines
        .iter()
        .map(|line| line["mask"].as_str().unwrap())
        .collect();
    assert_eq!(
        names,
        [
            "o/photo.mask.png",
            "o/photo_2.mask.png",
            "o/Photo_2_2.mask.png",
            "o/photo_3.mask.png"
        ]
    );
    let first_pixel = |line: &Value| bench.picture(&line["mask"]).to_luma8().get_pixel(48, 36).0[0];
    assert_eq!(first_pixel(&lines[0]), 255);
    assert_eq!(first_pixel(&lines[1]), 0);
}

#[test]
fn a_folder_gives_its_images_in_order_and_not_our_own_pictures() {
    let bench = Bench::new();
    std::fs::create_dir_all(bench.path("photos/below")).unwrap();
    bench.image("photos/b.png", 32, 24, BLACK);
    bench.image("photos/a.JPG", 32, 24, BLACK);
    bench.image("photos/below/c.png", 32, 24, BLACK);
    bench.write("photos/notes.txt", b"no image");
    for force in [&[][..], &["--force"]] {
        let (lines, code) = bench.locate(&[&["photos", "--out", "photos"], force].concat());
        assert_eq!(code, 0);
        let files: Vec<_> = lines
            .iter()
            .map(|line| line["file"].as_str().unwrap())
            .collect();
        assert_eq!(files, ["photos/a.JPG", "photos/b.png"]);
    }
    // Without being told to, nothing is overwritten: it may be somebody's.
    bench.write("photos/a.mask.png", b"mine");
    let (lines, code) = bench.locate(&["photos/a.JPG", "--out", "photos"]);
    assert_eq!((&lines[0]["status"], code), (&"error".into(), 1));
    let message = lines[0]["message"].as_str().unwrap();
    assert!(
        message.contains("a.mask.png is there already: --force"),
        "{message}"
    );
    assert_eq!(
        std::fs::read(bench.path("photos/a.mask.png")).unwrap(),
        b"mine"
    );
}

#[test]
fn weights_are_looked_for_and_the_places_told() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let (code, message) =
        bench.fail(&["locate", "white.png", "--adapter", "cpu", "--robot", "cube"]);
    assert_eq!(code, 1);
    assert!(
        message.contains("weights/cube.safetensors") && message.contains("WHEREABOT_WEIGHTS"),
        "{message}"
    );
    // Those beside the program.
    assert!(
        message.contains("`cube`; there are weights for ") && message.contains("ur5"),
        "{message}"
    );
    // The paper's file is a UR5's, too: no robot has its name.
    assert!(!message.contains("ur5-paper"), "{message}");
    std::fs::create_dir(bench.path("elsewhere")).unwrap();
    std::fs::copy(
        bench.path("model.safetensors"),
        bench.path("elsewhere/cube.safetensors"),
    )
    .unwrap();
    let output = bench
        .command()
        .args(["locate", "white.png", "--adapter", "cpu", "--robot", "cube"])
        .env("WHEREABOT_WEIGHTS", "elsewhere")
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
}

#[test]
fn weights_that_are_none_or_of_another_robot_are_refused() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let good = std::fs::read(bench.path("model.safetensors")).unwrap();
    bench.write("text.safetensors", b"these are no weights");
    bench.write("half.safetensors", &good[..good.len() / 2]);
    let cases = [
        (["text.safetensors", "cube"], "expected a safetensors file"),
        (["half.safetensors", "cube"], "expected a safetensors file"),
        (["missing.safetensors", "cube"], "missing.safetensors"),
        (["model.safetensors", "ur5"], "expected ur5, found cube"),
    ];
    for ([file, robot], part) in cases {
        let arguments = ["locate", "white.png", "--adapter", "cpu", "--weights", file];
        let (code, message) = bench.fail(&[&arguments[..], &["--robot", robot]].concat());
        assert_eq!(code, 1, "{file}");
        assert!(
            message.contains(file) && message.contains(part),
            "{message}"
        );
    }
    let (lines, code) = bench.locate(&["white.png", "--robot", "cube"]);
    assert_eq!((lines.len(), code), (1, 0));
}

#[test]
fn an_output_folder_that_cannot_be_made_is_an_error() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let arguments = [
        "locate",
        "white.png",
        "--adapter",
        "cpu",
        "--weights",
        "model.safetensors",
    ];
    let (code, message) = bench.fail(&[&arguments[..], &["--out", "white.png/below"]].concat());
    assert_eq!(code, 1);
    assert!(message.contains("white.png/below"), "{message}");
}

#[test]
fn a_reader_that_leaves_early_is_no_failure() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_whereabot"))
        .current_dir(bench.folder.path())
        .args(["locate", "--json", "--adapter", "cpu"])
        .args(["--weights", "model.safetensors"])
        .args(["white.png"; 20])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.stderr.is_empty(), "{output:?}");
    assert_eq!(output.status.code(), Some(0));
}

/// Nobody reads stdout: what failed is still told, and files are still written.
#[test]
fn a_reader_that_leaves_changes_no_verdict_and_no_file() {
    let bench = Bench::new();
    bench.image("white.png", 96, 72, WHITE);
    bench.image("other.png", 96, 72, WHITE);
    let locate = |arguments: &[&str]| {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let status = std::process::Command::new(env!("CARGO_BIN_EXE_whereabot"))
            .current_dir(bench.folder.path())
            .args([
                "locate",
                "--adapter",
                "cpu",
                "--weights",
                "model.safetensors",
            ])
            .args(arguments)
            .stdout(writer)
            .status()
            .unwrap();
        status.code()
    };
    assert_eq!(locate(&["missing.png", "white.png"]), Some(1));
    assert_eq!(
        locate(&["white.png", "missing.png", "--out", "all"]),
        Some(1)
    );
    assert_eq!(
        locate(&["white.png", "other.png", "--out", "all", "--force"]),
        Some(0)
    );
    for name in ["white", "other"] {
        assert!(
            bench.path(&format!("all/{name}.mask.png")).exists(),
            "{name}"
        );
    }
    // Nothing is left to do where there are no files.
    assert_eq!(locate(&["white.png", "missing.png"]), Some(0));
}

#[test]
fn adapters_are_listed_with_the_one_that_would_be_used() {
    let bench = Bench::new();
    let table = bench.command().arg("adapters").output().unwrap();
    assert!(table.status.success(), "{table:?}");
    let table = String::from_utf8(table.stdout).unwrap();
    assert!(
        table.contains("BACKEND") && table.contains("used: "),
        "{table}"
    );
    let list = bench
        .command()
        .args(["adapters", "--json"])
        .output()
        .unwrap();
    let list: Value = serde_json::from_slice(&list.stdout).unwrap();
    assert!(list["adapters"].is_array());
    assert!(list.get("used").is_some() || list.get("problem").is_some());
    let unknown = bench
        .command()
        .arg("adapters")
        .env("WGPU_ADAPTER_NAME", "voodoo")
        .output()
        .unwrap();
    assert_eq!(unknown.status.code(), Some(2));
}

#[test]
fn a_models_card_is_shown() {
    let bench = Bench::new();
    let card = bench
        .command()
        .args(["info", "model.safetensors"])
        .output()
        .unwrap();
    assert!(card.status.success());
    let card = String::from_utf8(card.stdout).unwrap();
    for part in [
        "cube",
        "shoulder_pan",
        "conv1",
        "dense",
        "[18, 1, 1]",
        "mask_iou: 0.5",
    ] {
        assert!(card.contains(part), "{part}: {card}");
    }
    let description = bench
        .command()
        .args(["info", "--json", "model.safetensors"])
        .output()
        .unwrap();
    let description: Value = serde_json::from_slice(&description.stdout).unwrap();
    assert_eq!(description["robot"], "cube");
    assert_eq!(description["card"]["figures"]["mask_iou"], 0.5);
    let (code, message) = bench.fail(&["info", "missing.safetensors"]);
    assert_eq!(code, 1);
    assert!(message.contains("missing.safetensors"), "{message}");
}

#[test]
fn the_papers_recordings_want_three_robots_and_no_other_choice() {
    let bench = Bench::new();
    let paper = "record --paper --backgrounds photos --seed 1 --out out";
    let one = "record --backgrounds photos --seed 1 --out out --urdf a.urdf";
    let three = "--urdf ur3=a --urdf ur5=b --urdf ur10=c";
    for (arguments, told) in [
        (format!("{paper} --urdf ur3=a --urdf ur5=b"), "ur10=FILE"),
        (format!("{paper} {three} --urdf ur3=d"), "twice"),
        (format!("{paper} {three} --urdf d"), "found d"),
        (format!("{paper} --urdf ur7=a"), "found ur7=a"),
        (paper.to_owned(), "--urdf"),
        (format!("{paper} {three} --samples 5"), "--samples"),
        (format!("{paper} {three} --robot ur5"), "--robot"),
        (format!("{paper} {three} --free-camera"), "--free-camera"),
        (format!("{one} --robot arm"), "--samples"),
        (format!("{one} --samples 5"), "--robot"),
        (format!("{one} --samples 5 --robot arm --urdf b"), "found 2"),
    ] {
        let arguments: Vec<&str> = arguments.split(' ').collect();
        let (code, stderr) = bench.fail(&arguments);
        assert_eq!(code, 2, "{arguments:?}");
        assert!(stderr.contains(told), "{stderr}");
    }
    // The first robot is looked at before anything is drawn.
    let arguments = format!("{paper} {three}");
    let (code, stderr) = bench.fail(&arguments.split(' ').collect::<Vec<_>>());
    assert!(code == 1 && stderr.contains("a: "), "{stderr}");
    assert!(!bench.path("out").exists());
}
