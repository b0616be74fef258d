//! The examples do what their READMEs say. Cargo builds them with the tests.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use image::{Rgb, RgbImage, RgbaImage};
use whereabot::camera::Camera;
use whereabot::cascade::{
    Estimate, HostLocator, HostOptions, Joint, Locator, Output, Source, Status,
};
use whereabot::draw::mask_image;
use whereabot::gpu::{AdapterRequest, Device, Precision};
use whereabot::network::Model;

const IMAGES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/images");
const WEIGHTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/weights/ur5.safetensors");

fn example(name: &str) -> Command {
    let this = std::env::current_exe().unwrap();
    let examples = this.ancestors().nth(2).unwrap().join("examples");
    let mut command = Command::new(examples.join(name));
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command
}

fn bundled(name: &str) -> (RgbaImage, Camera) {
    let image = image::open(Path::new(IMAGES).join(name))
        .unwrap()
        .to_rgba8();
    let camera = Camera::load(Path::new(IMAGES).join("camera_info.yaml")).unwrap();
    (image, camera)
}

fn located(model: &Model, image: &RgbaImage, camera: &Camera) -> Estimate {
    let device = Arc::new(Device::open(&AdapterRequest::new(None, None)).unwrap());
    let output = Output {
        mask: true,
        mask_only: false,
    };
    let mut locator = Locator::on_gpu(device, model, Precision::F32).unwrap();
    locator.locate(image, camera, output).unwrap()
}

/// The same in a texture that is sRGB, as the example's.
fn located_in_texture(model: &Model, image: &RgbaImage, camera: &Camera) -> Estimate {
    let device = Arc::new(Device::open(&AdapterRequest::new(None, None)).unwrap());
    let texture = device.wgpu().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d {
            width: image.width(),
            height: image.height(),
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8UnormSrgb,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    });
    let layout = wgpu::TexelCopyBufferLayout {
        bytes_per_row: Some(4 * image.width()),
        ..Default::default()
    };
    let to = texture.as_image_copy();
    device
        .queue()
        .write_texture(to, image, layout, texture.size());
    let options = HostOptions::default();
    let mut locator = HostLocator::new(Arc::clone(&device), model, options).unwrap();
    let view = texture.create_view(&Default::default());
    locator.set_source(0, &Source::new(view, *camera)).unwrap();
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    locator.encode(&mut encoder).unwrap();
    locator.read_back(&mut encoder, 0).unwrap();
    device.queue().submit([encoder.finish()]);
    let located = locator.wait(Duration::from_secs(60)).unwrap().unwrap();
    located.estimates[0].clone()
}

#[test]
fn headless_host_prints_the_joints() {
    let output = example("headless_host").output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    let model = Model::load(WEIGHTS).unwrap();
    let image = bundled("ur5_1.jpg").0;
    let camera = Camera::from_hfov(image.width(), image.height(), 70_f64.to_radians());
    let expected = located_in_texture(&model, &image, &camera);
    assert!(text.starts_with("Found"), "{text}");
    for (line, joint) in text.lines().skip(1).zip(&expected.joints) {
        let (name, xyz) = line.split_once(':').unwrap();
        assert_eq!(name.trim(), joint.name);
        let found: Vec<f64> = xyz.split_whitespace().flat_map(str::parse).collect();
        for (found, expected) in found.iter().zip(joint.xyz_m) {
            // Printed in millimetres.
            assert!((found - expected).abs() < 0.001, "{line}: {expected}");
        }
    }
    assert_eq!(text.lines().count(), 7, "{text}");
    // Drivers decode sRGB to within half a step of eight bits: a pixel of the mask more or less, which is a
    // centimetre or two. Negative control: another picture is farther off.
    let farthest = |image: &RgbaImage| {
        let other = located(&model, image, &camera);
        let distance = |(a, b): (&Joint, &Joint)| DVec3::from(a.xyz_m).distance(b.xyz_m.into());
        let pairs = expected.joints.iter().zip(&other.joints);
        pairs.map(distance).fold(0.0, f64::max)
    };
    assert!(farthest(&image) < 0.03);
    assert!(farthest(&bundled("ur5_2.jpg").0) > 0.1);
}

#[test]
fn headless_host_says_what_is_wrong() {
    for (image, weights, word) in [
        ("nowhere.jpg", WEIGHTS, "No such file"),
        (WEIGHTS, WEIGHTS, "format"),
    ] {
        let output = example("headless_host").args([image, weights]).output();
        let output = output.unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains(word), "{text}");
    }
}

