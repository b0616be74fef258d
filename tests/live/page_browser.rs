//! The local page in a real Chromium: what it shows is what it was told, and never the past for the present.
//! Screenshots are left in the target folder's tmp; `docs/watch.jpg` is one of them.
#![cfg(feature = "live")]

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use crate::chromium::Page;
use image::imageops::FilterType;
use serde_json::{Value, json};
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Joint, Mask, Status};
use whereabot::live::page::{CameraInfo, Server};
use whereabot::live::warning::{State, Warning, Why};
use whereabot::live::{Event, EventKind, Observation, Rates, Sink, Statistics};

const JOINTS: [&str; 6] = [
    "shoulder_pan",
    "shoulder_lift",
    "elbow",
    "wrist_1",
    "wrist_2",
    "wrist_3",
];
/// Names of cameras, and the bundled pictures that they see.
const CAMERAS: [(&str, &str); 4] = [
    ("bench", "ur5_1"),
    ("gate", "ur5_4"),
    ("headset", "ur3_2"),
    ("cart", "no_robot"),
];

/// A program that watches four cameras at ten frames a second each, until it is dropped.
struct Program {
    server: Option<Server>,
    feeder: Option<JoinHandle<()>>,
    ended: Arc<AtomicBool>,
}

impl Program {
    fn start(poses: [Option<[[f64; 4]; 4]>; 4]) -> Self {
        let truth: Value = serde_json::from_slice(&read("tests/data/samples/truth.json")).unwrap();
        let infos = CAMERAS
            .iter()
            .zip(poses)
            .map(|((name, picture), pose)| CameraInfo {
                name: (*name).to_owned(),
                robot: if picture.starts_with("ur3") {
                    "ur3"
                } else {
                    "ur5"
                }
                .to_owned(),
                canonical: Camera::from_hfov(256, 212, HFOV.to_radians()).intrinsics,
                common_from_camera: pose,
            });
        let server = Server::bind("127.0.0.1:0", infos.collect()).unwrap();
        let mut sink = server.sink();
        let observations: Vec<_> = (0..)
            .zip(CAMERAS)
            .map(|(camera, (_, name))| observed(camera, name, &truth))
            .collect();
        let ended = Arc::new(AtomicBool::new(false));
        let stop = ended.clone();
        let feeder = std::thread::spawn(move || {
            let at = SystemTime::now();
            for camera in 0..CAMERAS.len() {
                sink.event(&Event {
                    at,
                    camera: Some(camera),
                    kind: EventKind::Live,
                });
            }
            let mut warn = |rule: &str, camera, state, distance_m, why| {
                sink.event(&warning(rule, camera, state, distance_m, why));
            };
            warn("bench cell", Some(0), State::Clear, Some(1.04), None);
            warn("wearer", Some(2), State::Warn, Some(0.58), None);
            warn("loading door", None, State::Stop, Some(0.31), None);
            warn(
                "cart arm",
                Some(3),
                State::Unknown,
                None,
                Some(Why::NotFound),
            );
            let mut frame = 0;
            while !stop.load(Ordering::Relaxed) {
                for observation in &observations {
                    let now = Instant::now();
                    let age = Duration::from_millis(60 + 7 * observation.camera as u64);
                    sink.observation(&Observation {
                        frame,
                        acquired: SystemTime::now(),
                        acquired_at: now.checked_sub(age).unwrap_or(now),
                        answered_at: now,
                        ..observation.clone()
                    });
                }
                if frame % 10 == 0 {
                    sink.statistics(&statistics(frame));
                }
                frame += 1;
                std::thread::sleep(Duration::from_millis(100));
            }
        });
        Self {
            server: Some(server),
            feeder: Some(feeder),
            ended,
        }
    }

    fn tell(&self, event: &Event) {
        self.server.as_ref().unwrap().sink().event(event);
    }

    fn url(&self) -> String {
        self.server.as_ref().unwrap().url()
    }

    fn end(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        self.feeder.take().map(JoinHandle::join);
        self.server = None;
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.end();
    }
}

