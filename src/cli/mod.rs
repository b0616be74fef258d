//! The command line: one file a command.

mod adapters;
mod bench;
mod calibrate;
mod engine;
mod evaluate;
mod info;
mod locate;
mod photo;
mod record;
mod recording;
mod verify;
mod watch;
mod weights;

use std::io::{self, Write};
use std::path::Path;
use std::process::ExitCode;

use anyhow::ensure;
use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};

use crate::gpu::GpuError;

#[derive(Debug, Parser)]
#[command(version, about)]
enum Command {
    Locate(locate::Args),
    Watch(watch::Args),
    Adapters(adapters::Args),
    Info(info::Args),
    Bench(bench::Args),
    Verify(verify::Args),
    Record(record::Args),
    Evaluate(evaluate::Args),
    Calibrate(calibrate::Args),
    #[command(subcommand)]
    Recording(recording::Args),
}

/// Runs the command line of this process. Exit codes: 0 done, 1 failed, 2 wrong usage.
pub fn main() -> ExitCode {
    // What a driver has to say is for those who ask with RUST_LOG; its errors come back as values.
    let filter = env_logger::Env::default()
        .default_filter_or("warn,wgpu_core=error,wgpu_hal=off,naga=error");
    env_logger::Builder::from_env(filter)
        .format_timestamp(None)
        .format_target(false)
        .init();
    let done = match Command::parse() {
        Command::Locate(args) => locate::run(args),
        Command::Watch(args) => watch::run(args),
        Command::Adapters(args) => adapters::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Record(args) => record::run(args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Recording(args) => recording::run(&args),
    };
    done.unwrap_or_else(|error| {
        // Nobody is left to tell where stderr is gone too.
        let _ = writeln!(io::stderr(), "error: {error:#}");
        if is_wrong_usage(&error) {
            ExitCode::from(2)
        } else {
            ExitCode::FAILURE
        }
    })
}

/// Before long work whose result goes into `file`: there is a folder for it.
fn ensure_folder_of(file: &Path) -> anyhow::Result<()> {
    let folder = match file.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    ensure!(folder.is_dir(), "{}: no such folder", folder.display());
    Ok(())
}

/// Writes to stdout; whether somebody reads it. A reader that left, such as `head`, has what it wanted: nothing fails for that, and
/// files are written and verdicts given all the same.
fn print(text: &str) -> io::Result<bool> {
    match io::stdout().lock().write_all(text.as_bytes()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error),
    }
}

/// Ends the program over a wrong usage of `subcommand`, as clap does.
fn refuse(subcommand: &str, kind: ErrorKind, message: &str) -> ! {
    let mut command = Command::command();
    command.build();
    match command.find_subcommand_mut(subcommand) {
        Some(subcommand) => subcommand.error(kind, message).exit(),
        None => command.error(kind, message).exit(),
    }
}

fn is_wrong_usage(error: &anyhow::Error) -> bool {
    matches!(
        error.downcast_ref::<GpuError>(),
        Some(GpuError::UnknownAdapter { .. } | GpuError::UnknownBackend { .. })
    )
}
