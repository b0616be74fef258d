//! `whereabot record`: renders a synthetic recording.

use std::path::PathBuf;

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};

use crate::gpu::{AdapterRequest, Device};
use crate::recording::{self, Protocol, Request};

/// Renders a synthetic recording of a robot: colour images, exact masks, joints.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Robot description (URDF)
    #[arg(long, value_name = "FILE")]
    urdf: PathBuf,
    /// Where package://NAME/ is; by default searched upwards from the URDF
    #[arg(long, value_name = "NAME=DIR", value_parser = package)]
    package: Vec<(String, PathBuf)>,
    /// The robot's name
    #[arg(long)]
    robot: String,
    /// Folder of background photos (JPEG, PNG)
    #[arg(long, value_name = "DIR")]
    backgrounds: PathBuf,
    /// How many samples to render
    #[arg(long, value_name = "N")]
    samples: u64,
    /// The same seed gives the same samples
    #[arg(long, value_name = "S")]
    seed: u64,
    /// Folder of the recording; a recording cut off there is continued
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// One camera pose for the whole recording
    #[arg(long, conflicts_with = "free_camera")]
    fixed_camera: bool,
    /// A camera pose of its own for each sample (default)
    #[arg(long)]
    free_camera: bool,
}

fn package(text: &str) -> Result<(String, PathBuf), String> {
    let (name, folder) = text
        .split_once('=')
        .ok_or_else(|| format!("expected NAME=DIR, found \"{text}\""))?;
    Ok((name.to_owned(), folder.into()))
}

/// Runs the command.
///
/// # Errors
/// Without a graphics device, and where [`recording::record`] fails.
pub fn run(args: Args) -> anyhow::Result<()> {
    let protocol = if args.fixed_camera {
        Protocol::FixedCamera
    } else {
        Protocol::FreeCamera
    };
    let request = Request {
        urdf: args.urdf,
        packages: args.package,
        robot: args.robot,
        backgrounds: args.backgrounds,
        samples: args.samples,
        seed: args.seed,
        protocol,
        out: args.out,
    };
    let device = Device::open(&AdapterRequest::new(None, None))?;
    log::info!("rendering on {}", device.info().name);
    let bar = ProgressBar::new(request.samples);
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} samples, {per_sec}, {eta} left")
        .context("the progress bar's template")?;
    bar.set_style(style);
    recording::record(&device, &request, |done| bar.set_position(done))?;
    bar.finish();
    Ok(())
}