/// An X server without a screen, whose picture is a file.
struct Screen {
    server: Child,
    display: String,
    file: PathBuf,
    _folder: tempfile::TempDir,
}

impl Screen {
    const SIZE: [u32; 2] = [640, 480];

    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let [width, height] = Self::SIZE;
        let mut server = Command::new("Xvfb")
            .args(["-displayfd", "1", "-nolisten", "tcp"])
            .args(["-screen", "0", &format!("{width}x{height}x24"), "-fbdir"])
            .arg(folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("Xvfb is needed: scripts/install --tests installs it");
        // It finds a free display, and says which once it is ready.
        let mut number = String::new();
        let output = server.stdout.as_mut().unwrap();
        BufReader::new(output).read_line(&mut number).unwrap();
        let display = format!(":{}", number.trim());
        Self {
            server,
            display,
            file: folder.path().join("Xvfb_screen0"),
            _folder: folder,
        }
    }

    /// What it shows (X's window dump format).
    fn picture(&self) -> Option<RgbImage> {
        let bytes = std::fs::read(&self.file).ok()?;
        let word = |index: usize| {
            let bytes = bytes.get(4 * index..4 * index + 4)?;
            Some(u32::from_be_bytes(bytes.try_into().ok()?) as usize)
        };
        let (header, row, colours) = (word(0)?, word(12)?, word(19)?);
        let pixels = bytes.get(header + 12 * colours..)?;
        let [width, height] = Self::SIZE;
        (pixels.len() >= row * height as usize).then(|| {
            RgbImage::from_fn(width, height, |x, y| {
                let at = y as usize * row + 4 * x as usize;
                Rgb([pixels[at + 2], pixels[at + 1], pixels[at]])
            })
        })
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

fn decoded(value: u8) -> f32 {
    let v = f32::from(value) / 255.0;
    if v <= 0.04045 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    }
}

fn encoded(v: f32) -> f32 {
    if v <= 0.003_130_8 {
        12.92 * v
    } else {
        1.055 * v.powf(1.0 / 2.4) - 0.055
    }
}

/// What the window should show beside the spheres: the picture, half of it tinted where it is surely robot.
/// `None` near a sphere.
fn expected(
    model: &Model,
    (image, camera): &(RgbaImage, Camera),
    estimate: &Estimate,
    tinted: bool,
) -> Vec<Option<[f32; 3]>> {
    let mask = estimate.mask.as_ref().unwrap();
    let mask = mask_image(mask, &model.description.camera, camera, None);
    let near = |x: u32, y: u32| {
        estimate.joints.iter().any(|joint| {
            let [u, v] = joint.px;
            let radius = 0.03 * camera.intrinsics.fx / joint.xyz_m[2] * 1.2 + 3.0;
            (f64::from(x) - u).hypot(f64::from(y) - v) < radius
        })
    };
    let pixels = image.enumerate_pixels().map(|(x, y, pixel)| {
        let share = if tinted {
            0.5 * f32::from(mask.get_pixel(x, y).0[0]) / 255.0
        } else {
            0.0
        };
        let tint = [1.0, 0.15, 0.05];
        let colour = [0, 1, 2].map(|c| decoded(pixel.0[c]) * (1.0 - share) + tint[c] * share);
        (!near(x, y)).then_some(colour.map(encoded))
    });
    pixels.collect()
}

/// Mean difference of the colours, in [0, 1].
fn off(screen: &RgbImage, expected: &[Option<[f32; 3]>], width: u32) -> f32 {
    let mut sum = (0.0, 0);
    for (at, colour) in expected.iter().enumerate() {
        let found = screen.get_pixel(at as u32 % width, at as u32 / width).0;
        for (found, expected) in found.iter().zip(colour.iter().flatten()) {
            sum.0 += (f32::from(*found) / 255.0 - expected).abs();
            sum.1 += 1;
        }
    }
    sum.0 / sum.1 as f32
}

/// What the overlay's window shows when it plays `source`, once that is within `bound` of `wanted`.
fn played(source: &Path, wanted: &[Option<[f32; 3]>], width: u32, bound: f32) -> RgbImage {
    let screen = Screen::new();
    let mut window = example("overlay")
        .arg(source)
        .env("DISPLAY", &screen.display)
        .env_remove("WAYLAND_DISPLAY")
        .spawn()
        .unwrap();
    let start = Instant::now();
    let picture = loop {
        let picture = screen.picture();
        let found = picture.as_ref().map(|p| off(p, wanted, width));
        if let Some(status) = window.try_wait().unwrap() {
            panic!("the window closed: {status}");
        }
        if found.is_some_and(|found| found < bound) {
            break picture.unwrap();
        }
        assert!(start.elapsed() < Duration::from_secs(120), "{found:?}");
        std::thread::sleep(Duration::from_millis(200));
    };
    let _ = window.kill();
    let _ = window.wait();
    picture
}

#[test]
fn overlay_shows_mask_and_joints_in_its_window() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["ur5_1.jpg", "camera_info.yaml"] {
        std::fs::copy(Path::new(IMAGES).join(name), folder.path().join(name)).unwrap();
    }
    let model = Model::load(WEIGHTS).unwrap();
    let shown = bundled("ur5_1.jpg");
    let width = shown.0.width();
    let estimate = located(&model, &shown.0, &shown.1);
    assert_eq!(estimate.status, Status::Found);
    let wanted = expected(&model, &shown, &estimate, true);
    let picture = played(folder.path(), &wanted, width, 0.004);

