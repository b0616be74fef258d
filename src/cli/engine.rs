//! What runs the networks: the flags that commands share.

use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::ensure;
use clap::ValueEnum;

use crate::cascade::Locator;
use crate::gpu::{AdapterRequest, Device, GpuError, Precision};
use crate::network::Model;

#[derive(Debug, Clone, clap::Args)]
pub(super) struct EngineArgs {
    /// The adapter to run on (see `whereabot adapters`), or `cpu` for plain Rust
    #[arg(long, value_name = "NAME|INDEX|cpu")]
    pub adapter: Option<String>,
    /// The backends to search: vulkan, metal, dx12, gl
    #[arg(long, value_name = "NAME")]
    pub backend: Option<String>,
    /// Skip the search for the fastest kernels (some five seconds when a GPU is first used; the result is kept in
    /// the user's cache folder)
    #[arg(long)]
    pub no_tuning: bool,
}

impl EngineArgs {
    /// Whether no adapter is asked for.
    pub fn is_cpu(&self) -> bool {
        let cpu = |name: &String| name.eq_ignore_ascii_case("cpu");
        self.adapter.as_ref().is_some_and(cpu)
    }

    /// `None` for plain Rust: asked for, or there is no adapter and none was asked for.
    pub fn open(&self) -> Result<Option<Arc<Device>>, GpuError> {
        if self.is_cpu() {
            return Ok(None);
        }
        let request = AdapterRequest::new(self.adapter.as_deref(), self.backend.as_deref());
        match Device::open(&request) {
            Ok(device) => {
                let pipelines = remembered(&device, PIPELINES);
                // SAFETY: it lies in the user's own folder, as this program does or whatever else the user runs.
                #[allow(unsafe_code)]
                let device = unsafe { device.with_pipeline_cache(&pipelines) };
                if self.no_tuning {
                    return Ok(Some(Arc::new(device)));
                }
                let tuning = remembered(&device, TUNING);
                Ok(Some(Arc::new(device.tuned(Device::TUNING, &tuning))))
            }
            Err(error @ GpuError::NoAdapter { .. }) if request == AdapterRequest::default() => {
                log::warn!("{error}: running on the CPU, which is slower");
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }
}

/// `model` on `device`, or in plain Rust.
pub(super) fn locator(
    model: &Model,
    device: Option<&Arc<Device>>,
    precision: Precision,
) -> anyhow::Result<Locator> {
    let Some(device) = device else {
        ensure_f32(precision)?;
        return Ok(Locator::on_cpu(model));
    };
    let locator = Locator::on_gpu(Arc::clone(device), model, precision)?;
    remember(device);
    Ok(locator)
}

/// Whether plain Rust can compute in `precision`.
pub(super) fn ensure_f32(precision: Precision) -> anyhow::Result<()> {
    ensure!(
        precision == Precision::F32,
        "plain Rust computes in f32 only"
    );
    Ok(())
}

/// Keeps what was found about an adapter and what its driver compiled, if there is anything new.
pub(super) fn remember(device: &Device) {
    if let Some(tuning) = device.tuning() {
        keep(device, TUNING, &tuning);
    }
    if let Some(pipelines) = device.pipeline_cache()
        && pipelines != remembered(device, PIPELINES)
    {
        keep(device, PIPELINES, &pipelines);
    }
}

/// Begins the name of the file, and ends it.
type FileName = (&'static str, &'static str);

/// Of the fastest kernels.
const TUNING: FileName = ("tuning", "json");
/// Of what the driver compiled.
const PIPELINES: FileName = ("pipelines", "bin");

/// Names another folder for [`PIPELINES`]: `bench` starts this program with an empty one.
pub(super) const PIPELINES_FOLDER: &str = "WHEREABOT_PIPELINES";

/// Empty where there is nothing yet, or users have no folder for caches.
fn remembered(device: &Device, name: FileName) -> Vec<u8> {
    let bytes = cache_file(device, name).and_then(|file| fs::read(file).ok());
    bytes.unwrap_or_default()
}

fn keep(device: &Device, name: FileName, bytes: &[u8]) {
    let Some(file) = cache_file(device, name) else {
        return;
    };
    let write = || -> io::Result<()> {
        fs::create_dir_all(file.parent().unwrap_or(&file))?;
        // Another process may be reading it.
        let new = file.with_extension(format!("{}.new", std::process::id()));
        fs::write(&new, bytes)?;
        fs::rename(&new, &file)
    };
    if let Err(error) = write() {
        log::warn!("{}: cannot be written: {error}", file.display());
    }
}

/// Where what is known of an adapter by a backend is kept: another backend's driver compiles otherwise. `None` where users
/// have no folder for caches.
fn cache_file(device: &Device, name: FileName) -> Option<PathBuf> {
    let info = device.info();
    let adapter = format!("{}-{}", info.name, info.backend).to_lowercase();
    let adapter = adapter.replace(|c: char| !c.is_ascii_alphanumeric(), "-");
    let other = std::env::var_os(PIPELINES_FOLDER).filter(|_| name == PIPELINES);
    let folder = match other {
        Some(folder) => folder.into(),
        None => dirs::cache_dir()?.join("whereabot"),
    };
    let (begin, end) = name;
    Some(folder.join(format!("{begin}-{adapter}.{end}")))
}

/// What to store activations in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum PrecisionName {
    F32,
    F16,
}

impl From<PrecisionName> for Precision {
    fn from(name: PrecisionName) -> Self {
        match name {
            PrecisionName::F32 => Self::F32,
            PrecisionName::F16 => Self::F16,
        }
    }
}
