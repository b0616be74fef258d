//! `whereabot verify`: whether this adapter computes what plain Rust computes.

use std::fs;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::error::ErrorKind;
use indicatif::{ProgressBar, ProgressStyle};

use super::engine::{self, PrecisionName};
use super::weights;
use crate::benchmark::{Adapter, Weights};
use crate::gpu::{GpuError, Precision};
use crate::network::Model;
use crate::verification::{self, Verdict};

/// Hold an adapter to plain Rust: every kernel on random layers, and the whole cascade on two pictures
///
/// Prints a table and, last, one line that says it all, to be sent. Exits with 0 if all agrees that the
/// adapter can run; with 1 if something differs or failed; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The model file to run [default: that of the UR5, where `locate` looks for it]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    engine: engine::EngineArgs,
    /// What to store activations in [default: f32,f16]
    #[arg(long, value_enum, value_name = "NAME,NAME", value_delimiter = ',')]
    precision: Vec<PrecisionName>,
    /// One JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.engine.is_cpu() {
        let message = "`--adapter cpu` is plain Rust, what adapters are held to";
        super::refuse("verify", ErrorKind::ArgumentConflict, message);
    }
    let file = weights::path(None, args.weights.as_deref())?;
    let bytes = fs::read(&file).with_context(|| format!("{}: cannot be read", file.display()))?;
    let model = Model::from_bytes(&bytes, &file)?;
    let device = args.engine.open()?.ok_or(GpuError::NoAdapter {
        backends: "all".into(),
    })?;
    let precisions: Vec<Precision> = [PrecisionName::F32, PrecisionName::F16]
        .into_iter()
        .filter(|name| args.precision.is_empty() || args.precision.contains(name))
        .map(Precision::from)
        .collect();

    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg}")?;
    let bar = ProgressBar::no_length().with_style(style);
    let mut progress = |done: usize, count: usize, what: &str| {
        bar.set_length(count as u64);
        bar.set_position(done as u64);
        bar.set_message(what.to_owned());
    };
    let named = Weights::new(&model, &bytes);
    let report = pollster::block_on(verification::verify(
        &device,
        Adapter::of(&device),
        &model,
        named,
        &precisions,
        &mut progress,
    ));
    bar.finish_and_clear();
    engine::remember(&device);

    let text = if args.json {
        format!("{}\n", serde_json::to_string_pretty(&report)?)
    } else {
        report.to_string()
    };
    super::print(&text)?;
    Ok(match report.verdict {
        Verdict::Agrees => ExitCode::SUCCESS,
        Verdict::Disagrees => ExitCode::FAILURE,
    })
}
