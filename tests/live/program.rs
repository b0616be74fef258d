//! The program, running.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::known::{XYZ, model};

/// `whereabot watch` in a folder of its own.
pub struct Program {
    child: Child,
    lines: Receiver<String>,
    /// All lines so far.
    pub seen: Vec<Value>,
}

/// A folder with the tiny model and a `cameras.toml`.
pub fn folder(config: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let model = model("cube", XYZ, 0.002, &json!({}));
    std::fs::write(folder.path().join("model.safetensors"), model).unwrap();
    std::fs::write(folder.path().join("cameras.toml"), config).unwrap();
    folder
}

/// An `ffmpeg` that is this shell script. `frame WIDTH HEIGHT [BYTES]` announces a frame, taken at $time, and writes its
/// pixels, or only so many of them.
pub fn fake_ffmpeg(folder: &Path, script: &str) -> PathBuf {
    let bin = folder.join("bin");
    std::fs::create_dir_all(&bin).unwrap();
    let text = format!(
        "#!/bin/sh\n\
         [ \"$1\" = -version ] && exit 0\n\
         frame() {{\n\
         echo \"[Parsed_showinfo_1 @ 0x1] [info] n: 0 pts: 0 pts_time:${{time:-NOPTS}} fmt:rgba sar:1/1 s:$1x$2 i:P\" >&2\n\
         head -c ${{3:-$(($1*$2*4))}} /dev/zero\n\
         }}\n\
         {script}\n"
    );
    let file = bin.join("ffmpeg");
    std::fs::write(&file, text).unwrap();
    let made = Command::new("chmod").arg("+x").arg(&file).status().unwrap();
    assert!(made.success());
    bin
}

/// The command, with nothing of the environment that it reads.
pub fn command(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_whereabot"));
    command.current_dir(folder);
    for variable in ["WGPU_BACKEND", "WGPU_ADAPTER_NAME", "WHEREABOT_WEIGHTS"] {
        command.env_remove(variable);
    }
    command.env("RUST_LOG", "error");
    command.args(["watch", "--no-tuning"]);
    command
}

/// In plain Rust, on `cameras.toml`, started by `starter`, which stands in front of a command.
pub fn watch_by(folder: &Path, starter: &[&str]) -> Program {
    let watch = command(folder);
    let mut started = Command::new(starter[0]);
    started.args(&starter[1..]);
    started.arg(watch.get_program()).args(watch.get_args());
    started.current_dir(folder);
    for (variable, value) in watch.get_envs() {
        match value {
            Some(value) => started.env(variable, value),
            None => started.env_remove(variable),
        };
    }
    started.args(["--adapter", "cpu", "cameras.toml"]);
    Program::start(started)
}

/// In plain Rust, on `cameras.toml`, with `bin` before the PATH.
pub fn watch(folder: &Path, bin: Option<&Path>) -> Program {
    let mut command = command(folder);
    command.args(["--adapter", "cpu", "cameras.toml"]);
    if let Some(bin) = bin {
        let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
        command.env("PATH", path);
    }
    Program::start(command)
}

impl Program {
    pub fn start(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let output: ChildStdout = child.stdout.take().unwrap();
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            let mut output = BufReader::new(output);
            loop {
                let mut line = String::new();
                match output.read_line(&mut line) {
                    Ok(1..) if sender.send(line).is_ok() => {}
                    _ => return,
                }
            }
        });
        Self {
            child,
            lines,
            seen: Vec::new(),
        }
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line that `wanted` likes. Every line is one, and whole.
    pub fn wait_for(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let line = self.lines.recv_timeout(Duration::from_secs(30));
            let Ok(line) = line else {
                panic!("no {what}: {:#?}", self.seen);
            };
            let value = self.keep(&line);
            if wanted(&value) {
                return value;
            }
            assert!(start.elapsed() < Duration::from_secs(60), "no {what}");
        }
    }

    /// The next event of a camera.
    pub fn wait_for_event(&mut self, camera: &str, event: &str) -> Value {
        self.wait_for(&format!("{event} of {camera}"), |line| {
            line["event"] == event && line["camera"] == camera
        })
    }

    pub fn wait_for_result(&mut self, camera: &str) -> Value {
        self.wait_for(&format!("result of {camera}"), |line| {
            line["type"] == "result" && line["camera"] == camera
        })
    }

    fn keep(&mut self, line: &str) -> Value {
        assert!(line.ends_with('\n'), "{line:?}");
        let value: Value = serde_json::from_str(line).unwrap();
        self.seen.push(value.clone());
        value
    }

    pub fn signal(&self, signal: &str) {
        kill(self.id(), signal);
    }

    /// Its end, after all its lines: how, and how long it took.
    pub fn end(&mut self) -> (ExitStatus, Duration) {
        let start = Instant::now();
        let status = self.child.wait().unwrap();
        let took = start.elapsed();
        while let Ok(line) = self.lines.recv_timeout(Duration::from_secs(5)) {
            self.keep(&line);
        }
        (status, took)
    }

    /// The ids of the `ffmpeg`s that it runs.
    pub fn children(&self) -> Vec<u32> {
        let processes = std::fs::read_dir("/proc").unwrap();
        let ids = processes.filter_map(|p| p.unwrap().file_name().to_str()?.parse().ok());
        ids.filter(|&id: &u32| {
            let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
            let after_name = stat.rsplit(") ").next().unwrap_or_default();
            let parent = after_name.split(' ').nth(1).and_then(|p| p.parse().ok());
            parent == Some(self.id())
        })
        .collect()
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // It has ended, unless a test failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn kill(id: u32, signal: &str) {
    let sent = Command::new("kill")
        .args([format!("-{signal}"), id.to_string()])
        .status()
        .unwrap();
    assert!(sent.success());
}
