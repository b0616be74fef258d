//! Four different sources at once: rates, order, freshness, answers.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use image::{DynamicImage, ImageFormat, Rgb, RgbImage};
use serde_json::json;
use whereabot::camera::{Camera, Orientation};
use whereabot::cascade::Status;
use whereabot::live::{Calibration, CameraConfig, EventKind, Location, Observation, Stop};

use super::device::{Judge, engine};
use super::rtsp::Server;
use super::simulated::{Collector, known, watch};

/// Frames a second of all of them.
const RATE: u32 = 10;
const SIZE: (u32, u32) = (64, 48);

/// A video file of so many seconds.
pub fn video(file: &Path, seconds: u32) {
    let made = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-y", "-f", "lavfi", "-i"])
        .arg(format!(
            "testsrc=size={}x{}:rate={RATE}:duration={seconds}",
            SIZE.0, SIZE.1
        ))
        .args(["-c:v", "ffv1"])
        .arg(file)
        .status()
        .expect("ffmpeg is needed: scripts/install --tests installs it");
    assert!(made.success());
}

/// A picture that is mostly red, and another one for each number.
pub fn picture(number: u32) -> RgbImage {
    RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| {
        Rgb([
            (100 + 40 * ((x / 8 + y / 8 + number) % 4)) as u8,
            (5 * number) as u8,
            (2 * x) as u8,
        ])
    })
}

pub fn folder(folder: &Path, count: u32) {
    std::fs::create_dir_all(folder).unwrap();
    for number in 0..count {
        let file = folder.join(format!("{number:03}.png"));
        picture(number).save(file).unwrap();
    }
}

/// A recording without robots; the focal length grows from sample to sample.
fn recording(folder: &Path, count: u32) {
    self::folder(&folder.join("image"), count);
    let header = json!({
        "format": "whereabot-recording", "version": 1, "robot": "cube", "joints": ["a"],
        "width": SIZE.0, "height": SIZE.1, "frame": "camera_optical",
        "source": {"kind": "real", "generator": "test"},
    });
    std::fs::write(folder.join("recording.json"), header.to_string()).unwrap();
    let lines = (0..count).map(|id| {
        let fx = 60 + id;
        json!({
            "id": id, "image": format!("image/{id:03}.png"), "mask": "none.png",
            "intrinsics": {"fx": fx, "fy": fx, "cx": 31.5, "cy": 23.5}, "coverage": 0.0,
        })
        .to_string()
            + "\n"
    });
    let lines: String = lines.collect();
    std::fs::write(folder.join("samples.jsonl"), lines).unwrap();
}

#[test]
fn four_sources_at_once_are_answered_as_single_images() {
    let temporary = tempfile::tempdir().unwrap();
    let path = |name: &str| temporary.path().join(name);
    video(&path("clip.mkv"), 3);
    folder(&path("photos"), 20);
    recording(&path("recorded"), 20);
    let server = Server::new(temporary.path(), "64x48", RATE);

    let cameras = ["clip.mkv", "photos", "recorded", &server.address].map(|source| {
        let location = Location::new(source, temporary.path()).unwrap();
        let mut camera = CameraConfig::new(source.to_owned(), location, known(0));
        camera.calibration = Calibration::Hfov(1.2);
        if camera.location.is_paced() {
            camera.fps = Some(RATE.into());
        }
        camera.repeat = camera.location.ends();
        camera
    });
    let inputs = cameras.iter().map(CameraConfig::input).collect();
    let collector = Collector::default();
    let sinks = vec![Box::new(collector.clone()) as _];
    let stop = Arc::new(Stop::default());
    let (engine, _) = engine(4, true);
    let stopper = {
        let (stop, collector) = (Arc::clone(&stop), collector.clone());
        std::thread::spawn(move || {
            // The stream takes its time to begin.
            for _ in 0..300 {
                std::thread::sleep(Duration::from_millis(100));
                let observations = collector.observations();
                let count = |c| observations.iter().filter(|o| o.camera == c).count();
                if (0..4).all(|camera| count(camera) >= 25) {
                    break;
                }
            }
            stop.set();
        })
    };
    watch(inputs, Box::new(engine), sinks, &stop);
    stopper.join().unwrap();
    drop(server);

    let observations = collector.observations();
    let mut judge = Judge::new();
    let statistics = collector.statistics();
    for camera in 0..4 {
        let of: Vec<&Observation> = observations.iter().filter(|o| o.camera == camera).collect();
        assert!(of.len() >= 25, "camera {camera}: {} answers", of.len());
        // Answers.
        assert!(
            of.iter()
                .all(|o| judge.agrees(o) && o.estimate.mask.is_some())
        );
        assert!(of.iter().all(|o| o.image.dimensions() == SIZE));
        assert!(of.iter().any(|o| o.estimate.status == Status::Found));
        // Order.
        for pair in of.windows(2) {
            assert!(pair[0].frame < pair[1].frame);
            assert!(pair[0].acquired_at <= pair[1].acquired_at);
        }
        // Freshness: within a few frames, also where much else runs.
        let mut ages: Vec<_> = of.iter().map(|o| o.age()).collect();
        ages.sort();
        let median = ages[ages.len() / 2];
        assert!(
            median < Duration::from_millis(500),
            "camera {camera}: {median:?}"
        );
        // Rates.
        let rates: Vec<f64> = statistics
            .iter()
            .map(|s| s.cameras[camera].frames_per_s)
            .filter(|&rate| rate > 0.0)
            .collect();
        let mean = rates.iter().sum::<f64>() / rates.len() as f64;
        assert!((5.0..15.0).contains(&mean), "camera {camera}: {rates:?}");
        let live = (Some(camera), EventKind::Live);
        assert!(collector.events().contains(&live));
    }
    // The pictures are those of the numbers.
    for observation in observations
        .iter()
        .filter(|o| o.camera == 1 || o.camera == 2)
    {
        let number = (observation.frame % 20) as u32;
        let expected = DynamicImage::from(picture(number)).into_rgba8();
        assert_eq!(*observation.image, expected);
        if observation.camera == 2 {
            assert_eq!(observation.view.intrinsics.fx, f64::from(60 + number));
        }
    }
    // Negative control: another frame's answer is not this one's.
    let of_1: Vec<_> = observations.iter().filter(|o| o.camera == 1).collect();
    let mut mixed = of_1[0].clone();
    mixed.image = Arc::clone(&of_1[1].image);
    assert!(!judge.agrees(&mixed));
}

