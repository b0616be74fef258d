use std::collections::VecDeque;
use std::io::{BufRead, BufReader};
use std::process::{ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::lateness::Lateness;
use super::showinfo::{Line, MAX_SIDE};
use super::{Shot, SourceError};
use crate::live::Stop;

/// A frame must come at least this often.
const STALLED: Duration = Duration::from_secs(10);
/// The first one may take longer: some streams begin with the next key frame only.
const OPENING: Duration = Duration::from_secs(30);
/// A stream that is later than this is opened again, which skips what waits to be decoded.
const LATE: Duration = Duration::from_secs(10);
/// It is that many frames ahead of their pixels at most.
const ANNOUNCED: usize = 64;

/// A frame that ffmpeg's filter `showinfo` announced: its pixels are about to come.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Announced {
    pub shot: Shot,
    /// Columns and rows.
    pub size: [u32; 2],
}

/// An `ffmpeg` that writes frames: killed when everything stops, when it writes none for too long, and when dropped.
#[derive(Debug)]
pub(super) struct Child {
    shared: Arc<Shared>,
    announced: Option<Receiver<Announced>>,
    /// Reads its log, and watches it.
    threads: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    process: Mutex<std::process::Child>,
    state: Mutex<State>,
    /// What ends with the child: the watch over it.
    ended: Stop,
}

#[derive(Debug)]
struct State {
    /// When the next frame must have come, and after how long.
    due: (Instant, Duration),
    /// Why we killed it.
    killed: Option<Killed>,
    /// Its last errors.
    errors: VecDeque<String>,
    /// A frame that is too large.
    oversized: Option<[u32; 2]>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Killed {
    Stopped,
    Stalled,
    /// Its frames came so late.
    Late(Duration),
    /// It announced what it should not.
    Refused,
}

impl Child {
    /// Starts `command`, with its pixels. `secret` is left out of its errors. Frames of what is `live` come as they are
    /// taken, or late.
    pub fn start(
        mut command: Command,
        secret: Option<String>,
        live: bool,
        stop: &Arc<Stop>,
    ) -> Result<(Self, ChildStdout), SourceError> {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        // Ctrl-C at the terminal is ours alone.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut process = command.spawn().map_err(SourceError::NoFfmpeg)?;
        let (pixels, log) = (process.stdout.take(), process.stderr.take());
        let shared = Arc::new(Shared {
            process: Mutex::new(process),
            state: Mutex::new(State {
                due: (Instant::now() + OPENING, OPENING),
                killed: None,
                errors: VecDeque::new(),
                oversized: None,
            }),
            ended: Stop::default(),
        });
        let (sender, announced) = sync_channel(ANNOUNCED);
        let mut child = Self {
            shared: Arc::clone(&shared),
            announced: Some(announced),
            threads: Vec::new(),
        };
        let (Some(pixels), Some(log)) = (pixels, log) else {
            return Err(SourceError::Ffmpeg("ffmpeg has no pipes".into()));
        };
        let reader = Arc::clone(&shared);
        child.threads.push(std::thread::spawn(move || {
            reader.read_log(log, secret.as_deref(), live, &sender);
        }));
        let stop = Arc::clone(stop);
        child
            .threads
            .push(std::thread::spawn(move || shared.watch(&stop)));
        Ok((child, pixels))
    }

    /// Waits until the next frame is announced; `None` when it ended.
    pub fn announced(&self) -> Option<Announced> {
        self.announced.as_ref()?.recv().ok()
    }

    /// A frame came.
    pub fn touch(&self) {
        self.shared.state().due = (Instant::now() + STALLED, STALLED);
    }

    /// Whether it was killed as everything is to stop.
    pub fn stopped(&self) -> bool {
        self.shared.state().killed == Some(Killed::Stopped)
    }