/// That of the bundled pictures, in degrees.
const HFOV: f64 = 70.1;

/// What an answer without fault says of a bundled picture.
fn observed(camera: usize, name: &str, truth: &Value) -> Observation {
    let image = image::open(repository(&format!("examples/images/{name}.jpg")))
        .unwrap()
        .into_rgba8();
    let view = Camera::from_hfov(image.width(), image.height(), HFOV.to_radians());
    let joints: Vec<[f64; 3]> = match truth.get(name) {
        Some(truth) => serde_json::from_value(truth["joints_m"].clone()).unwrap(),
        None => Vec::new(),
    };
    let probability = if joints.is_empty() {
        vec![0.0; 256 * 212]
    } else {
        let mask = image::open(repository(&format!("tests/data/samples/{name}.mask.png"))).unwrap();
        let mask = mask
            .resize_exact(256, 212, FilterType::Triangle)
            .into_luma8();
        mask.pixels()
            .map(|pixel| f32::from(pixel.0[0]) / 255.0)
            .collect()
    };
    let joints = JOINTS.iter().zip(joints).map(|(name, xyz_m)| Joint {
        name: (*name).to_owned(),
        xyz_m,
        px: view.project(xyz_m).unwrap(),
    });
    let joints: Vec<_> = joints.collect();
    Observation {
        file: None,
        camera,
        frame: 0,
        acquired: SystemTime::now(),
        acquired_at: Instant::now(),
        answered_at: Instant::now(),
        image: Arc::new(image),
        view,
        estimate: Estimate {
            status: if joints.is_empty() {
                Status::NotFound
            } else {
                Status::Found
            },
            coverage: 0.1,
            bbox_px: None,
            field: 1.0,
            joints,
            mask: Some(Mask {
                width: 256,
                height: 212,
                probability,
            }),
        },
    }
}

fn warning(
    rule: &str,
    camera: Option<usize>,
    state: State,
    distance_m: Option<f64>,
    why: Option<Why>,
) -> Event {
    Event {
        at: SystemTime::now(),
        camera,
        kind: EventKind::Warning(Warning {
            rule: rule.to_owned(),
            state,
            before: None,
            acts_as: state,
            acted_as: None,
            distance_m,
            uncertainty_m: None,
            why,
            frame_number: None,
            latency_ms: None,
        }),
    }
}

fn statistics(frame: u64) -> Statistics {
    let cameras = (0..CAMERAS.len() as u64).map(|camera| Rates {
        frames_per_s: [30.0, 25.0, 30.0, 10.0][camera as usize],
        answers_per_s: 9.6 + 0.1 * camera as f64,
        dropped: 2 * frame + camera,
        age_p50: Some(Duration::from_millis(60 + 7 * camera)),
        age_p99: Some(Duration::from_millis(92 + 11 * camera)),
    });
    Statistics {
        at: SystemTime::now(),
        cameras: cameras.collect(),
    }
}

/// Counts what a page asks for, how often for tiles that it is owed, the tones it makes, and what its security policy kept
/// from it.
const COUNTERS: &str = "{
    window.counts = { asked: 0, owed: 0, tones: 0, violations: [] };
    const { fetch } = window;
    window.fetch = (url, ...how) => {
        counts.asked++;
        counts.owed += url.includes('&owed=');
        return fetch(url, ...how);
    };
    const { start } = OscillatorNode.prototype;
    OscillatorNode.prototype.start = function (...when) { counts.tones++; return start.apply(this, when); };
    document.addEventListener('securitypolicyviolation', ({ blockedURI }) => counts.violations.push(blockedURI));
}";

fn open(program: &Program, width: u32, height: u32, scale: u32, theme: &str) -> Page {
    let mut page = Page::open(&["--disable-gpu"]);
    page.call(
        "Page.addScriptToEvaluateOnNewDocument",
        json!({"source": COUNTERS}),
    );
    page.resize(width, height, scale, theme);
    page.go(&program.url());
    page.wait_until("document.querySelectorAll('.caption:not([hidden])').length === 4");
    page.wait_until("document.querySelector('[data-rate=answers]').innerText === '9.6'");
    page
}

