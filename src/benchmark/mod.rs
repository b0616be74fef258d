//! How fast networks run on an adapter: layer by layer, and the whole cascade. No file, no command line:
//! the same code serves a program and a page in a browser.

mod clock;
mod comparison;
mod cpu;
mod gpu;
mod report;
mod roofline;
mod statistics;
pub(crate) mod table;
mod timer;

use image::{Rgba, RgbaImage};

use crate::camera::{Camera, Rectification};
use crate::cascade::LocateError;
use crate::gpu::{Device, GpuError, Precision, Work};
use crate::network::Model;
pub use comparison::compare;
pub use report::{Adapter, CascadeFigures, LayerFigures, Program, Report, Start, Timing, Weights};
pub use roofline::Roofline;

use statistics::{Sample, rounded};

/// What to measure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// Numbers of images in a batch, each at least 1.
    pub batches: Vec<usize>,
    /// What to compute in.
    pub precisions: Vec<Precision>,
    /// How often each batch is measured; `None` for as often as three seconds hold, but at least three
    /// times and at most 500.
    pub runs: Option<usize>,
    /// Use the GPU's clock where it has one.
    pub timestamps: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            batches: vec![1],
            precisions: vec![Precision::F32],
            runs: None,
            timestamps: true,
        }
    }
}

impl Options {
    /// Whether `runs` that took `ms` together are enough.
    fn enough(&self, runs: usize, ms: f64) -> bool {
        match self.runs {
            Some(wanted) => runs >= wanted.max(1),
            None => runs >= 500 || (runs >= 3 && ms >= 3000.0),
        }
    }
}

/// Why a benchmark failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchmarkError {
    /// A batch that cannot be planned or run.
    #[error("batch of {batch}: {cause}")]
    Batch {
        /// Images in the batch.
        batch: usize,
        /// What the adapter lacks, or what failed.
        cause: GpuError,
    },
    /// The probe of the roofline failed.
    #[error("roofline probe: {0}")]
    Probe(GpuError),
    /// Plain Rust computes in f32 only.
    #[error("precision {0}: plain Rust computes in f32 only")]
    Precision(Precision),
    /// The networks do not run.
    #[error(transparent)]
    Locate(#[from] LocateError),
}

/// What may be reported while a benchmark runs: what is being measured.
pub type Progress<'a> = &'a mut dyn FnMut(&str);

/// Measures `model` on `device`.
///
/// # Errors
/// A batch that the adapter cannot hold, any fault of the device.
#[cfg(not(target_arch = "wasm32"))]
pub fn on_gpu(
    device: &Device,
    model: &Model,
    weights: Weights,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Report, BenchmarkError> {
    pollster::block_on(on_gpu_async(device, model, weights, options, progress))
}

/// As [`on_gpu`]: in a browser without blocking, elsewhere blocking all the same.
///
/// # Errors
/// Those.
pub async fn on_gpu_async(
    device: &Device,
    model: &Model,
    weights: Weights,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Report, BenchmarkError> {
    gpu::measure(device, model, weights, options, progress).await
}

/// Measures `model` in plain Rust.
///
/// # Errors
/// A precision other than f32.
pub fn on_cpu(
    model: &Model,
    weights: Weights,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Report, BenchmarkError> {
    cpu::measure(model, weights, options, progress)
}

/// Columns and rows of the images that are searched: a common camera's.
const IMAGE: (u32, u32) = (640, 480);

/// An image that shows nothing: time does not depend on what is in it.
fn source() -> RgbaImage {
    let (width, height) = IMAGE;
    RgbaImage::from_fn(width, height, |x, y| {
        Rgba([x as u8, y as u8, (x ^ y) as u8, 255])
    })
}

/// How that image becomes the networks' one.
fn rectification(model: &Model) -> Rectification {
    let (width, height) = IMAGE;
    let description = &model.description;
    Rectification::new(
        &Camera::assumed(width, height),
        &description.camera,
        description.input.width,
        description.input.height,
    )
}

/// A layer, before it is measured.
struct LayerWork {
    layer: String,
    kernel: String,
    work: Work,
}

impl LayerWork {
    fn figures(
        self,
        batch: usize,
        precision: Precision,
        times: &Sample,
        roofline: Option<&Roofline>,
    ) -> LayerFigures {
        let ms = times.median().unwrap_or_default();
        let per_second = |amount: u64| (ms > 0.0).then(|| rounded(amount as f64 / ms / 1e6));
        LayerFigures {
            batch,
            precision,
            gflop: self.work.operations as f64 / 1e9,
            mb: self.work.bytes as f64 / 1e6,
            ms_p50: rounded(ms),
            ms_min: rounded(times.least().unwrap_or_default()),
            gflop_per_s: per_second(self.work.operations),
            gb_per_s: per_second(self.work.bytes),
            roofline_share: roofline
                .and_then(|roofline| roofline.share(self.work, ms))
                .map(rounded),
            layer: self.layer,
            kernel: self.kernel,
        }
    }
}
