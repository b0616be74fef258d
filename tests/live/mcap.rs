//! MCAP recordings: what independent readers find in them, and what becomes of them when a disk is full, stalls, or nobody
//! closes the file.
#![cfg(feature = "live")]

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::mpsc::{self, Receiver};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use image::{Rgba, RgbaImage};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::camera::{Camera, Distortion, Intrinsics};
use whereabot::cascade::{Estimate, Joint, Mask, Status};
use whereabot::draw::mask_image;
use whereabot::live::mcap::{McapError, RecordedCamera, Recorder};
use whereabot::live::{Event, EventKind, Observation, Rates, Sink, Statistics};

const CANONICAL: Intrinsics = Intrinsics {
    fx: 8.0,
    fy: 8.0,
    cx: 7.5,
    cy: 5.5,
};
const JOINTS: [&str; 3] = ["shoulder_pan", "elbow", "wrist_1"];

fn cameras() -> Vec<RecordedCamera> {
    ["left wrist", "2nd"]
        .map(|name| RecordedCamera {
            name: name.into(),
            robot: "ur5".into(),
            joints: JOINTS.map(String::from).into(),
            canonical: CANONICAL,
        })
        .into()
}

/// The two cameras' names in topics and frames.
const NAMES: [&str; 2] = ["left_wrist", "_2nd"];

/// Half past midnight on 2 January 1970, and so many milliseconds.
fn at(milliseconds: u64) -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(88_200) + Duration::from_millis(milliseconds)
}

fn view(camera: usize) -> Camera {
    let (k, p) = ([-0.2, 0.05, 0.001, 0.0, 0.0, 0.0], [0.002, -0.001]);
    let distortion = [
        Distortion::Rational { k, p },
        Distortion::Equidistant {
            k: [0.1, 0.01, 0.0, 0.0],
        },
    ];
    Camera {
        distortion: distortion[camera],
        ..Camera::from_hfov(40, 30, 1.4)
    }
}

/// Frame `frame` of `camera`; every third shows no robot.
fn observation(camera: usize, frame: u64) -> Observation {
    let found = frame % 3 != 2;
    let view = view(camera);
    let image = RgbaImage::from_fn(view.width, view.height, |x, y| {
        Rgba([4 * x as u8, 6 * y as u8, (16 * frame) as u8, 255])
    });
    let joints = JOINTS.iter().enumerate().map(|(index, name)| Joint {
        name: (*name).into(),
        xyz_m: [
            0.1 * index as f64,
            -0.25,
            1.0 / 3.0 + frame as f64 + camera as f64,
        ],
        px: [0.0; 2],
    });
    let ramp = (0..16 * 12).map(|at| (at % 16) as f32 / 15.0);
    let acquired_at = Instant::now();
    Observation {
        file: None,
        camera,
        frame,
        acquired: at(100 * frame + camera as u64),
        acquired_at,
        answered_at: acquired_at + Duration::from_millis(40),
        image: Arc::new(image),
        view,
        estimate: Estimate {
            status: if found {
                Status::Found
            } else {
                Status::NotFound
            },
            coverage: 0.125,
            bbox_px: found.then_some([1.5, 2.0, 30.0, 20.0]),
            field: 0.75,
            joints: joints.filter(|_| found).collect(),
            mask: Some(Mask {
                width: 16,
                height: 12,
                probability: ramp.collect(),
            }),
        },
    }
}

fn event(camera: Option<usize>, kind: EventKind) -> Event {
    Event {
        at: at(5_000),
        camera,
        kind,
    }
}

fn statistics() -> Statistics {
    let rates = Rates {
        frames_per_s: 30.0,
        answers_per_s: 12.5,
        dropped: 7,
        age_p50: Some(Duration::from_millis(40)),
        age_p99: None,
    };
    Statistics {
        at: at(6_000),
        cameras: vec![rates; 2],
    }
}

/// One at a time: the first makes the environment.
fn reader(options: &[&str], file: &Path) -> Output {
    static READER: Mutex<()> = Mutex::new(());
    let _one = READER.lock().unwrap_or_else(|e| e.into_inner());
    Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mcap/read"))
        .args(options)
        .arg(file)
        .output()
        .unwrap()
}

/// What independent readers find.
fn read(options: &[&str], file: &Path) -> Vec<Value> {
    let output = reader(options, file);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    found["messages"].as_array().unwrap().clone()
}

fn on<'a>(messages: &'a [Value], topic: &str) -> Vec<&'a Value> {
    let of = |message: &&Value| message["topic"] == *topic;
    messages.iter().filter(of).collect()
}