/// Into a folder of Cargo's, for people.
fn save_screenshot(page: &mut Page, name: &str) {
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.png"));
    std::fs::write(&file, page.screenshot(&Value::Null)).unwrap();
    println!("{}", file.display());
}

fn check(page: &mut Page) {
    assert_eq!(page.run("return counts.violations"), json!([]));
    assert!(page.faults.is_empty(), "{:?}", page.faults);
    let fits = "return document.documentElement.scrollWidth <= innerWidth";
    assert_eq!(page.run(fits), true);
}

/// Runs `expression` of the pixel at joint `joint` of camera `camera`, `[r, g, b]`.
fn pixel_at_joint(page: &mut Page, camera: usize, [x, y]: [f64; 2]) -> [u8; 3] {
    let pixel = page.run(&format!(
        "const canvas = document.querySelectorAll('.view canvas')[{camera}];
         const scale = Math.min(canvas.width / 512, canvas.height / 424);
         const [left, top] = [(canvas.width - scale * 512) / 2, (canvas.height - scale * 424) / 2];
         const at = [left + ({x} + 0.5) * scale, top + ({y} + 0.5) * scale].map(Math.round);
         return Array.from(canvas.getContext('2d').getImageData(...at, 1, 1).data).slice(0, 3)"
    ));
    serde_json::from_value(pixel).unwrap()
}

fn near(a: [u8; 3], b: [u8; 3], by: u8) -> bool {
    a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= by)
}

#[test]
fn a_laptop_shows_what_was_found() {
    let program = Program::start([None; 4]);
    let mut page = open(&program, 1440, 900, 1, "light");
    let captions = page.run(
        "return Array.from(document.querySelectorAll('.caption'), (caption) => caption.innerText)",
    );
    let truth: Value = serde_json::from_slice(&read("tests/data/samples/truth.json")).unwrap();
    let nearest = |name: &str| {
        let joints: Vec<[f64; 3]> =
            serde_json::from_value(truth[name]["joints_m"].clone()).unwrap();
        let away = joints
            .iter()
            .map(|xyz| xyz.iter().map(|v| v * v).sum::<f64>().sqrt());
        format!(
            "{} found · nearest joint {:.2} m",
            name[..3].to_uppercase(),
            away.fold(f64::INFINITY, f64::min)
        )
    };
    assert_eq!(
        captions,
        json!([
            nearest("ur5_1"),
            nearest("ur5_4"),
            nearest("ur3_2"),
            "no robot"
        ])
    );

    // The table is of the camera that is shown in space.
    page.wait_until("document.querySelectorAll('#positions tbody tr').length === 6");
    page.run("document.querySelectorAll('.view')[1].click()");
    let rows = page.run("return Array.from(document.querySelectorAll('#positions tbody tr'), (row) => row.cells[3].innerText)");
    let depths = truth["ur5_4"]["joints_m"].as_array().unwrap().iter();
    let depths: Vec<_> = depths
        .map(|xyz| format!("{:.2}", xyz[2].as_f64().unwrap()))
        .collect();
    assert_eq!(rows, json!(depths));

    // A joint has its colour on the picture, the mask its tint, the rest the picture's colours.
    let elbow = observed(0, "ur5_1", &truth).estimate.joints[2].px;
    assert!(near(pixel_at_joint(&mut page, 0, elbow), [255, 225, 60], 3));
    let picture = image::open(repository("examples/images/ur5_1.jpg"))
        .unwrap()
        .into_rgb8();
    let mask = image::open(repository("tests/data/samples/ur5_1.mask.png"))
        .unwrap()
        .into_luma8();
    let (mut tinted, mut plain) = (0, 0);
    for (x, y) in [(60, 60), (440, 60), (60, 380), (440, 380)] {
        let shown = pixel_at_joint(&mut page, 0, [f64::from(x), f64::from(y)]);
        if mask.get_pixel(x, y).0[0] == 0 && near(shown, picture.get_pixel(x, y).0, 40) {
            plain += 1;
        }
    }
    let joints = observed(0, "ur5_1", &truth).estimate.joints;
    let joints: Vec<_> = joints.iter().map(|joint| joint.px).collect();
    let is_free = |x: u32, y: u32| {
        joints
            .iter()
            .all(|px| (px[0] - f64::from(x)).hypot(px[1] - f64::from(y)) > 20.0)
    };
    for (x, y, value) in mask.enumerate_pixels().step_by(251) {
        if value.0[0] == 255 && is_free(x, y) && tinted < 5 {
            let [red, green, blue] = picture.get_pixel(x, y).0;
            let [r, g, b] = pixel_at_joint(&mut page, 0, [f64::from(x), f64::from(y)]);
            let greener = i32::from(g) * 2 - i32::from(r) - i32::from(b);
            let before = i32::from(green) * 2 - i32::from(red) - i32::from(blue);
            tinted += i32::from(greener > before + 40);
        }
    }
    assert!(plain >= 3 && tinted >= 3, "{plain} plain, {tinted} tinted");

    let alarms = page.run("return Array.from(document.querySelectorAll('#alarms li'), (alarm) => `${alarm.className} ${alarm.querySelector('.rule').innerText}`)");
    assert_eq!(
        alarms,
        json!([
            "stop loading door, at 0.31 m",
            "warn wearer · headset, at 0.58 m",
            "unknown cart arm · cart, no robot where one is expected",
            "clear bench cell · bench, at 1.04 m"
        ])
    );
    assert_eq!(page.run("return document.title"), "STOP · whereabot");
    page.run("document.querySelectorAll('.view')[0].click(); document.activeElement.blur()");
    std::thread::sleep(Duration::from_millis(500));
    save_screenshot(&mut page, "watch-laptop");
    check(&mut page);
}

