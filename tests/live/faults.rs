//! What goes wrong with one camera is said, repaired, and no other camera's business.

use std::time::{Duration, Instant};

use serde_json::Value;

use super::program::{Program, fake_ffmpeg, folder, kill, watch};
use super::sources;

/// A camera that `ffmpeg` reads, and one of pictures beside it.
fn config(source: &str) -> String {
    let repeat = if source.contains("://") {
        ""
    } else {
        "repeat = true\n"
    };
    format!(
        "[[camera]]\nname = \"video\"\nsource = \"{source}\"\nweights = \"model.safetensors\"\nhfov = 70\n{repeat}\
         [[camera]]\nname = \"photos\"\nsource = \"photos\"\nweights = \"model.safetensors\"\nhfov = 70\n\
         fps = 20\nrepeat = true\n"
    )
}

const PHOTOS: u32 = 7;

fn start(source: &str, script: Option<&str>) -> (tempfile::TempDir, Program) {
    let folder = folder(&config(source));
    sources::folder(&folder.path().join("photos"), PHOTOS);
    let bin = script.map(|script| fake_ffmpeg(folder.path(), script));
    let program = watch(folder.path(), bin.as_deref());
    (folder, program)
}

/// That the pictures went on all the time: the longest pause between two results.
fn longest_pause(lines: &[Value]) -> f64 {
    let photos = lines.iter().filter(|line| line["type"] == "result");
    let photos = photos.filter(|line| line["camera"] == "photos");
    let times: Vec<f64> = photos.map(|l| l["acquired_s"].as_f64().unwrap()).collect();
    assert!(times.len() > 5);
    let pauses = times.windows(2).map(|pair| pair[1] - pair[0]);
    pauses.fold(0.0, f64::max)
}

fn reason(event: &Value) -> &str {
    event["reason"].as_str().unwrap()
}

#[test]
fn a_frame_that_is_cut_off_is_none() {
    let (_folder, mut program) = start(
        "rtsp://nowhere/x",
        Some("frame 16 12; sleep 0.2; frame 16 12 100"),
    );
    program.wait_for_result("video");
    let failed = program.wait_for_event("video", "failed");
    assert!(
        reason(&failed).contains("in the middle of a frame"),
        "{failed}"
    );
    assert!(failed["retry_in_s"].as_f64().unwrap() > 0.0);
    // It is tried again, and the whole frame counts again.
    program.wait_for_event("video", "live");
    let frame = program.wait_for_result("video")["frame_number"].clone();
    assert_eq!(frame, 1);
    program.wait_for_result("photos");
    assert!(longest_pause(&program.seen) < 2.0);
}

#[test]
fn a_stream_that_is_decoded_too_slowly_is_late() {
    // Each frame was taken three seconds after the last one by the stream's clock, and comes after a tenth of one: then
    // every fourth of a second one of a hundredth.
    let script =
        "for time in 0 3 6 9; do frame 16 12; done; sleep 5; time=9.1; frame 16 12; sleep 30";
    let (_folder, mut program) = start("rtsp://nowhere/x", Some(script));
    let acquired = |line: &Value| line["acquired_s"].as_f64().unwrap();
    program.wait_for("a late frame", |line| {
        line["camera"] == "video" && line["age_ms"].as_f64().is_some_and(|age| age > 4000.0)
    });
    let late = program.seen.last().unwrap().clone();
    let photo = program.wait_for_result("photos");
    let before = acquired(&photo) - acquired(&late);
    assert!(before > 4.0, "{before}");
    // Negative control: the frames before came when they were taken.
    let first = program
        .seen
        .iter()
        .find(|line| line["camera"] == "video" && line["type"] == "result");
    assert!(first.unwrap()["age_ms"].as_f64().unwrap() < 4000.0);

    let script =
        "for time in 0 3 6 9; do frame 16 12; done; sleep 0.3; time=-11; frame 16 12; sleep 30";
    let (_folder, mut program) = start("rtsp://nowhere/x", Some(script));
    let failed = program.wait_for_event("video", "failed");
    assert!(
        reason(&failed).contains("s late: they are not decoded"),
        "{failed}"
    );
    program.wait_for_event("video", "live");
}

