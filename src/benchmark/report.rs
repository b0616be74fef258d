use std::fmt;

use serde::{Deserialize, Serialize};

use super::roofline::Roofline;
use crate::gpu::{self, Device, Precision};
use crate::network::Model;

/// What was measured, where, and of what. Everything in an entry of [`Report::layers`] and
/// [`Report::cascade`] is of a whole batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// [`Report::SCHEMA`].
    pub schema: u32,
    /// What measured.
    pub program: Program,
    /// What it ran on.
    pub adapter: Adapter,
    /// What ran.
    pub weights: Weights,
    /// Columns and rows of the images that were searched.
    pub image: [u32; 2],
    /// How layers were timed.
    pub timing: Timing,
    /// What the adapter was measured to reach; `None` for plain Rust.
    pub roofline: Option<Roofline>,
    /// Every layer at every batch size, in the order in which they run.
    pub layers: Vec<LayerFigures>,
    /// The whole cascade at every batch size.
    pub cascade: Vec<CascadeFigures>,
    /// From a process's start to its first result, where that was measured.
    pub start: Option<Start>,
}

impl Report {
    /// The version of the JSON.
    pub const SCHEMA: u32 = 1;

    /// Reads a report from JSON.
    ///
    /// # Errors
    /// What is not such JSON, in words.
    pub fn from_json(json: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Version {
            schema: u32,
        }
        let wrong = |e: serde_json::Error| format!("expected the JSON of a benchmark: {e}");
        let Version { schema } = serde_json::from_slice(json).map_err(wrong)?;
        if schema != Self::SCHEMA {
            return Err(format!("schema: expected {}, found {schema}", Self::SCHEMA));
        }
        serde_json::from_slice(json).map_err(wrong)
    }
}

/// The program that measured.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Program {
    /// Its version.
    pub version: String,
    /// Architecture and operating system; in a browser, which does not tell it, the former alone.
    pub target: String,
    /// Built without release optimisation: slower in plain Rust.
    pub debug: bool,
}

impl Program {
    pub(crate) fn this() -> Self {
        use std::env::consts::{ARCH, OS};
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            target: [ARCH, OS].join("-").trim_end_matches('-').to_owned(),
            debug: cfg!(debug_assertions),
        }
    }
}

/// What ran the networks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Adapter {
    /// As the driver gives it; `cpu` for plain Rust.
    pub name: String,
    /// Such as `discrete GPU`.
    #[serde(rename = "type")]
    pub kind: String,
    /// Such as `vulkan`; `rust` for plain Rust.
    pub backend: String,
    /// The driver's name and version.
    pub driver: String,
    /// What its kernels can use.
    pub tier: String,
    /// Threads that the CPU runs at once: what plain Rust and CPU rasterisers have.
    pub cpu_threads: usize,
}

impl Adapter {
    /// The adapter of `device`.
    pub fn of(device: &Device) -> Self {
        let info = device.info();
        Self {
            name: info.name.clone(),
            kind: gpu::device_type(info).to_owned(),
            backend: info.backend.to_str().to_owned(),
            driver: gpu::driver(info),
            tier: device.tier().to_string(),
            cpu_threads: cpu_threads(),
        }
    }

    /// Plain Rust.
    pub(super) fn cpu() -> Self {
        Self {
            name: "cpu".to_owned(),
            kind: "CPU".to_owned(),
            backend: "rust".to_owned(),
            driver: String::new(),
            tier: String::new(),
            cpu_threads: cpu_threads(),
        }
    }
}

fn cpu_threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.backend == "rust" {
            return write!(f, "plain Rust, {} threads", self.cpu_threads);
        }
        write!(f, "{}, {} on {}", self.name, self.kind, self.backend)?;
        if !self.driver.is_empty() {
            write!(f, ", driver {}", self.driver)?;
        }
        Ok(())
    }
}

/// Which weights ran.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Weights {
    /// The robot that they find.
    pub robot: String,
    /// The family of the networks.
    pub family: String,
    /// Columns and rows of the networks' image.
    pub input: [u32; 2],
    /// Of the model file's bytes: the same file has the same one.
    pub fingerprint: String,
}