#[test]
fn a_pause_stops_the_traffic_and_a_lost_program_is_never_clear() {
    let mut program = Program::start([None; 4]);
    let mut page = open(&program, 1440, 900, 1, "dark");
    let veils =
        "Array.from(document.querySelectorAll('.veil:not([hidden])'), (veil) => veil.innerText)";
    let states = "Array.from(document.querySelectorAll('#alarms li'), (alarm) => alarm.className)";
    // A picture is veiled if it is older than a second, as it may be on a busy machine.
    page.wait_until(&format!("{veils}.length === 0"));

    page.run("document.getElementById('sound').click()");
    page.wait_until("counts.tones > 2");

    page.wait_until("counts.asked > 5");
    page.run("document.getElementById('pause').click()");
    std::thread::sleep(Duration::from_millis(300));
    let asked = page.run("return counts.asked").as_u64().unwrap();
    let tones = page.run("return counts.tones");
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(page.run("return counts.asked"), asked);
    assert_eq!(page.run("return counts.tones"), tones);
    assert_eq!(
        page.run(&format!("return {veils}")),
        json!(vec!["paused"; 4])
    );
    assert_eq!(
        page.run(&format!("return {states}")),
        json!(vec!["unknown"; 4])
    );
    page.run("document.getElementById('pause').click()");
    page.wait_until(&format!("{states}.join() === 'stop,warn,unknown,clear'"));
    page.wait_until(&format!("{veils}.length === 0"));
    page.wait_until(&format!("counts.asked > {asked} + 3"));
    check(&mut page);

    program.end();
    page.wait_until(&format!(
        "{states}.join() === 'unknown,unknown,unknown,unknown'"
    ));
    page.wait_until("!document.getElementById('notice').hidden");
    assert_eq!(
        page.run(&format!("return {veils}")),
        json!(vec!["no connection"; 4])
    );
    assert_eq!(page.run("return document.title"), "UNKNOWN · whereabot");
    save_screenshot(&mut page, "watch-lost");
    check(&mut page);
}