fn stamp(time: SystemTime) -> Value {
    let since = time.duration_since(UNIX_EPOCH).unwrap();
    json!({"sec": since.as_secs(), "nanosec": since.subsec_nanos()})
}

fn nanoseconds(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64
}

fn picture(message: &Value) -> (String, image::DynamicImage) {
    let data: Vec<u8> = serde_json::from_value(message["data"].clone()).unwrap();
    let format = message["format"].as_str().unwrap().to_owned();
    (format, image::load_from_memory(&data).unwrap())
}

fn equal(what: &str, found: &Value, expected: &Value) -> Result<(), String> {
    (found == expected)
        .then_some(())
        .ok_or_else(|| format!("{what}: {found}, expected {expected}"))
}

/// The only message of this frame on the topic `name` of its camera, with the right times.
fn message<'a>(messages: &'a [Value], put: &Observation, name: &str) -> Result<&'a Value, String> {
    let topic = format!("/{}/{name}", NAMES[put.camera]);
    let of = |message: &&&Value| {
        message["sequence"] == put.frame && message["log_time"] == nanoseconds(put.acquired)
    };
    let found: Vec<_> = on(messages, &topic);
    let found: Vec<_> = found.iter().filter(of).collect();
    let [found] = found[..] else {
        return Err(format!("{} messages on {topic}", found.len()));
    };
    equal("publish_time", &found["publish_time"], &found["log_time"])?;
    Ok(&found["message"])
}

/// Holds what was recorded of an observation to the observation.
fn check(messages: &[Value], put: &Observation) -> Result<(), String> {
    let optical = format!("{}_optical", NAMES[put.camera]);
    let header = json!({"stamp": stamp(put.acquired), "frame_id": optical});
    let of = |name| -> Result<&Value, String> {
        let found = message(messages, put, name)?;
        equal("header", &found["header"], &header)?;
        Ok(found)
    };

    let (format, image) = picture(of("image/compressed")?);
    equal("format", &json!(format), &json!("jpeg"))?;
    let rgb = image.to_rgb8();
    if rgb.dimensions() != put.image.dimensions() {
        return Err(format!("an image of {:?}", rgb.dimensions()));
    }
    let differences = rgb
        .pixels()
        .zip(put.image.pixels())
        .flat_map(|(a, b)| (0..3).map(|channel| f64::from(a[channel].abs_diff(b[channel]))));
    let mean = differences.sum::<f64>() / (3.0 * 40.0 * 30.0);
    if mean > 2.0 {
        return Err(format!("the image differs by {mean} grey levels"));
    }

    let (format, mask) = picture(of("mask/compressed")?);
    equal("format", &json!(format), &json!("png"))?;
    let expected = mask_image(
        put.estimate.mask.as_ref().unwrap(),
        &CANONICAL,
        &put.view,
        None,
    );
    if mask.as_luma8() != Some(&expected) {
        return Err("another mask".into());
    }

    let Intrinsics { fx, fy, cx, cy } = put.view.intrinsics;
    let (model, d) = match put.view.distortion {
        Distortion::Rational { k, p } => ("plumb_bob", vec![k[0], k[1], p[0], p[1], k[2]]),
        Distortion::Equidistant { k } => ("equidistant", k.to_vec()),
        Distortion::None => ("plumb_bob", vec![0.0; 5]),
        other => return Err(format!("not a case here: {other:?}")),
    };
    let expected = json!({
        "header": header, "height": put.view.height, "width": put.view.width,
        "distortion_model": model, "d": d,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": false},
    });
    equal("camera_info", of("camera_info")?, &expected)?;

    let places: Vec<Value> = put
        .estimate
        .joints
        .iter()
        .map(|joint| json!({"x": joint.xyz_m[0], "y": joint.xyz_m[1], "z": joint.xyz_m[2]}))
        .collect();
    let poses = of("joint_poses")?["poses"].as_array().unwrap();
    let positions: Vec<Value> = poses.iter().map(|pose| pose["position"].clone()).collect();
    equal("poses", &json!(positions), &json!(places))?;

    let markers = message(messages, put, "joints")?["markers"]
        .as_array()
        .unwrap();
    for marker in markers {
        equal("header", &marker["header"], &header)?;
    }
    let kinds: Vec<_> = markers.iter().map(|m| [&m["type"], &m["action"]]).collect();
    if places.is_empty() {
        equal("markers", &json!(kinds), &json!([[0, 3]]))?;
    } else {
        let expected = json!([[4, 0], [7, 0], [9, 0], [9, 0], [9, 0]]);
        equal("markers", &json!(kinds), &expected)?;
        equal("line", &markers[0]["points"], &json!(places))?;
        equal("spheres", &markers[1]["points"], &json!(places))?;
        for (index, marker) in markers[2..].iter().enumerate() {
            equal("text", &marker["text"], &json!(JOINTS[index]))?;
            equal("text", &marker["pose"]["position"], &places[index])?;
        }
        let ids: Vec<_> = markers.iter().map(|marker| &marker["id"]).collect();
        equal("ids", &json!(ids), &json!([0, 1, 2, 3, 4]))?;
    }

    let status = &of("status")?["status"][0];
    let (level, word) = match put.estimate.status {
        Status::Found => (0, "found"),
        Status::NotFound => (1, "not found"),
        Status::Invalid => (2, "invalid"),
    };
    equal("level", &status["level"], &json!(level))?;
    equal("message", &status["message"], &json!(word))?;
    let mut values = vec![
        json!({"key": "robot", "value": "ur5"}),
        json!({"key": "frame", "value": put.frame.to_string()}),
        json!({"key": "age_ms", "value": "40"}),
        json!({"key": "coverage", "value": "0.125"}),
        json!({"key": "field", "value": "0.75"}),
    ];
    if put.estimate.bbox_px.is_some() {
        values.push(json!({"key": "bbox_px", "value": "1.5 2 30 20"}));
    }
    equal("values", &status["values"], &json!(values))
}

