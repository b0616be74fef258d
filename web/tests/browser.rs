//! The page in a real Chromium, on its software adapter: what it finds is what the reference finds natively.
//! `web/test` builds the page and runs this.
#![cfg(not(target_arch = "wasm32"))]
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

mod chromium;
mod server;

use std::path::{Path, PathBuf};

use base64::prelude::*;
use chromium::Page;
use image::{ImageFormat, RgbaImage};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::benchmark::Report;
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Locator, Output, Status};
use whereabot::network::Model;

/// That of the bundled pictures, in degrees.
const HFOV: f64 = 70.1;

/// The page on a server, a webcam, and files for them that go when it does.
struct Bench {
    page: Page,
    address: String,
    files: TempDir,
}

impl Bench {
    fn open() -> Self {
        let dist = repository("web/dist");
        assert!(
            dist.join("index.html").exists(),
            "web/build makes the page first"
        );
        let files = tempfile::tempdir().unwrap();
        let webcam = files.path().join("webcam.mjpeg");
        let frames = ["ur5_1", "ur5_2", "ur5_3"].map(|name| std::fs::read(picture(name)).unwrap());
        std::fs::write(&webcam, frames.concat()).unwrap();
        let address = server::serve(vec![dist.into(), files.path().into()]);
        let page = Page::open(&webcam);
        Self {
            page,
            address,
            files,
        }
    }

    /// Opens the page.
    fn go(&mut self, query: &str) {
        self.page.go(&format!("{}/{query}", self.address));
    }

    /// Opens nothing, with an engine of its own, and a model in it.
    fn go_with_engine(&mut self, engine: &str, model: &[u8]) {
        std::fs::write(self.files.path().join("model"), model).unwrap();
        self.go("empty");
        self.page.run(&format!(
            "const {{ open }} = await import('/engine.js');
             window.engine = (await open(document.createElement('canvas'), '{engine}')).engine;
             const model = await (await fetch('/model')).arrayBuffer();
             await engine.load(new Uint8Array(model), 'model');"
        ));
    }

    /// What the engine of [`Bench::go_with_engine`] says about a picture: an expression in `script` that
    /// `source`, `width` and `height` stand for.
    fn locate(&mut self, source: &str) -> Answer {
        let mut answer = self.page.run(&format!(
            "{source};
             const answer = await engine.locate(source, width, height, {HFOV});
             const canvas = new OffscreenCanvas(width, height);
             canvas.getContext('2d').drawImage(source, 0, 0);
             const png = new Uint8Array(await (await canvas.convertToBlob()).arrayBuffer());
             const mask = Array.from(await engine.probabilities());
             return {{ answer, mask, png: btoa(Array.from(png, (byte) => String.fromCharCode(byte)).join('')) }};"
        ));
        let png = BASE64_STANDARD
            .decode(answer["png"].as_str().unwrap())
            .unwrap();
        Answer {
            pixels: image::load_from_memory_with_format(&png, ImageFormat::Png)
                .unwrap()
                .into_rgba8(),
            mask: serde_json::from_value(answer["mask"].take()).unwrap(),
            status: answer["answer"]["status"].as_str().unwrap().to_owned(),
            joints: joints_in(&answer["answer"]),
        }
    }

    /// Of the bundled picture `name`, without a loss.
    fn locate_picture(&mut self, name: &str) -> Answer {
        let png = self.files.path().join("picture");
        let pixels = image::open(picture(name)).unwrap();
        pixels.save_with_format(png, ImageFormat::Png).unwrap();
        self.locate(
            "const source = await createImageBitmap(await (await fetch('/picture')).blob());
             const { width, height } = source",
        )
    }
}

/// What the page's engine says, and what it was shown.
struct Answer {
    pixels: RgbaImage,
    status: String,
    mask: Vec<f32>,
    joints: Vec<[f64; 3]>,
}

impl Answer {
    /// How far it is from `reference`: joints in metres, probabilities.
    fn error(&self, reference: &Estimate) -> (f64, f32) {
        let expected: Vec<[f64; 3]> = reference.joints.iter().map(|joint| joint.xyz_m).collect();
        let mask = &reference.mask.as_ref().unwrap().probability;
        assert_eq!(
            (self.joints.len(), self.mask.len()),
            (expected.len(), mask.len())
        );
        let joints = self
            .joints
            .as_flattened()
            .iter()
            .zip(expected.as_flattened());
        let masks = self.mask.iter().zip(mask);
        (
            joints.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max),
            masks.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max),
        )
    }

    fn check(&self, model: &[u8]) {
        let reference = locate_natively(model, &self.pixels);
        assert_eq!(reference.status, Status::Found);
        assert_eq!(self.status, "found");
        let (joints, mask) = self.error(&reference);
        println!("joints within {joints:.1e} m, mask within {mask:.1e}");
        assert!(joints <= 1e-4 && mask <= 1e-4);
    }
}