#[test]
fn sizes_may_change_but_not_to_anything() {
    let script = "frame 16 12; sleep 0.2; frame 32 24; sleep 0.2; frame 99999 1 10; sleep 20";
    let (_folder, mut program) = start("http://nowhere/x", Some(script));
    program.wait_for_result("video");
    // The same stream goes on.
    program.wait_for_result("video");
    let failed = program.wait_for_event("video", "failed");
    assert!(reason(&failed).contains("99999 x 1"), "{failed}");
    let failures = program.seen.iter().filter(|l| l["event"] == "failed");
    assert_eq!(failures.count(), 1);
}

#[test]
fn errors_are_passed_on_but_not_the_address() {
    let script = "echo \"[tcp @ 0x1] [error] rtsp://me:secret@nowhere/x: refused\" >&2; exit 3";
    let (_folder, mut program) = start("rtsp://me:secret@nowhere/x", Some(script));
    let failed = program.wait_for_event("video", "failed");
    let text = failed.to_string();
    assert!(
        text.contains("exit status: 3") && text.contains("refused"),
        "{text}"
    );
    assert!(!text.contains("secret"), "{text}");
    // Each try waits longer.
    let again = program.wait_for_event("video", "failed");
    assert!(again["retry_in_s"].as_f64() > failed["retry_in_s"].as_f64());
}

#[test]
fn rubbish_is_no_frame() {
    let script = "head -c 5000 /dev/urandom >&2; head -c 5000 /dev/urandom; exit 0";
    let (_folder, mut program) = start("udp://nowhere:1", Some(script));
    let failed = program.wait_for_event("video", "failed");
    assert!(reason(&failed).contains("the stream ended"), "{failed}");
    let of_video = |line: &&Value| line["type"] == "result" && line["camera"] == "video";
    assert_eq!(program.seen.iter().filter(of_video).count(), 0);
}

#[test]
fn a_killed_ffmpeg_is_started_again() {
    let folder = folder(&config("clip.mkv"));
    sources::folder(&folder.path().join("photos"), PHOTOS);
    sources::video(&folder.path().join("clip.mkv"), 30);
    let mut program = watch(folder.path(), None);
    program.wait_for_result("video");
    let children = program.children();
    assert_eq!(children.len(), 1);
    kill(children[0], "KILL");
    let failed = program.wait_for_event("video", "failed");
    assert!(reason(&failed).contains("SIGKILL"), "{failed}");
    program.wait_for_event("video", "live");
    program.wait_for_result("video");
    program.wait_for_result("photos");
    assert!(longest_pause(&program.seen) < 2.0);
    // The old one is reaped, and the new one ends with us.
    let children = program.children();
    assert_eq!(children.len(), 1);
    program.signal("TERM");
    program.end();
    let alive = std::path::Path::new("/proc").join(children[0].to_string());
    assert!(!alive.exists());
}

#[test]
fn a_stalled_ffmpeg_is_stale_at_once_and_replaced_when_it_stays_so() {
    let folder = folder(&config("clip.mkv"));
    sources::folder(&folder.path().join("photos"), PHOTOS);
    sources::video(&folder.path().join("clip.mkv"), 60);
    let mut program = watch(folder.path(), None);
    for _ in 0..5 {
        program.wait_for_result("video");
    }
    let stalled = program.children()[0];
    kill(stalled, "STOP");
    let start = Instant::now();
    program.wait_for_event("video", "stale");
    // Two periods and 100 ms are 300 ms; this machine may have other work.
    assert!(start.elapsed() < Duration::from_secs(3));
    let failed = program.wait_for_event("video", "failed");
    assert!(reason(&failed).contains("no frame for 10s"), "{failed}");
    program.wait_for_event("video", "live");
    assert_ne!(program.children(), [stalled]);
    program.wait_for_result("photos");
    assert!(longest_pause(&program.seen) < 2.0);
}

#[test]
fn pictures_of_another_size_than_the_calibration_s_are_refused() {
    let folder = folder(
        "[[camera]]\nname = \"photos\"\nsource = \"photos\"\nweights = \"model.safetensors\"\n\
         camera_info = \"info.yaml\"\nfps = 20\n",
    );
    sources::folder(&folder.path().join("photos"), 3);
    let info =
        "image_width: 65\nimage_height: 48\ncamera_matrix: {data: [9, 0, 5, 0, 9, 5, 0, 0, 1]}\n";
    std::fs::write(folder.path().join("info.yaml"), info).unwrap();
    let mut program = watch(folder.path(), None);
    let failed = program.wait_for_event("photos", "failed");
    assert!(reason(&failed).contains("65 x 48"), "{failed}");
    assert!(program.seen.iter().all(|line| line["type"] != "result"));
}
