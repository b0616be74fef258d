use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, SystemTime};

use glam::DMat3;
use serde::Serialize;

use super::warning::{ActionReport, Warning};
use super::{Event, EventKind, Fused, Observation, Rates, Sink, Statistics};
use crate::cascade::EstimateLine;

/// JSON Lines: a result a camera a frame, events, and a line of statistics a second. `docs/watch.md` lists the keys.
///
/// A thread of its own writes them, each line with one write. Where whoever reads them is too slow, lines are lost,
/// results first, and the next line of statistics says how many.
#[derive(Debug)]
pub struct Lines {
    cameras: Vec<Named>,
    rigs: Vec<NamedRig>,
    lines: Option<Sender<String>>,
    /// How many lines wait to be written.
    waiting: Arc<AtomicUsize>,
    /// Hangs up when all lines are written.
    written: Receiver<()>,
    lost: Arc<AtomicU64>,
}

/// What lines say of a camera.
#[derive(Debug, Clone)]
pub struct Named {
    /// Its name.
    pub camera: String,
    /// The robot in its view.
    pub robot: String,
}

/// What lines say of a rig.
#[derive(Debug, Clone)]
pub struct NamedRig {
    /// Its name.
    pub rig: String,
    /// The places of its cameras in the configuration, the one whose frame all is in first.
    pub cameras: Vec<usize>,
    /// The joints' names, in the model's order.
    pub joints: Vec<String>,
}

/// The version of the lines.
const SCHEMA: u32 = 1;

#[derive(Serialize)]
struct Line<'a> {
    schema: u32,
    #[serde(rename = "type")]
    kind: &'static str,
    #[serde(flatten)]
    content: Content<'a>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Content<'a> {
    Result {
        camera: &'a str,
        robot: &'a str,
        frame_number: u64,
        #[serde(skip_serializing_if = "Option::is_none")]
        file: Option<Cow<'a, str>>,
        acquired_s: f64,
        age_ms: f64,
        #[serde(flatten)]
        estimate: EstimateLine<'a>,
    },
    Event {
        event: &'static str,
        #[serde(skip_serializing_if = "Option::is_none")]
        camera: Option<&'a str>,
        at_s: f64,
        #[serde(flatten)]
        details: Details<'a>,
    },
    Fused {
        rig: &'a str,
        acquired_s: f64,
        frame: &'static str,
        of: &'a str,
        joints: Vec<FusedJointLine<'a>>,
        cameras: Vec<PoseLine<'a>>,
    },
    Statistics {
        at_s: f64,
        lines_lost: u64,
        cameras: Vec<CameraRates<'a>>,
    },
}

#[derive(Serialize)]
struct FusedJointLine<'a> {
    name: &'a str,
    xyz_m: [f64; 3],
    /// Standard deviation along each axis.
    sigma_m: [f64; 3],
    cameras: usize,
}

/// Where a camera is in the first one's frame.
#[derive(Serialize)]
struct PoseLine<'a> {
    camera: &'a str,
    translation_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

/// What there is to say of an event besides its name.
#[derive(Serialize)]
#[serde(untagged)]
enum Details<'a> {
    Nothing {},
    Failure {
        reason: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        retry_in_s: Option<f64>,
    },
    Warning(&'a Warning),
    Action(&'a ActionReport),
}

#[derive(Serialize)]
struct CameraRates<'a> {
    camera: &'a str,
    frames_per_s: f64,
    answers_per_s: f64,
    dropped: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    age_p50_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    age_p99_ms: Option<f64>,
}

impl Lines {
    /// Lines that wait to be written, at most.
    const QUEUE: usize = 1024;
    /// Beyond those, lines of events and statistics that may wait: an event says what changed, and nothing says it again.
    const RESERVE: usize = 1024;
    /// How long the last lines have to be written.
    const FAREWELL: Duration = Duration::from_millis(200);

    /// Writes to `output`, in a thread that ends with it. `closed` is told why, once, when `output` takes no more.
    pub fn new(
        cameras: Vec<Named>,
        mut output: impl Write + Send + 'static,
        closed: impl FnOnce(io::Error) + Send + 'static,
    ) -> Self {
        let (lines, queue) = channel::<String>();
        let waiting: Arc<AtomicUsize> = Arc::default();
        let (writing, written) = channel();
        let taken = Arc::clone(&waiting);
        std::thread::spawn(move || {
            // Hangs up at the end.
            let _writing = writing;
            for line in queue {
                taken.fetch_sub(1, Ordering::Relaxed);
                let done = output
                    .write_all(line.as_bytes())
                    .and_then(|()| output.flush());
                if let Err(error) = done {
                    closed(error);
                    return;
                }
            }
        });
        Self {
            cameras,
            rigs: Vec::new(),
            lines: Some(lines),
            waiting,
            written,
            lost: Arc::default(),
        }
    }

    /// Writes what the cameras of these rigs see together, too.
    #[must_use]
    pub fn with_rigs(mut self, rigs: Vec<NamedRig>) -> Self {
        self.rigs = rigs;
        self
    }

    fn name(&self, camera: usize) -> &str {
        self.cameras.get(camera).map_or("", |named| &named.camera)
    }