#[test]
fn a_screen_reader_hears_what_is_new_and_nothing_twice() {
    let program = Program::start([None; 4]);
    let mut page = open(&program, 1440, 900, 1, "light");
    // A screen reader says what is written into these, the last one apart: that is the control.
    page.run(
        "window.said = {};
         for (const id of ['connected', 'notice', 'spoken', 'rate']) {
             said[id] = [];
             const element = document.getElementById(id);
             const note = () => said[id].push(element.textContent);
             new MutationObserver(note).observe(element, { childList: true, characterData: true, subtree: true });
         }",
    );
    page.wait_until("said.rate.length > 2");
    for id in ["connected", "notice", "spoken"] {
        assert_eq!(page.run(&format!("return said.{id}")), json!([]), "{id}");
    }
    let status = "return Array.from(document.querySelectorAll('[role=status]'), ({ id }) => id)";
    assert_eq!(page.run(status), json!(["connected"]));
    // Who sees sees the rate in its place.
    let shown = "return [connected.className, rate.hidden, rate.innerText]";
    assert_eq!(
        page.run(shown),
        json!(["spoken", false, "4 cameras · 39/s"])
    );

    // Two rules stop, one after the other; the same again at another distance is nothing new.
    for distance_m in [0.3, 0.2] {
        let stop = warning("bench cell", Some(0), State::Stop, Some(distance_m), None);
        program.tell(&stop);
        let shown = format!("at {distance_m:.2} m");
        let alarms = "document.getElementById('alarms').innerText";
        page.wait_until(&format!("{alarms}.includes('{shown}')"));
    }
    let both = "stop: bench cell, stop: loading door";
    assert_eq!(page.run("return said.spoken"), json!([both]));

    program.tell(&Event {
        at: SystemTime::now(),
        camera: None,
        kind: EventKind::DeviceLost {
            reason: "gone".to_owned(),
        },
    });
    page.wait_until("said.notice.length > 0");
    page.run("counts.asked = said.rate.length = 0");
    page.wait_until("counts.asked > 5 && said.rate.length > 1");
    let notices = page.run("return said.notice");
    assert_eq!(notices.as_array().unwrap().len(), 1, "{notices}");
    assert!(
        notices[0].as_str().unwrap().contains("GPU failed"),
        "{notices}"
    );
    assert_eq!(page.run("return said.connected"), json!([]));
    check(&mut page);
}

#[test]
fn a_slow_line_is_no_lost_one_and_shows_nothing_old_as_new() {
    let program = Program::start([None; 4]);
    let mut page = open(&program, 1440, 900, 1, "light");
    page.call("Network.enable", json!({}));
    let line = |page: &mut Page, bytes_per_s: i32| {
        let line = json!({"offline": false, "latency": 0, "downloadThroughput": bytes_per_s, "uploadThroughput": -1});
        page.call("Network.emulateNetworkConditions", line);
    };
    let look = "
        window.looks = { lost: 0, unveiled: 0, oldest: 0, fresh: [0, 0, 0, 0] };
        let before = [];
        setInterval(() => {
            const veils = Array.from(document.querySelectorAll('.veil'));
            looks.lost += document.getElementById('connection').className === 'lost';
            looks.unveiled += veils.some(({ hidden }) => hidden);
            veils.forEach(({ innerText }, camera) => {
                const age = parseInt(innerText);
                if (isNaN(age)) return;
                looks.oldest = Math.max(looks.oldest, age);
                looks.fresh[camera] += age < before[camera];
                before[camera] = age;
            });
        }, 100)";

    // Control: on a fast line nothing is veiled.
    page.wait_until("!document.querySelector('.veil:not([hidden])')");
    // All four pictures take longer than the page waits for a sign of life.
    line(&mut page, 16_000);
    std::thread::sleep(Duration::from_secs(4));
    page.run(look);
    std::thread::sleep(Duration::from_secs(16));
    let looks = page.run("return looks");
    assert_eq!((&looks["lost"], &looks["unveiled"]), (&json!(0), &json!(0)));
    assert!(looks["oldest"].as_u64().unwrap() < 20, "{looks}");
    let is_fresh = |looks: &Value| {
        let fresh = looks["fresh"].as_array().unwrap().iter();
        fresh.map(|count| count.as_u64().unwrap()).min() > Some(0)
    };
    assert!(is_fresh(&looks), "{looks}");
    let states = "Array.from(document.querySelectorAll('#alarms li'), (alarm) => alarm.className)";
    let known = format!("{states}.join() === 'stop,warn,unknown,clear'");
    assert_eq!(page.run(&format!("return {known}")), true);

    // Where alarms would be too old, the page gives up; of the pictures none comes twice, and all in the end.
    line(&mut page, 7_000);
    page.wait_until("counts.owed > 1");
    page.run("looks.fresh.fill(0)");
    page.wait_until("Math.min(...looks.fresh) > 0");

    // Silence is no slow line.
    line(&mut page, 1);
    page.run("looks.lost = 0");
    page.wait_until("looks.lost > 10");
    assert_eq!(
        page.run(&format!("return {states}")),
        json!(vec!["unknown"; 4])
    );
    line(&mut page, -1);
    page.wait_until(&known);
    page.wait_until("!document.querySelector('.veil:not([hidden])')");
}

