//! `whereabot record`: renders a synthetic recording.

use std::path::PathBuf;
use std::process::ExitCode;

use indicatif::{ProgressBar, ProgressStyle};

use crate::gpu::{AdapterRequest, Device};
use crate::recording::{self, Protocol, Request};

/// Render a synthetic recording of a robot: colour images, exact masks, joints
///
/// Poses are drawn at random, without collisions. The same seed gives the same samples, whatever their
/// number: a recording that was cut off, or that should get more samples, is continued.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The robot description (URDF); its meshes may be COLLADA, STL or OBJ
    #[arg(long, value_name = "FILE")]
    urdf: PathBuf,
    /// Where package://NAME/ is; by default searched upwards from the URDF
    #[arg(long, value_name = "NAME=DIR", value_parser = package)]
    package: Vec<(String, PathBuf)>,
    /// Another body of the same robot: where its joints' points are (JSON) and its URDF; repeatable.
    /// With a free camera the robot has one of these bodies as often as its own
    #[arg(long, value_name = "FRAMES=URDF", value_parser = body)]
    body: Vec<(PathBuf, PathBuf)>,
    /// The robot's name, which the recording carries
    #[arg(long, value_name = "NAME")]
    robot: String,
    /// A folder of background photos (JPEG, PNG)
    #[arg(long, value_name = "DIR")]
    backgrounds: PathBuf,
    /// How many samples the recording shall have
    #[arg(long, value_name = "N")]
    samples: u64,
    /// What the samples are drawn from
    #[arg(long, value_name = "S")]
    seed: u64,
    /// The recording's folder
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// One camera and one look for the whole recording; the robot moves
    #[arg(long, conflicts_with = "free_camera")]
    fixed_camera: bool,
    /// A camera and a look of its own for each sample, some of them without the robot (the default)
    #[arg(long)]
    free_camera: bool,
}

fn package(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, folder)) => Ok((name.to_owned(), folder.into())),
        None => Err("expected NAME=DIR".to_owned()),
    }
}

fn body(text: &str) -> Result<(PathBuf, PathBuf), String> {
    match text.split_once('=') {
        Some((frames, urdf)) => Ok((frames.into(), urdf.into())),
        None => Err("expected FRAMES=URDF".to_owned()),
    }
}

/// Runs the command.
pub fn run(args: Args) -> anyhow::Result<ExitCode> {
    let request = Request {
        urdf: args.urdf,
        packages: args.package,
        bodies: args.body,
        robot: args.robot,
        backgrounds: args.backgrounds,
        samples: args.samples,
        seed: args.seed,
        protocol: if args.fixed_camera {
            Protocol::FixedCamera
        } else {
            Protocol::FreeCamera
        },
        out: args.out,
    };
    let device = Device::open(&AdapterRequest::new(None, None))?;
    log::info!("rendering on {}", device.info().name);
    // Drawn on a terminal only.
    let bar = ProgressBar::new(request.samples);
    let template = "{bar:40} {pos}/{len} samples, {per_sec}, {eta} left";
    let bar = match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    };
    recording::record(&device, &request, |done| bar.set_position(done))?;
    bar.finish();
    Ok(ExitCode::SUCCESS)
}
