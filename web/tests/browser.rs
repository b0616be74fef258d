//! The page in a real Chromium, on its software adapter: what it finds is what the reference finds natively.
//! `web/test` builds the page and runs this.
#![cfg(not(target_arch = "wasm32"))]
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

#[path = "../../tests/chromium/mod.rs"]
mod chromium;
mod server;

use std::path::{Path, PathBuf};
use std::time::Duration;

use base64::prelude::*;
use chromium::Page;
use image::imageops::{FilterType, resize, rotate90};
use image::{ImageFormat, RgbaImage};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::benchmark::Report;
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Locator, Output, Status};
use whereabot::draw::mask_image;
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
        let address = server::serve(vec![files.path().into(), dist.into()]);
        let webcam = format!("--use-file-for-fake-video-capture={}", webcam.display());
        let page = Page::open(&[
            "--enable-unsafe-webgpu",
            "--use-webgpu-adapter=swiftshader",
            // With these, videos go to textures and WebGPU to canvases; else the GPU process falls.
            "--enable-features=Vulkan",
            "--use-vulkan=swiftshader",
            "--use-angle=swiftshader",
            "--use-fake-device-for-media-stream",
            "--use-fake-ui-for-media-stream",
            &webcam,
        ]);
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
        self.go("empty");
        self.load_engine(engine, model);
    }

    fn load_engine(&mut self, engine: &str, model: &[u8]) {
        std::fs::write(self.files.path().join("model"), model).unwrap();
        self.page.run(&format!(
            "const {{ open }} = await import('/engine.js');
             window.engine = (await open(document.createElement('canvas'), '{engine}')).engine;
             const model = await (await fetch('/model')).arrayBuffer();
             await engine.load(new Uint8Array(model), 'model');"
        ));
    }

    /// What an element says.
    fn text(&mut self, id: &str) -> String {
        let text = self
            .page
            .run(&format!("return document.getElementById('{id}').innerText"));
        text.as_str().unwrap().to_owned()
    }

    fn wait_for(&mut self, id: &str, text: &str) {
        let element = format!("document.getElementById('{id}').innerText");
        self.page.wait_until(&format!("{element} === '{text}'"));
    }

    fn click(&mut self, id: &str) {
        self.page
            .run(&format!("document.getElementById('{id}').click()"));
    }

    /// What a button copies.
    fn copied(&mut self, button: &str) -> String {
        let permissions = json!({"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]});
        self.page.call("Browser.grantPermissions", permissions);
        self.click(button);
        self.wait_for(button, "Copied");
        let copied = self.page.run("return await navigator.clipboard.readText()");
        copied.as_str().unwrap().to_owned()
    }

    /// The table of joints is that of a bundled picture, as far as decoders of JPEG agree.
    fn check_positions(&mut self, robot: &str, name: &str) {
        let image = image::open(picture(name)).unwrap().into_rgba8();
        let error = self.error_of_positions(&locate_natively(&weights(robot), &image, HFOV));
        assert!(error < 0.02, "{name}: {error} m");
    }

    /// How far the table of joints is from `expected`, in metres.
    fn error_of_positions(&mut self, expected: &Estimate) -> f64 {
        let rows = self.page.run(
            "return Array.from(document.querySelectorAll('#positions tbody tr'),
                (row) => Array.from(row.cells, (cell) => cell.innerText))",
        );
        let rows: Vec<[String; 4]> = serde_json::from_value(rows).unwrap();
        assert_eq!(rows.len(), expected.joints.len());
        let mut error = 0.0_f64;
        for ([name, xyz @ ..], joint) in rows.iter().zip(&expected.joints) {
            assert_eq!(*name, joint.name.replace('_', " "));
            for (shown, metres) in xyz.iter().zip(joint.xyz_m) {
                let shown: f64 = shown.parse().unwrap();
                error = error.max((shown - metres).abs());
            }
        }
        error
    }

    /// In place of the page's own weights for the UR5.
    fn replace_weights(&self, model: &[u8]) {
        let folder = self.files.path().join("weights");
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("ur5.safetensors"), model).unwrap();
    }

    /// Gives the page a camera that sees `image`, and after `turn()` the same from a right angle.
    fn plug_in_camera(&mut self, image: &RgbaImage) {
        let png = self.files.path().join("picture");
        image.save_with_format(png, ImageFormat::Png).unwrap();
        self.page.run(
            "const picture = await createImageBitmap(await (await fetch('/picture')).blob());
             const { width, height } = picture;
             const canvas = Object.assign(document.createElement('canvas'), { width, height });
             const context = canvas.getContext('2d');
             const draw = () => context.drawImage(picture, 0, 0);
             window.turn = () => {
                 Object.assign(canvas, { width: height, height: width });
                 context.setTransform(0, 1, -1, 0, height, 0);
                 draw();
             };
             // A canvas gives a frame for each time that it is drawn on.
             setInterval(draw, 50);
             navigator.mediaDevices.getUserMedia = async () => {
                 const stream = canvas.captureStream();
                 [window.track] = stream.getVideoTracks();
                 return stream;
             }",
        );
    }

    /// Into a folder of Cargo's, for people.
    fn save_screenshot(&mut self, name: &str) {
        let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.png"));
        std::fs::write(&file, self.page.screenshot(&Value::Null)).unwrap();
        println!("{}", file.display());
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
        let reference = locate_natively(model, &self.pixels, HFOV);
        assert_eq!(reference.status, Status::Found);
        assert_eq!(self.status, "found");
        let (joints, mask) = self.error(&reference);
        println!("joints within {joints:.1e} m, mask within {mask:.1e}");
        // The kinematic fit makes up to some twenty times of what roundings bring joints apart.
        assert!(joints <= 1e-3 && mask <= 1e-4);
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
    let (joints, mask) = on_gpu.error(&locate_natively(&model, &other, HFOV));
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
fn a_gpu_that_fails_gives_an_error_and_no_answer() {
    let model = small(&weights("ur5"));
    let mut bench = Bench::open();
    let locate = "const source = await createImageBitmap(new ImageData(64, 64));
                  return await engine.locate(source, 64, 64, 70).then(JSON.stringify, String)";

    // A browser without an adapter: no GPU is made up, and where none is insisted on, plain Rust runs.
    bench.go("empty");
    let open = "GPU.prototype.requestAdapter = async () => null;
                const { open } = await import('/engine.js');
                const canvas = document.createElement('canvas')";
    let wanted = format!("{open}; return await open(canvas, 'gpu').then(JSON.stringify, String)");
    let either = format!("{open}; return (await open(canvas)).why");
    for script in [wanted, either] {
        let answer = bench.page.run(&script);
        assert!(answer.as_str().unwrap().contains("no adapter"), "{answer}");
    }

    // A picture of another size than is said, which ends nothing: the next one is searched.
    bench.go_with_engine("gpu", &model);
    let smaller = locate.replace("64, 64, 70", "64, 65, 70");
    let answer = bench.page.run(&smaller);
    let why = "expected 64 x 65 pixels, found 64 x 64";
    assert!(answer.as_str().unwrap().contains(why), "{answer}");
    let answer = bench.page.run(locate);
    assert!(answer.as_str().unwrap().contains("status"), "{answer}");

    // A browser that does not understand a kernel.
    bench.go("empty");
    bench.page.run(
        "const { createShaderModule } = GPUDevice.prototype;
         GPUDevice.prototype.createShaderModule = function (descriptor) {
             const code = descriptor.code.replaceAll('workgroup_size', 'workgroup_sighs');
             return createShaderModule.call(this, { ...descriptor, code });
         }",
    );
    bench.load_engine("gpu", &model);
    let answer = bench.page.run(locate);
    assert!(answer.as_str().unwrap().contains("validation"), "{answer}");

    // A device that is lost.
    bench.go("empty");
    bench.page.run(
        "const { requestDevice } = GPUAdapter.prototype;
         GPUAdapter.prototype.requestDevice = async function (descriptor) {
             return (window.device = await requestDevice.call(this, descriptor));
         }",
    );
    bench.load_engine("gpu", &model);
    let answer = bench.page.run(locate);
    assert!(answer.as_str().unwrap().contains("status"), "{answer}");
    bench.page.run("device.destroy()");
    let answer = bench.page.run(locate);
    assert!(answer.as_str().unwrap().contains("lost"), "{answer}");
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
fn the_page_holds_the_gpu_to_plain_rust() {
    let mut bench = Bench::open();
    bench.replace_weights(&small(&weights("ur5")));
    bench.go("?engine=gpu");
    bench.wait_for("status", "UR5 found");
    bench.click("verify");
    bench
        .page
        .wait_until("!document.getElementById('copy-line').hidden");
    let verdict = bench.text("verdict");
    assert!(
        verdict.contains(" agrees on google swiftshader"),
        "{verdict}"
    );
    let checks = verdict.split(" checks agree").next().unwrap();
    let count = checks.rsplit(' ').next().unwrap();
    assert!(count.parse::<u32>().unwrap() > 30, "{verdict}");
    assert_eq!(bench.copied("copy-line"), verdict);
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

#[test]
fn a_camera_that_is_turned_is_searched_as_it_is_then() {
    let model = small(&weights("ur5"));
    let image = image::open(picture("ur5_3")).unwrap().into_rgba8();
    let turned = rotate90(&image);
    // Along the longer side, which lies from left to right at first, the camera sees the same.
    let hfov = 60.0;
    let upright = 51.1;
    let squashed = resize(&turned, image.width(), image.height(), FilterType::Triangle);
    let expected = locate_natively(&model, &turned, upright);
    // Negative controls: what is found without following the turn, in pixels or in angle.
    let others = [
        locate_natively(&model, &image, hfov),
        locate_natively(&model, &squashed, hfov),
        locate_natively(&model, &turned, hfov),
    ];

    let mut bench = Bench::open();
    bench.replace_weights(&model);
    for engine in ["gpu", "cpu"] {
        bench.go(&format!("?engine={engine}"));
        bench.wait_for("status", "UR5 found");
        bench.plug_in_camera(&image);
        bench.click("camera");
        bench.wait_for("degrees", "69.4°");
        bench.page.run(&format!(
            "document.getElementById('hfov').value = {hfov};
             document.getElementById('hfov').dispatchEvent(new Event('input'))"
        ));
        bench
            .page
            .wait_until("Number(document.getElementById('rate').innerText) > 0");

        bench.page.run("turn()");
        let shown = "document.getElementById('joints')";
        bench
            .page
            .wait_until(&format!("{shown}.width < {shown}.height"));
        assert_eq!(bench.text("degrees"), format!("{upright}°"));
        let size = "const { width, height } = document.getElementById('picture');
                    return [width, height]";
        assert_eq!(
            bench.page.run(size),
            json!([turned.width(), turned.height()])
        );
        let error = bench.error_of_positions(&expected);
        let errors = others
            .each_ref()
            .map(|other| bench.error_of_positions(other));
        println!("{engine}: within {error:.3} m, others {errors:.3?} m");
        assert!(error < 0.02 && errors.iter().all(|error| *error > 0.04));
    }
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

#[test]
fn a_camera_that_is_unplugged_is_not_shown_as_live() {
    let mut bench = Bench::open();
    bench.replace_weights(&small(&weights("ur5")));
    bench.go("?engine=cpu");
    bench.wait_for("status", "UR5 found");
    let image = image::open(picture("ur5_3")).unwrap().into_rgba8();
    bench.plug_in_camera(&image);
    bench.click("camera");
    let is_live = "Number(document.getElementById('rate').innerText) > 0
                   && !document.querySelector('.live').hidden
                   && !document.getElementById('positions').hidden";
    bench.page.wait_until(is_live);
    assert_eq!(bench.text("status"), "UR5 found");

    // To a page, what it stops itself has not ended.
    bench.page.run(
        "track.stop();
         track.dispatchEvent(new Event('ended'))",
    );
    // A search that was under way is done by then, and says nothing any more.
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(bench.text("status"), "No camera");
    assert_eq!(bench.text("caption"), "the camera has ended");
    assert!(bench.text("notice").contains("its last picture"));
    assert_eq!(bench.text("rate"), "–");
    for (what, expected) in [("#positions", true), (".live", true), ("#notice", false)] {
        let hidden = format!("return document.querySelector('{what}').hidden");
        assert_eq!(bench.page.run(&hidden), expected, "{what}");
    }

    // Plugged in again it is searched again.
    bench.click("camera");
    bench.page.wait_until(is_live);
    assert_eq!(bench.text("status"), "UR5 found");
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

#[test]
fn the_page_on_the_gpu_shows_what_was_found() {
    let mut bench = Bench::open();
    bench.page.resize(1280, 800, 1, "light");
    bench.go("?engine=gpu");
    bench.wait_for("status", "UR5 found");
    assert_eq!(bench.text("engine"), "google swiftshader");
    bench.save_screenshot("desktop");

    // The picture alone, pixel by pixel.
    bench.page.run(
        "document.getElementById('view').style = 'position: fixed; inset: 0; width: 512px; height: 424px; z-index: 1';
         for (const id of ['joints', 'caption']) document.getElementById(id).hidden = true;
         await new Promise(requestAnimationFrame)",
    );
    let clip = json!({"x": 0, "y": 0, "width": 512, "height": 424, "scale": 1});
    let shown = bench.page.screenshot(&clip);
    let shown = image::load_from_memory(&shown).unwrap().into_rgb8();
    let image = image::open(picture("ur5_3")).unwrap().into_rgba8();
    let camera = Camera::from_hfov(512, 424, HFOV.to_radians());
    let model = weights("ur5");
    let mask = locate_natively(&model, &image, HFOV).mask.unwrap();
    let canonical = Model::from_bytes(&model, "model")
        .unwrap()
        .description
        .camera;
    let mask = mask_image(&mask, &canonical, &camera, None);
    let mean_error = |strength: f32| {
        let pixels = shown.pixels().zip(image.pixels()).zip(mask.pixels());
        let errors = pixels.flat_map(|((shown, pixel), mask)| {
            let share = strength * f32::from(mask.0[0]) / 255.0;
            let tint = [0.0, 0.86, 0.43].map(|v| 255.0 * v);
            [0, 1, 2].map(|i| {
                let value = f32::from(pixel.0[i]);
                (f32::from(shown.0[i]) - (value + (tint[i] - value) * share)).abs()
            })
        });
        errors.sum::<f32>() / shown.as_raw().len() as f32
    };
    // Decoders of JPEG differ by a step or two.
    assert!(mean_error(0.5) < 1.5, "{}", mean_error(0.5));
    assert!(mean_error(0.0) > 3.0, "{}", mean_error(0.0));
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

#[test]
fn the_page_works_on_a_phone_without_webgpu() {
    let mut bench = Bench::open();
    let gone = json!({"source": "delete Navigator.prototype.gpu"});
    bench
        .page
        .call("Page.addScriptToEvaluateOnNewDocument", gone);
    bench.page.resize(390, 844, 2, "dark");
    bench.go("");
    bench.wait_for("status", "UR5 found");
    bench
        .page
        .wait_until("document.getElementById('notice').innerText.includes('no WebGPU')");
    let fits = "document.documentElement.scrollWidth <= innerWidth";
    assert_eq!(bench.page.run(&format!("return {fits}")), true);
    bench.save_screenshot("phone");
    bench.check_positions("ur5", "ur5_3");

    bench
        .page
        .run("document.querySelector('[value=ur10]').click()");
    bench.wait_for("status", "UR10 found");
    bench.check_positions("ur10", "ur10_1");

    let jpeg = picture("no_robot");
    std::fs::copy(jpeg, bench.files.path().join("no_robot.jpg")).unwrap();
    bench.page.run(
        "const blob = await (await fetch('/no_robot.jpg')).blob();
         const files = new DataTransfer();
         files.items.add(new File([blob], 'no_robot.jpg', { type: 'image/jpeg' }));
         document.getElementById('image').files = files.files;
         document.getElementById('image').dispatchEvent(new Event('change'))",
    );
    bench.wait_for("status", "No robot");

    bench
        .page
        .run("document.querySelector('[value=ur5]').click()");
    let mirrored = "return document.getElementById('view').className === 'mirrored'";
    assert_eq!(bench.page.run(mirrored), false);
    // A camera whose pictures cannot be shown is let go of.
    bench.page.run(
        "const { play } = HTMLMediaElement.prototype;
         HTMLMediaElement.prototype.play = async function () {
             HTMLMediaElement.prototype.play = play;
             [window.track] = this.srcObject.getTracks();
             throw new Error('not now');
         };
         document.getElementById('camera').click()",
    );
    bench
        .page
        .wait_until("window.track?.readyState === 'ended'");
    bench.page.run(
        "MediaStreamTrack.prototype.getSettings = () => ({ facingMode: 'user' });
         document.getElementById('camera').click()",
    );
    bench.wait_for("status", "UR5 found");
    bench
        .page
        .wait_until("Number(document.getElementById('rate').innerText) > 0");
    assert_eq!(bench.page.run(mirrored), true);
    bench.click("pause");

    bench.click("measure");
    bench
        .page
        .wait_until("!document.getElementById('copy').hidden");
    let report = Report::from_json(bench.copied("copy").as_bytes()).unwrap();
    assert_eq!(
        (
            report.adapter.backend.as_str(),
            report.weights.robot.as_str()
        ),
        ("rust", "ur5")
    );
    let rows = bench
        .page
        .run("return document.querySelectorAll('#layers tbody tr').length");
    assert_eq!(rows, report.layers.len());
    assert!(bench.page.faults.is_empty(), "{:?}", bench.page.faults);
}

fn joints_in(answer: &Value) -> Vec<[f64; 3]> {
    let joints = answer["joints"].as_array().unwrap().iter();
    joints
        .map(|joint| serde_json::from_value(joint["xyz_m"].clone()).unwrap())
        .collect()
}

/// By a camera that sees `hfov` degrees from left to right.
fn locate_natively(model: &[u8], image: &RgbaImage, hfov: f64) -> Estimate {
    let model = Model::from_bytes(model, "model").unwrap();
    let camera = Camera::from_hfov(image.width(), image.height(), hfov.to_radians());
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