impl Weights {
    /// Names `model`, which came from `bytes`.
    pub fn new(model: &Model, bytes: &[u8]) -> Self {
        // FNV-1a. It tells files apart by accident, not by malice.
        let hash = bytes.iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, &byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
        });
        let description = &model.description;
        Self {
            robot: description.robot.clone(),
            family: description.family.clone(),
            input: [description.input.width, description.input.height],
            fingerprint: format!("{hash:016x}"),
        }
    }
}

impl fmt::Display for Weights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.input;
        write!(
            f,
            "{}, family {}, {width} x {height} pixels, fingerprint {}",
            self.robot, self.family, self.fingerprint
        )
    }
}

/// How layers were timed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Timing {
    /// By the GPU's clock.
    Timestamps,
    /// From submission to completion as the CPU sees it: too long by what a submission costs.
    Wall,
}

impl fmt::Display for Timing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Timestamps => "GPU time by timestamps",
            Self::Wall => "wall time of each, submission included",
        })
    }
}

/// A layer of a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LayerFigures {
    /// Images in the batch.
    pub batch: usize,
    /// What it was computed in.
    pub precision: Precision,
    /// `network.layer`, or what is between the networks.
    pub layer: String,
    /// What computed it; several are joined by ` + `.
    pub kernel: String,
    /// Billions of operations; a multiply-add is two, other arithmetic is not counted.
    pub gflop: f64,
    /// Millions of bytes: what is read and written, and parameters, each once.
    pub mb: f64,
    /// Median of its time, in milliseconds.
    pub ms_p50: f64,
    /// The shortest: on a machine that has other work too, this compares best.
    pub ms_min: f64,
    /// Billions of operations a second.
    pub gflop_per_s: Option<f64>,
    /// Billions of bytes a second.
    pub gb_per_s: Option<f64>,
    /// See [`Roofline::share`].
    pub roofline_share: Option<f64>,
}

/// The cascade on a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CascadeFigures {
    /// Images in the batch.
    pub batch: usize,
    /// What it was computed in.
    pub precision: Precision,
    /// How often it was measured. Percentiles are by nearest rank: those of few are the greatest.
    pub runs: usize,
    /// Billions of operations.
    pub gflop: f64,
    /// Median of the GPU's time for all layers, in milliseconds; `None` without timestamps.
    pub gpu_ms_p50: Option<f64>,
    /// The shortest of the same.
    pub gpu_ms_min: Option<f64>,
    /// From the images in memory to the answer in memory, in milliseconds.
    pub wall_ms_p50: f64,
    /// The shortest of the same.
    pub wall_ms_min: f64,
    /// The 95th percentile.
    pub wall_ms_p95: f64,
    /// The 99th percentile.
    pub wall_ms_p99: f64,
    /// Median of the wall time's first part, in milliseconds: handing the images to the driver.
    pub upload_ms_p50: Option<f64>,
    /// Of its second part: encoding, submitting, and waiting for the GPU, the images' way to it
    /// included.
    pub compute_ms_p50: Option<f64>,
    /// Of its third part: fetching the answer from a GPU that is done.
    pub readback_ms_p50: Option<f64>,
    /// Median of what the CPU does besides handing the images over and waiting (encode, submit,
    /// readback), in microseconds.
    pub cpu_us_p50: Option<f64>,
    /// Images a second: the batch by `wall_ms_p50`.
    pub frames_per_s: f64,
    /// Millions of bytes of GPU memory that the plan holds; `None` where the driver does not tell.
    pub memory_mb: Option<f64>,
    /// Planning: allocation, shaders, pipelines. In milliseconds; plain Rust has no plan.
    pub plan_ms: Option<f64>,
    /// The first run, which compiles on some drivers. In milliseconds.
    pub first_ms: f64,
}

/// From a process's start to its first result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// With the driver's cache of shaders empty, in milliseconds; `None` where it cannot be emptied.
    pub cold_ms: Option<f64>,
    /// With the cache filled by an earlier start, in milliseconds.
    pub warm_ms: f64,
    /// Why there is no figure, or what it means.
    pub note: String,
}
