//! `whereabot watch`: finds the robots in the frames of many cameras, live.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Sender};
use std::thread;
use std::time::Duration;

use anyhow::{Context, ensure};
use signal_hook::consts::{SIGINT, SIGTERM};

use super::engine::{self, PrecisionName};
use super::locate::field_of_view;
use super::weights;
use crate::camera::Camera;
use crate::gpu::{Device, GpuError};
use crate::live::mcap::{RecordedCamera, Recorder};
use crate::live::page::{self, CameraInfo};
use crate::live::warning::{Warnings, uncertainty_m};
use crate::live::{
    Calibration, CameraConfig, Config, CpuEngine, Engine, Event, EventKind, Fusion, GpuEngine,
    GpuOptions, KnownModel, Lines, Location, Named, NamedRig, Observation, Sink, Statistics, Stop,
    Word, watch,
};
use crate::network::{Description, Model};

/// Find the robots in the frames of many cameras, live
///
/// Writes JSON Lines: a result a camera a frame, events (a camera is live, stale, failed, ended; the GPU is lost, back),
/// and once a second statistics. Always the newest frame of each camera is searched; older ones are dropped and
/// counted. A camera that fails is opened again and delays no other. Stops with Ctrl-C, SIGTERM, its terminal, or when all
/// sources came to their end. Videos, streams and webcams are read by ffmpeg (5.1 or newer), which must be on the
/// PATH. Exits with 0; with 1 if it could not start, could not write what it
/// found, or a file could not be read to its end; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The cameras (see docs/watch.md)
    #[arg(value_name = "CAMERAS.TOML", required_unless_present = "source")]
    config: Option<PathBuf>,
    /// A camera without a file, may be given several times: a webcam's number, a stream's address, a video, a folder
    /// of images, a recording
    #[arg(long, value_name = "SOURCE", conflicts_with = "config")]
    source: Vec<String>,
    /// With --source: the robot to find [default: ur5]
    #[arg(long, value_name = "NAME", value_parser = weights::robot_name, conflicts_with = "config")]
    robot: Option<String>,
    /// With --source: the model file to use
    #[arg(long, value_name = "FILE", conflicts_with = "config")]
    weights: Option<PathBuf>,
    /// With --source: the cameras' ROS camera_info (YAML); by default a phone's camera is assumed
    #[arg(long, value_name = "FILE", conflicts_with_all = ["hfov", "config"])]
    camera: Option<PathBuf>,
    /// With --source: the cameras' horizontal field of view
    #[arg(long, value_name = "DEGREES", value_parser = field_of_view, conflicts_with = "config")]
    hfov: Option<f64>,
    /// A new file for what the cameras saw and what was found: MCAP, ROS 2 messages
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// A page of all cameras, at HOST:PORT, for a browser; on an address that other machines reach it has a token
    #[arg(long, value_name = "ADDRESS")]
    serve: Option<String>,
    /// What to store activations in; f16 is for GPUs
    #[arg(long, value_enum, value_name = "NAME", default_value = "f32")]
    precision: PrecisionName,
    #[command(flatten)]
    engine: engine::EngineArgs,
}

/// Runs the command.
pub fn run(args: Args) -> anyhow::Result<ExitCode> {
    let mut models = Models::default();
    let config = config(&args, &mut models)?;
    let cameras = &config.cameras;
    for camera in cameras {
        let name = || format!("camera `{}`", camera.name);
        camera.location.check().with_context(name)?;
        if camera.calibration == Calibration::Assumed
            && !matches!(camera.location, Location::Recording(_))
        {
            log::warn!(
                "{}: no camera_info and no hfov: a phone's main camera is assumed",
                name()
            );
        }
    }
    let stop = Arc::new(Stop::default());
    // Open until the end.
    let page = page(&args, cameras, &models)?;
    // Files and pages show masks.
    let mask = args.record.is_some() || args.serve.is_some();
    let engine = engine(&args, &models, cameras.len(), mask)?;
    stop_on_signals(&stop).context("signals cannot be handled")?;
    // Last: they make files, and do what warnings ask for.
    let (say, words) = mpsc::channel();
    let failed = Arc::new(AtomicBool::new(false));
    let mut sinks = sinks(&args, &config, &models, &say, &stop, &failed)?;
    sinks.extend(page.iter().map(|page| Box::new(page.sink()) as _));
    let inputs = cameras.iter().map(CameraConfig::input).collect();
    let errors = watch(inputs, engine, sinks, words, &stop);
    errors.iter().for_each(|error| log::error!("{error}"));
    Ok(if errors.is_empty() && !failed.load(Ordering::Relaxed) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// SIGHUP, unless it is ignored, as after `nohup`: a handler would undo that. Where nothing tells, it stays as it is.
#[cfg(unix)]
fn hang_up() -> Option<i32> {
    use signal_hook::consts::SIGHUP;
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let ignored = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))?;
    let ignored = u64::from_str_radix(ignored.trim(), 16).ok()?;
    (ignored >> (SIGHUP - 1) & 1 == 0).then_some(SIGHUP)
}