#[test]
fn images_are_turned_upright_and_so_is_their_camera() {
    let temporary = tempfile::tempdir().unwrap();
    folder(&temporary.path().join("photos"), 2);
    let location = Location::new("photos", temporary.path()).unwrap();
    for orientation in super::common::ORIENTATIONS {
        let camera = CameraConfig {
            calibration: Calibration::Hfov(1.2),
            orientation,
            fps: Some(20.0),
            ..CameraConfig::new("turned".into(), location.clone(), known(0))
        };
        let collector = Collector::default();
        let engine = super::simulated::StandIn::new(Duration::from_millis(1), 1);
        let sinks = vec![Box::new(collector.clone()) as _];
        let stop = Arc::new(Stop::default());
        watch(vec![camera.input()], Box::new(engine), sinks, &stop);
        let observations = collector.observations();
        let mut expected = DynamicImage::from(picture(1)).into_rgba8();
        let plain = expected.clone();
        let mut turned = DynamicImage::from(expected);
        turned.apply_orientation(orientation);
        expected = turned.into_rgba8();
        let last = observations.last().unwrap();
        assert_eq!(*last.image, expected, "{orientation:?}");
        let view = Camera::from_hfov(SIZE.0, SIZE.1, 1.2);
        assert_eq!(last.view, view.oriented(orientation));
        // Negative control: it makes a difference.
        let same = *last.image == plain;
        assert_eq!(same, orientation == Orientation::NoTransforms);
    }
}

#[test]
fn a_stream_may_change_its_size() {
    let temporary = tempfile::tempdir().unwrap();
    let file = temporary.path().join("both.ts");
    let mut both = Vec::new();
    for size in ["64x48", "128x96"] {
        let made = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i"])
            .arg(format!("testsrc=size={size}:rate={RATE}:duration=1"))
            .args(["-c:v", "mpeg2video", "-g", "1", "-f", "mpegts", "-"])
            .output()
            .unwrap();
        assert!(made.status.success());
        both.extend(made.stdout);
    }
    std::fs::write(&file, both).unwrap();
    let camera = CameraConfig {
        calibration: Calibration::Hfov(1.2),
        ..CameraConfig::new("both".into(), Location::Video(file), known(0))
    };
    let collector = Collector::default();
    let engine = super::simulated::StandIn::new(Duration::from_millis(1), 1);
    let sinks = vec![Box::new(collector.clone()) as _];
    let stop = Arc::new(Stop::default());
    watch(vec![camera.input()], Box::new(engine), sinks, &stop);
    let observations = collector.observations();
    for size in [(64, 48), (128, 96)] {
        let of = observations.iter().filter(|o| o.image.dimensions() == size);
        let of: Vec<_> = of.collect();
        // A decoder may miss one where two streams meet.
        assert!(of.len() > 3, "{size:?}: {}", of.len());
        // The field of view is the same, the picture is not grey.
        let view = Camera::from_hfov(size.0, size.1, 1.2);
        assert!(of.iter().all(|o| o.view == view));
        let lit = |o: &&Observation| o.image.pixels().any(|p| p.0[0] > 200);
        assert!(of.iter().all(lit));
    }
}

#[test]
fn a_broken_picture_is_passed_over() {
    let temporary = tempfile::tempdir().unwrap();
    let photos = temporary.path().join("photos");
    folder(&photos, 4);
    std::fs::write(photos.join("001.png"), b"no picture").unwrap();
    DynamicImage::from(RgbImage::new(3, 9000))
        .save_with_format(photos.join("002.png"), ImageFormat::Png)
        .unwrap();
    let location = Location::new("photos", temporary.path()).unwrap();
    let camera = CameraConfig {
        fps: Some(50.0),
        ..CameraConfig::new("broken".into(), location, known(0))
    };
    let collector = Collector::default();
    let engine = super::simulated::StandIn::new(Duration::from_millis(1), 1);
    let sinks = vec![Box::new(collector.clone()) as _];
    let stop = Arc::new(Stop::default());
    watch(vec![camera.input()], Box::new(engine), sinks, &stop);
    let reasons: Vec<String> = collector
        .events()
        .into_iter()
        .filter_map(|(_, kind)| match kind {
            EventKind::Failed { reason, .. } => Some(reason),
            _ => None,
        })
        .collect();
    assert!(reasons[0].contains("001.png"), "{reasons:?}");
    assert!(reasons[1].contains("3 x 9000"), "{reasons:?}");
    assert_eq!(collector.observations().len(), 2);
}