    fn write(&self, kind: &'static str, content: Content<'_>) {
        let line = Line {
            schema: SCHEMA,
            kind,
            content,
        };
        let Some(lines) = &self.lines else {
            return;
        };
        let most = match line.content {
            Content::Result { .. } | Content::Fused { .. } => Self::QUEUE,
            Content::Event { .. } | Content::Statistics { .. } => Self::QUEUE + Self::RESERVE,
        };
        if self.waiting.load(Ordering::Relaxed) >= most {
            self.lost.fetch_add(1, Ordering::Relaxed);
            return;
        }
        match serde_json::to_string(&line) {
            Ok(text) => {
                self.waiting.fetch_add(1, Ordering::Relaxed);
                // Nobody listens any more once the output takes no more.
                let _ = lines.send(text + "\n");
            }
            Err(error) => log::error!("a line cannot be written: {error}"),
        }
    }
}

impl Sink for Lines {
    fn observation(&mut self, observation: &Observation) {
        let robot = self.cameras.get(observation.camera);
        self.write(
            "result",
            Content::Result {
                camera: self.name(observation.camera),
                robot: robot.map_or("", |named| &named.robot),
                frame_number: observation.frame,
                file: observation.file.as_deref().map(Path::to_string_lossy),
                acquired_s: seconds(observation.acquired),
                age_ms: milliseconds(observation.age()),
                estimate: EstimateLine::from(&observation.estimate),
            },
        );
    }

    fn event(&mut self, event: &Event) {
        let (name, details) = match &event.kind {
            EventKind::Live => ("live", Details::Nothing {}),
            EventKind::Stale => ("stale", Details::Nothing {}),
            EventKind::Failed { reason, retry_in } => {
                let retry_in_s = retry_in.map(|time| time.as_secs_f64());
                ("failed", Details::Failure { reason, retry_in_s })
            }
            EventKind::Ended => ("ended", Details::Nothing {}),
            EventKind::DeviceLost { reason } => {
                let retry_in_s = None;
                ("device_lost", Details::Failure { reason, retry_in_s })
            }
            EventKind::DeviceBack => ("device_back", Details::Nothing {}),
            EventKind::Warning(warning) => ("warning", Details::Warning(warning)),
            EventKind::Action(report) => ("action", Details::Action(report)),
        };
        self.write(
            "event",
            Content::Event {
                event: name,
                camera: event.camera.map(|camera| self.name(camera)),
                at_s: seconds(event.at),
                details,
            },
        );
    }

    fn fused(&mut self, fused: &Fused) {
        let Some(rig) = self.rigs.get(fused.rig) else {
            return;
        };
        let joints = fused.joints.iter().zip(&rig.joints);
        let joints = joints.map(|(joint, name)| FusedJointLine {
            name,
            xyz_m: joint.xyz_m.to_array(),
            sigma_m: diagonal(joint.covariance).map(f64::sqrt),
            cameras: joint.cameras,
        });
        let poses = fused.poses.iter().zip(&rig.cameras);
        let poses = poses.filter_map(|(pose, &camera)| {
            let (_, rotation, translation) =
                (*pose)?.first_from_camera.to_scale_rotation_translation();
            Some(PoseLine {
                camera: self.name(camera),
                translation_m: translation.to_array(),
                rotation_xyzw: rotation.to_array(),
            })
        });
        let first = rig.cameras.first().map_or("", |&first| self.name(first));
        self.write(
            "fused",
            Content::Fused {
                rig: &rig.rig,
                acquired_s: fused.time_s,
                frame: "camera_optical",
                of: first,
                joints: joints.collect(),
                cameras: poses.collect(),
            },
        );
    }

    fn statistics(&mut self, statistics: &Statistics) {
        let cameras = statistics.cameras.iter().zip(&self.cameras);
        let cameras = cameras.map(|(rates, named)| CameraRates::new(&named.camera, rates));
        self.write(
            "statistics",
            Content::Statistics {
                at_s: seconds(statistics.at),
                lines_lost: self.lost.load(Ordering::Relaxed),
                cameras: cameras.collect(),
            },
        );
    }
}

impl Drop for Lines {
    fn drop(&mut self) {
        self.lines = None;
        // A reader that does not read does not keep us.
        let _ = self.written.recv_timeout(Self::FAREWELL);
    }
}

impl<'a> CameraRates<'a> {
    fn new(camera: &'a str, rates: &Rates) -> Self {
        let rounded = |value: f64| (10.0 * value).round() / 10.0;
        Self {
            camera,
            frames_per_s: rounded(rates.frames_per_s),
            answers_per_s: rounded(rates.answers_per_s),
            dropped: rates.dropped,
            age_p50_ms: rates.age_p50.map(milliseconds),
            age_p99_ms: rates.age_p99.map(milliseconds),
        }
    }
}

fn diagonal(matrix: DMat3) -> [f64; 3] {
    [matrix.x_axis.x, matrix.y_axis.y, matrix.z_axis.z]
}

/// Since 1970 (Unix time), to microseconds.
fn seconds(time: SystemTime) -> f64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH);
    // A clock that was set to before 1970 is still a clock.
    let micros = match since {
        Ok(after) => after.as_micros() as f64,
        Err(before) => -(before.duration().as_micros() as f64),
    };
    micros / 1e6
}

fn milliseconds(time: Duration) -> f64 {
    (time.as_secs_f64() * 1e6).round() / 1e3
}