    // Negative controls: without the tint, and another picture.
    let plain = expected(&model, &shown, &estimate, false);
    let right = off(&picture, &wanted, width);
    let untinted = off(&picture, &plain, width);
    assert!(untinted > 3.0 * right, "{untinted} {right}");
    let other = expected(&model, &bundled("ur5_2.jpg"), &estimate, true);
    assert!(off(&picture, &other, width) > 0.05);

    // The nearest joint's sphere hides the others: it has its own colour, lit from above.
    let nearest = |a: &&(usize, _), b: &&(usize, &whereabot::cascade::Joint)| {
        let [a, b]: [&whereabot::cascade::Joint; 2] = [a.1, b.1];
        a.xyz_m[2].total_cmp(&b.xyz_m[2])
    };
    let joints: Vec<_> = estimate.joints.iter().enumerate().collect();
    let (index, joint) = joints.iter().min_by(nearest).unwrap();
    let along = *index as f32 / 5.0;
    let colour = [
        2.0 - 3.0 * along,
        1.0 - (2.0 * along - 1.0).abs(),
        3.0 * along - 1.0,
    ];
    let [u, v] = joint.px.map(|v| v.round() as u32);
    let found = picture.get_pixel(u, v).0;
    for (found, colour) in found.iter().zip(colour) {
        let lit = encoded(colour.clamp(0.0, 1.0) * 0.80);
        assert!(
            (f32::from(*found) / 255.0 - lit).abs() < 0.1,
            "{found} {lit}"
        );
    }
}

#[test]
fn overlay_plays_a_video() {
    let folder = tempfile::tempdir().unwrap();
    let camera = folder.path().join("camera_info.yaml");
    std::fs::copy(Path::new(IMAGES).join("camera_info.yaml"), camera).unwrap();
    // Two seconds of one picture, then two of another, which the window has to come to.
    let second = |name| {
        std::fs::read(Path::new(IMAGES).join(name))
            .unwrap()
            .repeat(50)
    };
    let video = folder.path().join("video.mjpeg");
    std::fs::write(&video, [second("ur5_2.jpg"), second("ur5_1.jpg")].concat()).unwrap();

    let model = Model::load(WEIGHTS).unwrap();
    let shown = bundled("ur5_1.jpg");
    let width = shown.0.width();
    let estimate = located(&model, &shown.0, &shown.1);
    let wanted = expected(&model, &shown, &estimate, true);
    // ffmpeg's decoder makes other colours of the same JPEG, by a step or two.
    let picture = played(&video, &wanted, width, 0.015);
    // Negative control: without the tint.
    let plain = expected(&model, &shown, &estimate, false);
    let [right, untinted] = [&wanted, &plain].map(|wanted| off(&picture, wanted, width));
    assert!(untinted > 1.5 * right, "{untinted} {right}");
}

#[test]
fn overlay_says_what_is_wrong() {
    let empty = tempfile::tempdir().unwrap();
    let empty = empty.path().to_str().unwrap();
    let path = std::env::var("PATH").unwrap();
    for (source, path, word) in [
        ("nowhere", path.as_str(), "nowhere"),
        (empty, &path, "no images"),
        (WEIGHTS, &path, "ffmpeg gives no more frames"),
        (WEIGHTS, empty, "ffmpeg plays videos, and is not installed"),
    ] {
        let output = example("overlay").arg(source).env("PATH", path).output();
        let output = output.unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && text.contains(word), "{text}");
    }
}
