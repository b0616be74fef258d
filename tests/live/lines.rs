//! JSON Lines: what a slow reader misses is counted, one that leaves is told of.

use std::io::{self, Write};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use glam::{DAffine3, DMat3, DVec3};
use serde_json::{Value, json};
use whereabot::calibration::{CameraPose, FusedJoint};
use whereabot::live::{Event, EventKind, Fused, Lines, Named, NamedRig, Sink, Statistics};

/// A reader that reads when it is told to.
struct Slow {
    go: Receiver<()>,
    read: Arc<Mutex<Vec<u8>>>,
}

impl Write for Slow {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // Whoever told it left: no more waiting.
        let _ = self.go.recv();
        self.read.lock().unwrap().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn slow() -> (Slow, Sender<()>, Arc<Mutex<Vec<u8>>>) {
    let (go, told) = channel();
    let read = Arc::new(Mutex::new(Vec::new()));
    let output = Slow {
        go: told,
        read: Arc::clone(&read),
    };
    (output, go, read)
}

fn lines(output: impl Write + Send + 'static) -> Lines {
    let named = Named {
        camera: "a \"quoted\" name".into(),
        robot: "cube".into(),
    };
    Lines::new(vec![named], output, |_| {})
}

fn event() -> Event {
    Event {
        at: SystemTime::now(),
        camera: Some(0),
        kind: EventKind::Live,
    }
}

fn statistics() -> Statistics {
    Statistics {
        at: SystemTime::now(),
        cameras: Vec::new(),
    }
}

/// How many lines the last statistics say were lost, and how many events were read.
fn account(read: &[u8]) -> (u64, u64) {
    let text = std::str::from_utf8(read).unwrap();
    assert!(text.ends_with('\n'));
    let lines: Vec<Value> = text
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let events = lines.iter().filter(|line| line["type"] == "event");
    let statistics = lines.iter().rfind(|line| line["type"] == "statistics");
    let lost = statistics.unwrap()["lines_lost"].as_u64().unwrap();
    (lost, events.count() as u64)
}

#[test]
fn a_slow_reader_holds_nobody_up_and_learns_what_it_missed() {
    for count in [3000, 10] {
        let (output, go, read) = slow();
        let mut lines = lines(output);
        let start = Instant::now();
        for _ in 0..count {
            lines.event(&event());
        }
        assert!(start.elapsed() < Duration::from_secs(2));
        // It reads on, and there is room again.
        drop(go);
        while read.lock().unwrap().len() < 500 {
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(100));
        lines.statistics(&statistics());
        drop(lines);
        let (lost, events) = account(&read.lock().unwrap());
        assert_eq!(lost + events, count);
        // With the negative control: few lines are all written.
        assert_eq!(lost > 0, count == 3000);
    }
}

#[test]
fn results_that_nobody_reads_leave_room_for_what_changed() {
    let (output, go, read) = slow();
    let mut lines = lines(output).with_rigs(vec![NamedRig {
        rig: "cell".into(),
        cameras: vec![0],
        joints: Vec::new(),
    }]);
    let fused = Fused {
        rig: 0,
        time_s: 1.0,
        joints: Vec::new(),
        poses: Vec::new(),
    };
    for _ in 0..3000 {
        lines.fused(&fused);
    }
    for _ in 0..500 {
        lines.event(&event());
    }
    lines.statistics(&statistics());
    drop(go);
    while read.lock().unwrap().len() < 100_000 {
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(lines);
    let (lost, events) = account(&read.lock().unwrap());
    assert_eq!(events, 500);
    // Negative control: results were lost before.
    assert!((1900..2000).contains(&lost), "{lost}");
}

#[test]
fn a_reader_that_never_reads_does_not_keep_us() {
    let (output, _go, read) = slow();
    let mut lines = lines(output);
    lines.event(&event());
    let start = Instant::now();
    drop(lines);
    assert!(start.elapsed() < Duration::from_secs(1));
    assert!(read.lock().unwrap().is_empty());
}

#[test]
fn an_output_that_fails_is_told_of_once() {
    struct Broken;
    impl Write for Broken {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let (sender, told) = channel();
    let mut lines = Lines::new(Vec::new(), Broken, move |error| {
        sender.send(error.kind()).unwrap();
    });
    lines.event(&event());
    let kind = told.recv_timeout(Duration::from_secs(5)).unwrap();
    assert_eq!(kind, io::ErrorKind::BrokenPipe);
    // What comes later is of no interest to anybody.
    lines.event(&event());
}

#[test]
fn what_a_rig_sees_names_its_cameras_and_joints() {
    let (output, go, read) = slow();
    let named = |camera: &str| Named {
        camera: camera.into(),
        robot: "cube".into(),
    };
    let rig = NamedRig {
        rig: "cell".into(),
        cameras: vec![1, 0, 2],
        joints: vec!["elbow".into()],
    };
    let mut lines =
        Lines::new(vec![named("a"), named("b"), named("c")], output, |_| {}).with_rigs(vec![rig]);
    let pose = |x| CameraPose {
        first_from_camera: DAffine3::from_translation(DVec3::new(x, 0.0, 0.0)),
        covariance: [[0.0; 6]; 6],
        inlier_share: 1.0,
    };
    let joint = FusedJoint {
        xyz_m: DVec3::new(0.5, -0.25, 2.0),
        covariance: DMat3::from_diagonal(DVec3::new(0.01, 0.04, 0.25)),
        cameras: 2,
    };
    lines.fused(&Fused {
        rig: 0,
        time_s: 12.5,
        joints: vec![joint],
        // Nothing is known yet of the second of its cameras, which is `a`.
        poses: vec![Some(pose(0.0)), None, Some(pose(1.5))],
    });
    drop(go);
    drop(lines);
    let line: Value = serde_json::from_slice(&read.lock().unwrap()).unwrap();
    let still = [0.0, 0.0, 0.0, 1.0];
    let expected = json!({
        "schema": 1, "type": "fused", "rig": "cell", "acquired_s": 12.5, "frame": "camera_optical", "of": "b",
        "joints": [{"name": "elbow", "xyz_m": [0.5, -0.25, 2.0], "sigma_m": [0.1, 0.2, 0.5], "cameras": 2}],
        "cameras": [
            {"camera": "b", "translation_m": [0.0, 0.0, 0.0], "rotation_xyzw": still},
            {"camera": "c", "translation_m": [1.5, 0.0, 0.0], "rotation_xyzw": still}],
    });
    assert_eq!(line, expected);
}