/// There is none.
#[cfg(not(unix))]
fn hang_up() -> Option<i32> {
    None
}

/// Sets `stop` on Ctrl-C, on SIGTERM, and when the terminal closes.
fn stop_on_signals(stop: &Arc<Stop>) -> io::Result<()> {
    let signalled = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM].into_iter().chain(hang_up()) {
        signal_hook::flag::register(signal, Arc::clone(&signalled))?;
    }
    let stop = Arc::clone(stop);
    // A handler may do little more than set a flag.
    thread::spawn(move || {
        while !stop.wait(Duration::from_millis(20)) {
            if signalled.load(Ordering::Relaxed) {
                stop.set();
            }
        }
    });
    Ok(())
}

/// Where a camera's failure is kept that is its last.
struct Failures(Arc<AtomicBool>);

impl Sink for Failures {
    fn observation(&mut self, _: &Observation) {}

    fn statistics(&mut self, _: &Statistics) {}

    fn event(&mut self, event: &Event) {
        if let EventKind::Failed { retry_in: None, .. } = event.kind {
            self.0.store(true, Ordering::Relaxed);
        }
    }
}

/// Where results go. `failed` is set where stdout took no more, but its reader did not leave, and where a camera failed
/// that is not tried again.
fn sinks(
    args: &Args,
    config: &Config,
    models: &Models,
    say: &Sender<Word>,
    stop: &Arc<Stop>,
    failed: &Arc<AtomicBool>,
) -> anyhow::Result<Vec<Box<dyn Sink>>> {
    let cameras = &config.cameras;
    let named = cameras.iter().map(|camera| Named {
        camera: camera.name.clone(),
        robot: models.robot(camera.robot.place).to_owned(),
    });
    let (closed, unwritten) = (Arc::clone(stop), Arc::clone(failed));
    let lines = Lines::new(named.collect(), io::stdout(), move |error| {
        if error.kind() != io::ErrorKind::BrokenPipe {
            log::error!("stdout: {error}");
            unwritten.store(true, Ordering::Relaxed);
        }
        // The reader, such as `head`, has what it wanted.
        closed.set();
    });
    let rigs = config.rigs.iter().map(|rig| {
        let first = rig.cameras.first().and_then(|&first| cameras.get(first));
        let description = first.and_then(|first| models.description(first.robot.place));
        NamedRig {
            rig: rig.name.clone(),
            cameras: rig.cameras.clone(),
            joints: description.map_or_else(Vec::new, |of| of.joints.clone()),
        }
    });
    let lines = lines.with_rigs(rigs.collect());
    let failures = Failures(Arc::clone(failed));
    let mut sinks: Vec<Box<dyn Sink>> = vec![Box::new(lines), Box::new(failures)];
    for (number, rig) in config.rigs.iter().enumerate() {
        let say = say.clone();
        let fused = move |fused| drop(say.send(Word::Fused(fused)));
        let fusion = Fusion::new(number, &rig.cameras, rig.options, rig.smoothing_s, fused);
        sinks.push(Box::new(fusion));
    }
    let recorder = recorder(args, cameras, models)?;
    // After all that may fail: at their start nothing is known, and that is acted on.
    if !config.warnings.rules.is_empty() {
        let observers: Vec<_> = cameras.iter().map(CameraConfig::observer).collect();
        let say = say.clone();
        // Nobody listens any more at the end.
        let emit = move |event| drop(say.send(Word::Event(event)));
        sinks.push(Box::new(Warnings::start(
            &config.warnings,
            &observers,
            emit,
        )?));
    }
    sinks.extend(recorder.map(|recorder| Box::new(recorder) as _));
    Ok(sinks)
}

/// The file of what cameras saw, where there is to be one.
fn recorder(
    args: &Args,
    cameras: &[CameraConfig],
    models: &Models,
) -> anyhow::Result<Option<Recorder>> {
    let Some(file) = &args.record else {
        return Ok(None);
    };
    let recorded = cameras.iter().map(|camera| {
        let description = models.description(camera.robot.place)?;
        Some(RecordedCamera {
            name: camera.name.clone(),
            robot: description.robot.clone(),
            joints: description.joints.clone(),
            canonical: description.camera,
        })
    });
    let recorded: Vec<_> = recorded.flatten().collect();
    Ok(Some(Recorder::create(file, &recorded)?))
}