#[test]
fn a_picture_on_the_gpu_and_without_is_found_as_natively() {
    let model = weights("ur5");
    let mut bench = Bench::open();
    bench.go_with_engine("gpu", &model);
    let on_gpu = bench.locate_picture("ur5_1");
    on_gpu.check(&model);

    bench.go_with_engine("cpu", &model);
    bench.locate_picture("ur5_1").check(&model);
    let none = bench.locate_picture("no_robot");
    assert_eq!((none.status.as_str(), none.joints.len()), ("not_found", 0));

    // Negative control: another picture is not within the bounds.
    let other = image::open(picture("ur5_2")).unwrap().into_rgba8();
    let (joints, mask) = on_gpu.error(&locate_natively(&model, &other));
    assert!(joints > 1e-2 && mask > 1e-1);
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

#[test]
fn a_webcam_on_the_gpu_is_found_as_natively() {
    let model = small(&weights("ur5"));
    let mut bench = Bench::open();
    bench.go_with_engine("gpu", &model);
    let webcam = bench.locate(
        "const source = document.createElement('video');
         source.srcObject = await navigator.mediaDevices.getUserMedia({ video: true });
         await source.play();
         source.pause();
         const { videoWidth: width, videoHeight: height } = source",
    );
    webcam.check(&model);
}

#[test]
fn a_benchmark_on_the_gpu_is_one_that_the_program_reads() {
    let mut bench = Bench::open();
    bench.go_with_engine("gpu", &small(&weights("ur5")));
    let json = bench.page.run("return await engine.benchmark(() => {})");
    let report = Report::from_json(json.as_str().unwrap().as_bytes()).unwrap();
    assert_eq!(report.adapter.backend, "webgpu");
    assert!(
        report.adapter.name.contains("swiftshader"),
        "{}",
        report.adapter.name
    );
    assert!(
        report
            .layers
            .iter()
            .any(|layer| layer.layer == "mask.conv1" && layer.ms_p50 > 0.0)
    );
}

#[test]
fn the_page_shows_what_was_found() {
    let mut bench = Bench::open();
    // As a browser without WebGPU.
    bench.page.call(
        "Page.addScriptToEvaluateOnNewDocument",
        json!({"source": "delete Navigator.prototype.gpu"}),
    );
    bench.page.resize(390, 844, 2, "dark");
    bench.go("");
    bench
        .page
        .wait_until("document.getElementById('status').textContent === 'UR5 found'");
}

fn joints_in(answer: &Value) -> Vec<[f64; 3]> {
    let joints = answer["joints"].as_array().unwrap().iter();
    joints
        .map(|joint| serde_json::from_value(joint["xyz_m"].clone()).unwrap())
        .collect()
}

fn locate_natively(model: &[u8], image: &RgbaImage) -> Estimate {
    let model = Model::from_bytes(model, "model").unwrap();
    let camera = Camera::from_hfov(image.width(), image.height(), HFOV.to_radians());
    let output = Output {
        mask: true,
        mask_only: false,
    };
    Locator::on_cpu(&model)
        .locate(image, &camera, output)
        .unwrap()
}

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn picture(name: &str) -> PathBuf {
    repository(&format!("examples/images/{name}.jpg"))
}

fn weights(robot: &str) -> Vec<u8> {
    std::fs::read(repository(&format!("weights/{robot}.safetensors"))).unwrap()
}

/// The same layers and weights at a quarter of the size, which takes a sixteenth of the time; finds a robot
/// in everything.
fn small(model: &[u8]) -> Vec<u8> {
    let (length, rest) = model.split_at(8);
    let (header, tensors) = rest.split_at(u64::from_le_bytes(length.try_into().unwrap()) as usize);
    let mut header: Value = serde_json::from_slice(header).unwrap();
    let metadata = &mut header["__metadata__"][Model::METADATA_KEY];
    let mut description: Value = serde_json::from_str(metadata.as_str().unwrap()).unwrap();
    description["input"] = json!({"width": 64, "height": 64});
    description["camera"] = json!({"fx": 45.0, "fy": 45.0, "cx": 31.5, "cy": 31.5});
    description["presence"]["min_sure"] = json!(0.0);
    *metadata = description.to_string().into();
    let mut header = header.to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    [
        &(header.len() as u64).to_le_bytes(),
        header.as_slice(),
        tensors,
    ]
    .concat()
}
