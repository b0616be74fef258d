//! `whereabot watch`: lines, signals, exit codes.

use std::io::{BufRead, BufReader};
use std::process::Stdio;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::program::{Program, command, folder, watch, watch_by};
use super::sources;

const PHOTOS: &str = "[[camera]]\nname = \"left\"\nsource = \"photos\"\nweights = \"model.safetensors\"\n\
                      hfov = 70\nfps = 20\n";

#[test]
fn lines_say_what_was_found_and_when() {
    let folder = folder(PHOTOS);
    sources::folder(&folder.path().join("photos"), 30);
    let before = std::time::SystemTime::now();
    let mut program = watch(folder.path(), None);
    let first = program.wait_for_result("left");
    assert_eq!(first["schema"], 1);
    assert_eq!(first["robot"], "cube");
    assert_eq!(first["status"], "found");
    assert_eq!(first["frame"], "camera_optical");
    assert_eq!(first["joints"].as_array().unwrap().len(), 6);
    assert_eq!(first["joints"][0]["name"], "shoulder_pan");
    assert!(first["bbox_px"].is_array() && first["coverage"].as_f64().unwrap() > 0.0);
    let since = |time: std::time::SystemTime| {
        let since = time.duration_since(std::time::UNIX_EPOCH).unwrap();
        since.as_secs_f64()
    };
    let acquired = first["acquired_s"].as_f64().unwrap();
    let now = std::time::SystemTime::now();
    assert!(since(before) <= acquired && acquired <= since(now));
    assert!(first["age_ms"].as_f64().unwrap() > 0.0);
    let statistics = program.wait_for("statistics", |line| line["type"] == "statistics");
    let left = &statistics["cameras"][0];
    assert_eq!(left["camera"], "left");
    assert!(left["answers_per_s"].as_f64().unwrap() > 0.0);
    assert!(left["age_p99_ms"].as_f64() >= left["age_p50_ms"].as_f64());
    // It ends by itself, with everything said.
    let (status, _) = program.end();
    assert!(status.success());
    let of = |kind: &str, key: &str| program.seen.iter().filter(|l| l[key] == kind).count();
    assert_eq!((of("live", "event"), of("ended", "event")), (1, 1));
    let last = program.seen.iter().rfind(|line| line["type"] == "result");
    assert_eq!(last.unwrap()["frame_number"], 29);
    for line in program.seen.iter().filter(|l| l["type"] == "result") {
        let name = format!("{:03}.png", line["frame_number"].as_u64().unwrap());
        let file = line["file"].as_str().unwrap();
        assert!(file.ends_with(&name), "{file}: expected {name}");
    }
}

#[test]
fn signals_end_it_in_time_with_a_whole_line() {
    for signal in ["INT", "TERM", "HUP"] {
        let config = PHOTOS.to_owned()
            + "repeat = true\n"
            + "[[camera]]\nname = \"video\"\nsource = \"clip.mkv\"\nweights = \"model.safetensors\"\nhfov = 70\n";
        let folder = folder(&config);
        sources::folder(&folder.path().join("photos"), 5);
        sources::video(&folder.path().join("clip.mkv"), 60);
        // Whoever runs the tests may ignore it, as `nohup` does.
        let mut program = watch_by(folder.path(), &["env", "--default-signal=HUP"]);
        program.wait_for_result("video");
        program.wait_for_result("left");
        program.signal(signal);
        let (status, took) = program.end();
        assert_eq!(status.code(), Some(0), "{signal}");
        println!("SIG{signal}: ended after {took:?}");
        assert!(took < Duration::from_secs(2), "SIG{signal}: {took:?}");
    }
}

#[test]
fn a_closed_terminal_does_not_end_what_is_to_outlive_it() {
    let folder = folder(&(PHOTOS.to_owned() + "repeat = true\n"));
    sources::folder(&folder.path().join("photos"), 5);
    let mut program = watch_by(folder.path(), &["nohup"]);
    program.wait_for_result("left");
    program.signal("HUP");
    let seen = program.seen.len();
    program.wait_for("more results", |_| true);
    while program.seen.len() < seen + 20 {
        program.wait_for_result("left");
    }
    program.signal("TERM");
    assert_eq!(program.end().0.code(), Some(0));
}

#[test]
fn a_file_that_is_cut_off_ends_as_a_failure() {
    let config = "[[camera]]\nname = \"video\"\nsource = \"clip.mkv\"\nweights = \"model.safetensors\"\nhfov = 70\n";
    let folder = folder(config);
    let clip = folder.path().join("clip.mkv");
    for broken in [false, true] {
        sources::video(&clip, 1);
        if broken {
            std::fs::write(&clip, b"nothing that ffmpeg knows").unwrap();
        }
        let mut program = watch(folder.path(), None);
        let (status, _) = program.end();
        assert_eq!(status.code(), Some(i32::from(broken)));
        let events = program.seen.iter().filter(|line| line["type"] == "event");
        let events: Vec<_> = events.map(|line| line["event"].as_str().unwrap()).collect();
        let expected = if broken { "failed" } else { "live" };
        assert!(
            events.contains(&expected) && events.last() == Some(&"ended"),
            "{events:?}"
        );
        let failed = program.seen.iter().find(|line| line["event"] == "failed");
        assert_eq!(failed.is_some(), broken);
        assert!(failed.is_none_or(|line| line["retry_in_s"].is_null()));
    }
}