/// The page, where there is to be one.
fn page(
    args: &Args,
    cameras: &[CameraConfig],
    models: &Models,
) -> anyhow::Result<Option<page::Server>> {
    let Some(address) = &args.serve else {
        return Ok(None);
    };
    let shown = cameras.iter().map(|camera| {
        let description = models.description(camera.robot.place)?;
        Some(CameraInfo {
            name: camera.name.clone(),
            robot: description.robot.clone(),
            canonical: description.camera,
            common_from_camera: camera.world_from_camera.map(|pose| pose.matrix()),
        })
    });
    let server = page::Server::bind(address, shown.flatten().collect())?;
    // Not a log line: who filters those needs it, too.
    writeln!(io::stderr(), "the page: {}", server.url())?;
    Ok(Some(server))
}

fn config(args: &Args, models: &mut Models) -> anyhow::Result<Config> {
    if let Some(file) = &args.config {
        let mut find = |robot: Option<&str>, file: Option<&Path>| {
            models
                .find(robot, file)
                .map_err(|error| format!("{error:#}"))
        };
        return Ok(Config::load(file, &mut find)?);
    }
    let robot = models.find(args.robot.as_deref(), args.weights.as_deref())?;
    let calibration = match (&args.camera, args.hfov) {
        (Some(file), _) => Calibration::CameraInfo(Camera::load(file)?),
        (None, Some(degrees)) => Calibration::Hfov(degrees.to_radians()),
        (None, None) => Calibration::Assumed,
    };
    let cameras = args.source.iter().zip(1..).map(|(source, number)| {
        let location = Location::new(source, Path::new("")).map_err(anyhow::Error::msg)?;
        ensure!(
            calibration == Calibration::Assumed || !matches!(location, Location::Recording(_)),
            "{source}: expected neither --camera nor --hfov: a recording has its own"
        );
        Ok(CameraConfig {
            calibration,
            ..CameraConfig::new(format!("camera_{number}"), location, robot)
        })
    });
    Ok(Config {
        cameras: cameras.collect::<anyhow::Result<_>>()?,
        rigs: Vec::new(),
        warnings: Default::default(),
    })
}

fn engine(
    args: &Args,
    models: &Models,
    cameras: usize,
    mask: bool,
) -> anyhow::Result<Box<dyn Engine>> {
    let models: Vec<Model> = models.0.iter().map(|(_, model)| model.clone()).collect();
    let precision = args.precision.into();
    let Some(device) = args.engine.open()? else {
        engine::ensure_f32(precision)?;
        return Ok(Box::new(CpuEngine::new(&models, mask)));
    };
    let mut first = Some(Arc::clone(&device));
    let request = args.engine.clone();
    let reopen = move || -> Result<Arc<Device>, GpuError> {
        match first.take() {
            Some(device) => Ok(device),
            None => request.open()?.ok_or_else(|| GpuError::NoAdapter {
                backends: "all".into(),
            }),
        }
    };
    let options = GpuOptions {
        precision,
        cameras,
        mask,
    };
    let engine = GpuEngine::new(Box::new(reopen), models, options)?;
    engine::remember(&device);
    Ok(Box::new(engine))
}

/// The models of all cameras, each loaded once.
#[derive(Default)]
struct Models(Vec<(PathBuf, Model)>);

impl Models {
    /// A robot's model or a model file.
    fn find(&mut self, robot: Option<&str>, file: Option<&Path>) -> anyhow::Result<KnownModel> {
        if let Some(robot) = robot {
            weights::robot_name(robot).map_err(anyhow::Error::msg)?;
        }
        let path = weights::path(robot, file)?;
        let known = self.0.iter().position(|(known, _)| *known == path);
        let place = match known {
            Some(place) => place,
            None => {
                let model = Model::load(&path)?;
                self.0.push((path.clone(), model));
                self.0.len() - 1
            }
        };
        if let Some(robot) = robot {
            let trained_for = self.robot(place);
            ensure!(
                robot == trained_for,
                "{}: robot: expected {robot}, found {trained_for}",
                path.display()
            );
        }
        Ok(KnownModel {
            place,
            uncertainty_m: self.description(place).and_then(uncertainty_m),
        })
    }

    /// The robot that a model finds.
    fn robot(&self, place: usize) -> &str {
        self.description(place).map_or("", |of| &of.robot)
    }

    fn description(&self, place: usize) -> Option<&Description> {
        let (_, model) = self.0.get(place)?;
        Some(&model.description)
    }
}
