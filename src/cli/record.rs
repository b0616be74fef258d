//! `whereabot record`: renders a synthetic recording.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::error::ErrorKind;
use indicatif::{ProgressBar, ProgressStyle};

use crate::gpu::{AdapterRequest, Device};
use crate::recorder::{self, PAPER, Request, paper_requests};
use crate::recording::Protocol;
use crate::robot::Robot;

/// Render a synthetic recording of a robot: colour images, exact masks, joints
///
/// Poses are without collisions. The same arguments give the same samples, and a recording that was cut
/// off is continued. With a free camera the samples do not depend on their number: the recording can be
/// given more of them.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The robot description (URDF); its meshes may be COLLADA, STL or OBJ. With --paper three times, as
    /// ur3=FILE, ur5=FILE and ur10=FILE
    #[arg(long, value_name = "FILE", required = true)]
    urdf: Vec<PathBuf>,
    /// Where package://NAME/ is; by default searched upwards from the URDF
    #[arg(long, value_name = "NAME=DIR", value_parser = package)]
    package: Vec<(String, PathBuf)>,
    /// Another body of the same robot: where its joints' points are (JSON) and its URDF; repeatable.
    /// With a free camera the robot has one of these bodies as often as its own
    #[arg(long, value_name = "FRAMES=URDF", value_parser = body, conflicts_with_all = ["paper", "fixed_camera"])]
    body: Vec<(PathBuf, PathBuf)>,
    /// The robot's name, which the recording carries
    #[arg(long, value_name = "NAME", required_unless_present = "paper")]
    robot: Option<String>,
    /// A folder of background photos (JPEG, PNG)
    #[arg(long, value_name = "DIR")]
    backgrounds: PathBuf,
    /// How many samples the recording shall have
    #[arg(long, value_name = "N", required_unless_present = "paper", value_parser = clap::value_parser!(u64).range(1..))]
    samples: Option<u64>,
    /// Seed of the random numbers: the same seed gives the same samples
    #[arg(long, value_name = "S")]
    seed: u64,
    /// The recording's folder; with --paper the folder of the nine recordings' folders
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// One camera and one look for the whole recording; all joints are swept through their ranges
    #[arg(long, conflicts_with = "free_camera")]
    fixed_camera: bool,
    /// A camera and a look of its own for each sample, some of them without the robot (the default)
    #[arg(long)]
    free_camera: bool,
    /// How many cameras see each pose of the robot. Several make a recording each: camera_1, camera_2 and so
    /// on in --out, whose samples of one number are of one instant
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=16))]
    cameras: u64,
    /// The paper's nine recordings of UR3, UR5 and UR10 with fixed cameras: 4,350 samples
    #[arg(long, conflicts_with_all = ["robot", "samples", "fixed_camera", "free_camera", "cameras"])]
    paper: bool,
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

/// The one recording, or the paper's nine; `Err` says what is wrong with `--urdf`.
fn requests(args: Args) -> Result<Vec<Request>, String> {
    if args.paper {
        let urdfs = paper_urdfs(&args.urdf)?;
        let (backgrounds, out) = (&args.backgrounds, &args.out);
        return Ok(paper_requests(
            urdfs,
            &args.package,
            backgrounds,
            args.seed,
            out,
        ));
    }
    let [urdf] = <[PathBuf; 1]>::try_from(args.urdf)
        .map_err(|found| format!("expected one --urdf, found {}", found.len()))?;
    Ok(vec![Request {
        urdf,
        packages: args.package,
        bodies: args.body,
        // The parser has seen to these two.
        robot: args.robot.unwrap_or_default(),
        samples: args.samples.unwrap_or_default(),
        backgrounds: args.backgrounds,
        seed: args.seed,
        protocol: if args.fixed_camera {
            Protocol::FixedCamera
        } else {
            Protocol::FreeCamera
        },
        cameras: args.cameras,
        out: args.out,
    }])
}

/// The paper's robots' URDFs from `NAME=FILE`, in any order.
fn paper_urdfs(named: &[PathBuf]) -> Result<[PathBuf; 3], String> {
    let robots = PAPER.map(|(robot, _)| robot);
    let mut files = robots.map(|_| None);
    for argument in named {
        let (name, file) = argument
            .to_str()
            .and_then(|text| text.split_once('='))
            .unwrap_or_default();
        let slot = robots
            .iter()
            .zip(&mut files)
            .find(|(robot, _)| **robot == name);
        let Some((_, slot)) = slot else {
            let found = argument.display();
            return Err(format!(
                "with --paper, expected --urdf ur3=FILE, ur5=FILE and ur10=FILE, found {found}"
            ));
        };
        if slot.replace(PathBuf::from(file)).is_some() {
            return Err(format!("found --urdf {name}=FILE twice"));
        }
    }
    match files {
        [Some(a), Some(b), Some(c)] => Ok([a, b, c]),
        files => {
            let missing = robots.iter().zip(&files).find(|(_, file)| file.is_none());
            let name = missing.map_or("", |(name, _)| name);
            Err(format!("with --paper, expected --urdf {name}=FILE as well"))
        }
    }
}

/// Runs the command.
pub fn run(args: Args) -> anyhow::Result<ExitCode> {
    let requests = match requests(args) {
        Ok(requests) => requests,
        Err(message) => super::refuse("record", ErrorKind::ValueValidation, &message),
    };
    if requests.len() > 1 {
        // What is wrong with the last robot shall not be told after hours.
        for request in requests.iter().step_by(3) {
            let robot = Robot::load(&request.urdf, &request.packages)?;
            recorder::check_robot(request, &robot)?;
        }
    }
    let device = Device::open(&AdapterRequest::new(None, None))?;
    log::info!("rendering on {}", device.info().name);
    // Drawn on a terminal only.
    let bar = ProgressBar::new(requests.iter().map(|request| request.samples).sum());
    let template = "{bar:40} {pos}/{len} samples, {per_sec}, {eta} left {msg}";
    let bar = match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    };
    let mut before = 0;
    for request in &requests {
        if requests.len() > 1 {
            bar.set_message(format!("({})", request.out.display()));
        }
        recorder::record(&device, request, |done| bar.set_position(before + done))
            .with_context(|| request.out.display().to_string())?;
        before += request.samples;
    }
    bar.finish();
    Ok(ExitCode::SUCCESS)
}