#[test]
fn on_a_gpu_it_says_the_same_and_ends_as_soon() {
    let folder = folder(&(PHOTOS.to_owned() + "repeat = true\n"));
    sources::folder(&folder.path().join("photos"), 5);
    let mut on_gpu = command(folder.path());
    on_gpu.arg("cameras.toml");
    let mut programs = [Program::start(on_gpu), watch(folder.path(), None)];
    let number = |line: &Value| line["frame_number"].as_u64().unwrap() % 5;
    let [gpu, cpu] = [0, 1].map(|p| programs[p].wait_for_result("left"));
    // The pictures repeat: the same picture of both.
    let other = programs[1].wait_for("picture", |line| {
        line["type"] == "result" && number(line) == number(&gpu)
    });
    let near = |a: &Value, b: &Value| {
        let [a, b] = [a, b].map(|line| line["joints"][2]["xyz_m"][0].as_f64().unwrap());
        (a - b).abs() < 1e-4
    };
    assert!(near(&gpu, &other));
    // Negative control: another picture's are others.
    let another = programs[1].wait_for("another", |line| {
        line["type"] == "result" && number(line) != number(&gpu)
    });
    assert!(!near(&gpu, &another), "{gpu} {another}");
    assert_eq!(cpu["status"], "found");
    programs[0].signal("TERM");
    let (status, took) = programs[0].end();
    println!("on a GPU: ended after {took:?}");
    assert!(
        status.success() && took < Duration::from_secs(2),
        "{took:?}"
    );
}

#[test]
fn a_reader_that_leaves_ends_it() {
    let folder = folder(&(PHOTOS.to_owned() + "repeat = true\n"));
    sources::folder(&folder.path().join("photos"), 5);
    let mut child = command(folder.path())
        .args(["--adapter", "cpu", "cameras.toml"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let mut output = BufReader::new(child.stdout.take().unwrap());
    output.read_line(&mut line).unwrap();
    serde_json::from_str::<Value>(&line).unwrap();
    drop(output);
    let start = Instant::now();
    assert!(child.wait().unwrap().success());
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_ends_it_with_1() {
    let folder = folder(&(PHOTOS.to_owned() + "repeat = true\n"));
    sources::folder(&folder.path().join("photos"), 5);
    let full = std::fs::File::options().write(true).open("/dev/full");
    let output = command(folder.path())
        .args(["--adapter", "cpu", "cameras.toml"])
        .stdout(full.unwrap())
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("stdout: "), "{said}");
}

#[test]
fn what_cannot_start_leaves_no_file() {
    let folder = folder(PHOTOS);
    sources::folder(&folder.path().join("photos"), 2);
    let record = |adapter| {
        let mut command = command(folder.path());
        command.args(["cameras.toml", "--record", "out.mcap", "--adapter", adapter]);
        let code = command.output().unwrap().status.code();
        (code, folder.path().join("out.mcap").exists())
    };
    assert_eq!(record("voodoo"), (Some(2), false));
    assert_eq!(record("cpu"), (Some(0), true));
}

/// Warnings act as soon as they start.
#[test]
fn what_cannot_start_does_nothing() {
    let warning = "[[warning]]\nname = \"near\"\ncameras = [\"left\"]\nprotect = \"camera\"\nwarn_m = 2\nstop_m = 1\n\
                   uncertainty_m = 0.1\n[[action]]\nname = \"act\"\non = [\"warn\"]\ncommand = [\"touch\", \"acted\"]\n";
    let folder = folder(&(PHOTOS.to_owned() + warning));
    sources::folder(&folder.path().join("photos"), 2);
    let record = |file: &str| {
        let mut command = command(folder.path());
        command.args(["cameras.toml", "--adapter", "cpu", "--record", file]);
        let code = command.output().unwrap().status.code();
        (code, folder.path().join("acted").exists())
    };
    std::fs::write(folder.path().join("taken.mcap"), b"").unwrap();
    assert_eq!(record("taken.mcap"), (Some(1), false));
    assert_eq!(record("new.mcap"), (Some(0), true));
}

#[test]
fn cameras_can_do_without_a_file() {
    let folder = folder("");
    sources::folder(&folder.path().join("a"), 2);
    sources::folder(&folder.path().join("b"), 2);
    let mut command = command(folder.path());
    command.args(["--adapter", "cpu", "--weights", "model.safetensors"]);
    command.args(["--hfov", "70", "--source", "a", "--source", "b"]);
    let mut program = Program::start(command);
    let (status, _) = program.end();
    assert!(status.success());
    for camera in ["camera_1", "camera_2"] {
        let of = |l: &&Value| l["type"] == "result" && l["camera"] == camera;
        // The last frame is never dropped.
        let last = program.seen.iter().rfind(of).unwrap();
        assert_eq!(last["frame_number"], 1);
    }
}

#[test]
fn what_is_wrong_is_said_before_anything_starts() {
    let folder =
        folder("[[camera]]\nname = \"a\"\nsource = \"gone\"\nweights = \"model.safetensors\"\n");
    sources::folder(&folder.path().join("a"), 2);
    std::fs::write(folder.path().join("clip.mkv"), b"").unwrap();
    let cases: [(&[&str], i32, &str); 6] = [
        (
            &["cameras.toml"],
            1,
            "cameras.toml:3: camera.source: expected",
        ),
        (&["none.toml"], 1, "none.toml"),
        (&[], 2, "CAMERAS.TOML"),
        (&["cameras.toml", "--source", "a"], 2, "cannot be used with"),
        (&["--source", "a", "--weights", "none"], 1, "none"),
        (
            &["--source", "clip.mkv", "--weights", "model.safetensors"],
            1,
            "ffmpeg",
        ),
    ];
    for (arguments, code, text) in cases {
        let output = command(folder.path())
            .args(["--adapter", "cpu"])
            .args(arguments)
            // No ffmpeg there.
            .env("PATH", folder.path())
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(text), "{arguments:?}: {said}");
        assert!(output.stdout.is_empty());
    }
}