    /// Reaps it: how it ended. What does not end by itself now that its pipes are closed is killed.
    pub fn end(&mut self) -> Result<(), SourceError> {
        let status = self.shared.reap();
        // Whoever still announces does not wait for us.
        self.announced = None;
        for thread in self.threads.drain(..) {
            // A thread that panicked has nothing more to say.
            let _ = thread.join();
        }
        let state = self.shared.state();
        match (state.killed, &status) {
            (Some(Killed::Stopped), _) => return Ok(()),
            (Some(Killed::Stalled), _) => return Err(SourceError::Stalled(state.due.1)),
            (Some(Killed::Late(by)), _) => return Err(SourceError::Late(by)),
            (None, Ok(status)) if status.success() => return Ok(()),
            _ => {}
        }
        if let Some([width, height]) = state.oversized {
            return Err(SourceError::Ffmpeg(format!(
                "expected frames of 1 to {MAX_SIDE} pixels on a side, found {width} x {height}"
            )));
        }
        let how = match status {
            Ok(status) => format!("ffmpeg ended ({status})"),
            Err(error) => format!("ffmpeg ended ({error})"),
        };
        let errors: Vec<&str> = state.errors.iter().map(String::as_str).collect();
        Err(SourceError::Ffmpeg(if errors.is_empty() {
            how
        } else {
            format!("{how}: {}", errors.join("; "))
        }))
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.shared.kill(Killed::Stopped);
        // It is of no interest any more how it ended.
        let _ = self.end();
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn process(&self) -> MutexGuard<'_, std::process::Child> {
        self.process.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn kill(&self, why: Killed) {
        self.state().killed.get_or_insert(why);
        // It may have ended already.
        let _ = self.process().kill();
    }

    /// Waits for its end a little, then kills it.
    fn reap(&self) -> std::io::Result<std::process::ExitStatus> {
        let start = Instant::now();
        let status = loop {
            let mut process = self.process();
            if let Some(status) = process.try_wait()? {
                break status;
            }
            if start.elapsed() > Duration::from_millis(200) {
                let _ = process.kill();
            }
            drop(process);
            std::thread::sleep(Duration::from_millis(2));
        };
        self.ended.set();
        Ok(status)
    }

    /// Until its log ends.
    fn read_log(
        &self,
        log: ChildStderr,
        secret: Option<&str>,
        live: bool,
        frames: &SyncSender<Announced>,
    ) {
        let mut lateness = Lateness::default();
        let mut log = BufReader::new(log);
        let mut bytes = Vec::new();
        loop {
            bytes.clear();
            match log.read_until(b'\n', &mut bytes) {
                Ok(1..) => {}
                _ => return,
            }
            let text = String::from_utf8_lossy(&bytes);
            match Line::new(&text) {
                Line::Frame { size, time_s } => {
                    if size.iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
                        self.state().oversized = Some(size);
                        self.kill(Killed::Refused);
                        return;
                    }
                    let shot = Shot::now();
                    let late = match time_s {
                        Some(time_s) if live => lateness.of(shot.acquired_at, time_s),
                        _ => Duration::ZERO,
                    };
                    if late > LATE {
                        return self.kill(Killed::Late(late));
                    }
                    let shot = shot.before(late);
                    if frames.send(Announced { shot, size }).is_err() {
                        return;
                    }
                }
                Line::Error(what) => self.note(what, secret),
                Line::Other => {}
            }
        }
    }

    fn note(&self, error: &str, secret: Option<&str>) {
        let text = match secret {
            Some(secret) => error.replace(secret, "the stream"),
            None => error.to_owned(),
        };
        log::debug!("ffmpeg: {text}");
        let mut state = self.state();
        if state.errors.len() == 3 {
            state.errors.pop_front();
        }
        state.errors.push_back(text);
    }

    /// Kills it in time, until it has ended.
    fn watch(&self, stop: &Stop) {
        while !self.ended.is_set() {
            if stop.wait(Duration::from_millis(50)) {
                return self.kill(Killed::Stopped);
            }
            let (due, _) = self.state().due;
            if due < Instant::now() {
                return self.kill(Killed::Stalled);
            }
        }
    }
}