/// Waits up to ten seconds.
fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !done() {
        assert!(begin.elapsed() < Duration::from_secs(10), "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Ends a second, and waits until it is written or fails: a busy machine may be too slow for what is left to the end.
fn second(recorder: &mut Recorder, len: impl Fn() -> usize, room: usize) {
    let before = len();
    recorder.statistics(&statistics());
    wait_for("a second", || len() > before || len() == room);
}

/// A disk.
#[derive(Clone, Default)]
struct Disk {
    kept: Arc<Mutex<Vec<u8>>>,
    /// Bytes that it takes, if there is an end.
    room: Option<usize>,
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut kept = self.kept.lock().unwrap();
        let room = self.room.map_or(usize::MAX, |room| room - kept.len());
        let taken = bytes.len().min(room);
        kept.extend(&bytes[..taken]);
        if taken == 0 && !bytes.is_empty() {
            return Err(ErrorKind::StorageFull.into());
        }
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Disk {
    fn len(&self) -> usize {
        self.kept.lock().unwrap().len()
    }

    fn save(&self, folder: &TempDir) -> PathBuf {
        let file = folder.path().join("kept.mcap");
        std::fs::write(&file, &*self.kept.lock().unwrap()).unwrap();
        file
    }
}

#[test]
fn independent_readers_find_what_was_recorded() {
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("out.mcap");
    let mut recorder = Recorder::create(&file, &cameras()).unwrap();
    let mut put: Vec<Observation> = (0..4)
        .flat_map(|frame| [observation(0, frame), observation(1, frame)])
        .collect();
    put[3].estimate.status = Status::Invalid;
    put[3].estimate.joints.clear();
    recorder.event(&event(Some(0), EventKind::Live));
    put.iter().for_each(|put| recorder.observation(put));
    let len = || std::fs::metadata(&file).unwrap().len() as usize;
    second(&mut recorder, len, usize::MAX);
    let failed = EventKind::Failed {
        reason: "no route to host".into(),
        retry_in: Some(Duration::from_millis(1_500)),
    };
    recorder.event(&event(Some(1), failed));
    let lost = EventKind::DeviceLost {
        reason: "hung".into(),
    };
    recorder.event(&event(None, lost));
    recorder.finish().unwrap();
    assert_eq!(recorder.unrecorded(), 0);

    let messages = read(&[], &file);
    for put in &put {
        check(&messages, put).unwrap();
    }
    let topics: std::collections::BTreeSet<_> = messages
        .iter()
        .map(|message| message["topic"].as_str().unwrap().to_owned())
        .collect();
    let names = ["image/compressed", "mask/compressed", "camera_info"];
    let names = [&names[..], &["joints", "joint_poses", "status"]].concat();
    let expected = NAMES
        .iter()
        .flat_map(|camera| names.iter().map(move |name| format!("/{camera}/{name}")))
        .chain(["/tf", "/status", "/statistics"].map(String::from));
    assert_eq!(topics, expected.collect());
    // Seven an answer, one a second, one an event, and markers that go where a camera is blind: once for one, twice for all.
    assert_eq!(messages.len(), 7 * put.len() + 1 + 3 + 1 + 2);

    let about = &on(&messages, "/left_wrist/joints")[0]["about"];
    assert_eq!(about["camera"], "left wrist");
    assert_eq!(about["robot"], "ur5");
    assert_eq!(about["joints"], "shoulder_pan elbow wrist_1");

    let transforms = on(&messages, "/tf");
    assert_eq!(transforms.len(), put.len());
    let expected = json!([{
        "header": {"stamp": stamp(put[0].acquired), "frame_id": "left_wrist_link"},
        "child_frame_id": "left_wrist_optical",
        "transform": {
            "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
            "rotation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5},
        },
    }]);
    assert_eq!(transforms[0]["message"]["transforms"], expected);

    let status = on(&messages, "/_2nd/status");
    let status = &status.last().unwrap()["message"]["status"][0];
    assert_eq!(status["level"], 2);
    assert_eq!(status["name"], "2nd: source");
    let values = json!([
        {"key": "reason", "value": "no route to host"},
        {"key": "retry_in_ms", "value": "1500"},
    ]);
    assert_eq!(status["values"], values);
    let all = &on(&messages, "/status")[0]["message"]["status"][0];
    assert_eq!(all["message"], "device lost");
    for name in NAMES {
        let markers = on(&messages, &format!("/{name}/joints"));
        let last = &markers.last().unwrap()["message"]["markers"];
        assert_eq!(last.as_array().unwrap().len(), 1);
        assert_eq!(last[0]["action"], 3);
    }

    let figures = &on(&messages, "/statistics")[0]["message"]["status"];
    assert_eq!(figures.as_array().unwrap().len(), 3);
    assert_eq!(figures[1]["name"], "2nd: rates");
    let values = json!([
        {"key": "frames_per_s", "value": "30"},
        {"key": "answers_per_s", "value": "12.5"},
        {"key": "dropped", "value": "7"},
        {"key": "age_p50_ms", "value": "40"},
    ]);
    assert_eq!(figures[1]["values"], values);
    let recorder = json!([{"key": "unrecorded", "value": "0"}]);
    assert_eq!(figures[2]["values"], recorder);

    // The comparison notices a millimetre, another picture, another mask, a joint too many and a millisecond.
    let wrong = |change: fn(&mut Observation)| {
        let mut put = put[0].clone();
        change(&mut put);
        check(&messages, &put).unwrap_err()
    };
    let noticed = [
        wrong(|put| put.estimate.joints[1].xyz_m[2] += 1e-3),
        wrong(|put| put.image = observation(0, 1).image),
        wrong(|put| put.estimate.mask.as_mut().unwrap().probability[20] = 0.9),
        wrong(|put| put.estimate.joints.truncate(2)),
        wrong(|put| put.acquired += Duration::from_millis(1)),
        wrong(|put| put.view.intrinsics.fx += 1e-9),
        wrong(|put| put.estimate.status = Status::Invalid),
    ];
    let words = [
        "poses",
        "image",
        "mask",
        "poses",
        "messages",
        "camera_info",
        "level",
    ];
    for (noticed, word) in noticed.iter().zip(words) {
        assert!(noticed.contains(word), "{noticed}");
    }
}

#[test]
fn a_corrupted_file_is_noticed() {
    let disk = Disk::default();
    let mut recorder = Recorder::new(disk.clone(), "disk", &cameras()).unwrap();
    recorder.observation(&observation(0, 0));
    second(&mut recorder, || disk.len(), usize::MAX);
    recorder.finish().unwrap();
    let folder = TempDir::new().unwrap();
    read(&[], &disk.save(&folder));

    // A byte of a definition, or of a picture.
    let whole = disk.kept.lock().unwrap().clone();
    for at in [whole.len() / 4, whole.len() / 2] {
        disk.kept.lock().unwrap()[at] ^= 1;
        let output = reader(&[], &disk.save(&folder));
        assert!(!output.status.success(), "byte {at} of {}", whole.len());
        disk.kept.lock().unwrap().clone_from(&whole);
    }
}

#[test]
fn a_full_disk_ends_the_recording_and_leaves_what_can_be_read() {
    const SECONDS: u64 = 6;
    let record = |room| {
        let disk = Disk {
            room,
            ..Disk::default()
        };
        let mut recorder = Recorder::new(disk.clone(), "disk", &cameras()).unwrap();
        for frame in 0..SECONDS {
            recorder.observation(&observation(0, frame));
            recorder.observation(&observation(1, frame));
            second(&mut recorder, || disk.len(), room.unwrap_or(usize::MAX));
        }
        let result = recorder.finish();
        // Once is enough.
        recorder.finish().unwrap();
        (disk, result, recorder.unrecorded())
    };
    let (whole, result, unrecorded) = record(None);
    result.unwrap();
    assert_eq!(unrecorded, 0);

    let room = whole.len() / 2;
    let (full, result, unrecorded) = record(Some(room));
    let error = result.unwrap_err();
    assert!(matches!(error, McapError::Write { .. }), "{error}");
    assert!(error.to_string().contains("disk"), "{error}");
    assert_eq!(full.len(), room);

    let folder = TempDir::new().unwrap();
    let file = full.save(&folder);
    assert!(!reader(&[], &file).status.success());
    let messages = read(&["--recover"], &file);
    // A second of each of the two cameras is a chunk.
    let recorded = on(&messages, "/statistics").len() as u64;
    assert!((1..SECONDS).contains(&recorded), "{recorded}");
    assert_eq!(unrecorded, 2 * (SECONDS - recorded));
    for frame in 0..recorded {
        check(&messages, &observation(0, frame)).unwrap();
        check(&messages, &observation(1, frame)).unwrap();
    }
}

#[test]
fn a_program_that_is_killed_leaves_every_second_that_is_over() {
    let disk = Disk::default();
    let mut recorder = Recorder::new(disk.clone(), "disk", &cameras()).unwrap();
    recorder.observation(&observation(0, 0));
    second(&mut recorder, || disk.len(), usize::MAX);
    wait_for("a whole chunk", || {
        let folder = TempDir::new().unwrap();
        let messages = read(&["--recover"], &disk.save(&folder));
        check(&messages, &observation(0, 0)).is_ok() && on(&messages, "/statistics").len() == 1
    });
}

/// Takes the beginning, then waits until it is told to go on.
struct Stalled {
    begun: bool,
    go_on: Receiver<()>,
}

impl Write for Stalled {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.begun {
            let _ = self.go_on.recv();
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.begun = true;
        Ok(())
    }
}

#[test]
fn a_disk_that_stalls_delays_nobody() {
    let (release, go_on) = mpsc::channel();
    let stalled = Stalled {
        begun: false,
        go_on,
    };
    let mut recorder = Recorder::new(stalled, "disk", &cameras()).unwrap();
    // The first second is flushed, which begins the stall.
    recorder.statistics(&statistics());
    recorder.observation(&observation(0, 0));
    recorder.statistics(&statistics());
    // Two GiB if all were kept, of 64 MiB each.
    let mut large = observation(0, 1);
    large.image = Arc::new(RgbaImage::new(4096, 4096));
    let begin = Instant::now();
    for _ in 0..32 {
        recorder.observation(&large);
        recorder.event(&event(Some(0), EventKind::Stale));
    }
    assert!(
        begin.elapsed() < Duration::from_secs(2),
        "{:?}",
        begin.elapsed()
    );
    let unrecorded = recorder.unrecorded();
    assert!((28..=31).contains(&unrecorded), "{unrecorded}");

    let begin = Instant::now();
    let error = recorder.finish().unwrap_err();
    assert!(matches!(error, McapError::Unfinished { .. }), "{error}");
    assert!(
        begin.elapsed() < Duration::from_secs(5),
        "{:?}",
        begin.elapsed()
    );
    drop(release);
}

#[test]
fn a_file_is_never_overwritten() {
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("out.mcap");
    std::fs::write(&file, "precious").unwrap();
    let error = Recorder::create(&file, &cameras()).err().unwrap();
    assert!(matches!(error, McapError::Taken { .. }), "{error}");
    assert_eq!(std::fs::read(&file).unwrap(), b"precious");

    let nowhere = folder.path().join("none/out.mcap");
    let error = Recorder::create(&nowhere, &cameras()).err().unwrap();
    assert!(matches!(error, McapError::Create { .. }), "{error}");
    assert!(error.to_string().contains("none/out.mcap"), "{error}");
}

#[test]
fn cameras_of_the_same_topics_are_refused() {
    let mut cameras = cameras();
    cameras[1].name = "left-wrist".into();
    let error = Recorder::new(Disk::default(), "disk", &cameras).err();
    let said = error.unwrap().to_string();
    assert!(said.contains("`left wrist` and `left-wrist`"), "{said}");
}