#[test]
fn a_phone_and_a_keyboard_reach_everything() {
    // Two of the cameras look at the same place from two sides.
    let pose = |angle: f64| {
        let (sin, cos) = angle.to_radians().sin_cos();
        // Optical frame: z forward to the middle, y down.
        Some([
            [-sin, 0.0, cos, -1.2 * cos],
            [cos, 0.0, sin, -1.2 * sin],
            [0.0, -1.0, 0.0, 0.6],
            [0.0, 0.0, 0.0, 1.0],
        ])
    };
    let program = Program::start([pose(0.0), pose(100.0), None, None]);
    let mut page = open(&program, 390, 844, 2, "dark");
    assert_eq!(
        page.run("return document.getElementById('which').value"),
        "all"
    );
    let names =
        "return Array.from(document.getElementById('which').options, (option) => option.innerText)";
    let expected = [
        "all together",
        "from bench",
        "from gate",
        "from headset",
        "from cart",
    ];
    assert_eq!(page.run(names), json!(expected));
    save_screenshot(&mut page, "watch-phone");
    page.run("document.getElementById('space').scrollIntoView({ block: 'center' })");
    std::thread::sleep(Duration::from_millis(300));
    save_screenshot(&mut page, "watch-phone-space");

    // From the top with the tab key: sound, pause, the four cameras, the selector, space.
    let press = |page: &mut Page, key: &str, code: u32, text: &str| {
        for kind in ["keyDown", "keyUp"] {
            let event = json!({"type": kind, "key": key, "windowsVirtualKeyCode": code, "text": if kind == "keyDown" { text } else { "" }});
            page.call("Input.dispatchKeyEvent", event);
        }
    };
    let mut reached = Vec::new();
    for _ in 0..8 {
        press(&mut page, "Tab", 9, "");
        let focus = page.run(
            "return document.activeElement.id || document.activeElement.getAttribute('aria-label')",
        );
        reached.push(focus.as_str().unwrap().to_owned());
    }
    let shows = |name: &str| format!("{name}: show in space");
    let expected = [
        "sound".to_owned(),
        "pause".to_owned(),
        shows("bench"),
        shows("gate"),
        shows("headset"),
        shows("cart"),
        "which".to_owned(),
        "space".to_owned(),
    ];
    assert_eq!(reached, expected);
    let drawing = "document.getElementById('space').toDataURL()";
    page.run("document.querySelectorAll('.view')[2].focus()");
    press(&mut page, "Enter", 13, "\r");
    assert_eq!(
        page.run("return document.querySelectorAll('.view')[2].getAttribute('aria-pressed')"),
        "true"
    );
    assert_eq!(
        page.run("return document.getElementById('which').value"),
        "2"
    );
    page.run(&format!("document.getElementById('pause').click(); document.getElementById('space').focus(); window.before = {drawing}"));
    assert_eq!(page.run(&format!("return before === {drawing}")), true);
    press(&mut page, "ArrowLeft", 37, "");
    assert_eq!(page.run(&format!("return before === {drawing}")), false);
    check(&mut page);
}

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn read(path: &str) -> Vec<u8> {
    std::fs::read(repository(path)).unwrap()
}
