//! `whereabot locate`: finds the robot in images.

use std::collections::HashSet;
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::engine::{self, PrecisionName};
use super::photo::{self, Photo};
use super::weights;
use crate::camera::{Camera, Intrinsics};
use crate::cascade::{Estimate, EstimateLine, Joint, Locator, Output, Status, rounded};
use crate::draw;
use crate::gpu::{Device, Precision};
use crate::network::Model;

/// Find the robot in images: which pixels it is, and where its joints are
///
/// Writes a summary of each image (or, with --json, a line of JSON), and pictures into --out. Joints
/// are in metres in the camera optical frame (x right, y down, z forward); pixel (0, 0) is the centre
/// of the top-left pixel of the upright image. Exits with 0 if all images were searched, whatever was
/// found; with 1 if one failed; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Images, and folders of images
    #[arg(required = true, value_name = "IMAGE|FOLDER")]
    inputs: Vec<PathBuf>,
    /// The robot to find; which one an image shows is not told, and metres are wrong by another's weights. They are looked for in the folder WHEREABOT_WEIGHTS, in ./weights, and from
    /// the program's folder in weights, ../weights, ../../weights and ../share/whereabot/weights [default: ur5]
    #[arg(long, value_name = "NAME", value_parser = weights::robot_name)]
    robot: Option<String>,
    /// The model file to use
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// The camera's ROS camera_info (YAML); by default EXIF's focal length, or else a phone's
    #[arg(long, value_name = "FILE", conflicts_with = "hfov")]
    camera: Option<PathBuf>,
    /// The camera's horizontal field of view
    #[arg(long, value_name = "DEGREES", value_parser = field_of_view)]
    hfov: Option<f64>,
    /// Write pictures into this folder: STEM.mask.png and STEM.annotated.png
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Overwrite pictures that are there already
    #[arg(long, requires = "out")]
    force: bool,
    /// Find the mask only, no joints: faster
    #[arg(long)]
    mask_only: bool,
    /// Mask pictures of probabilities (0 to 255), not of 0 and 255
    #[arg(long, requires = "out")]
    soft_mask: bool,
    /// One line of JSON an image
    #[arg(long)]
    json: bool,
    /// What to store activations in; f16 is for GPUs
    #[arg(long, value_enum, value_name = "NAME", default_value = "f32")]
    precision: PrecisionName,
    #[command(flatten)]
    engine: engine::EngineArgs,
}

pub(super) fn field_of_view(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(degrees) if degrees > 0.0 && degrees < 180.0 => Ok(degrees),
        _ => Err("expected degrees between 0 and 180".to_owned()),
    }
}

/// Runs the command.
pub fn run(args: Args) -> anyhow::Result<ExitCode> {
    let mut engine = Engine::new(&args)?;
    let camera = args.camera.as_deref().map(Camera::load).transpose()?;
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    }
    let inputs = expand(&args.inputs);
    let progress = progress_bar(inputs.len());
    let mut failed = false;
    let mut stems = HashSet::new();
    for (path, found) in inputs {
        let located = found.and_then(|()| locate(&args, camera, &mut engine, &path, &mut stems));
        failed |= located.is_err();
        // The bar and the lines may share a terminal.
        let is_read = progress.suspend(|| match located {
            Ok(located) => print(&located.line(args.json)?),
            Err(error) if args.json => print(&error_line(&path, &error)?),
            Err(error) => {
                // Nobody is left to tell where stderr is gone too.
                let _ = writeln!(io::stderr(), "{}: error: {error:#}", path.display());
                Ok(true)
            }
        })?;
        progress.inc(1);
        // Pictures are wanted still where they are.
        if !is_read && args.out.is_none() {
            break;
        }
    }
    progress.finish_and_clear();
    Ok(if failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

fn print(line: &str) -> anyhow::Result<bool> {
    Ok(super::print(&format!("{line}\n"))?)
}

/// The images of the inputs, and the inputs that are none.
fn expand(inputs: &[PathBuf]) -> Vec<(PathBuf, anyhow::Result<()>)> {
    let mut images = Vec::new();
    for input in inputs {
        if !input.is_dir() {
            images.push((input.clone(), Ok(())));
            continue;
        }
        match photo::in_folder(input) {
            Ok(found) => images.extend(found.into_iter().map(|path| (path, Ok(())))),
            Err(error) => images.push((input.clone(), Err(error))),
        }
    }
    images
}

pub(super) fn progress_bar(images: usize) -> ProgressBar {
    if images < 2 || !io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(images as u64);
    match ProgressStyle::with_template("{bar:40} {pos}/{len} images, {eta} left") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// The networks on what runs them.
struct Engine<'a> {
    model: Model,
    args: &'a engine::EngineArgs,
    precision: Precision,
    device: Option<Arc<Device>>,
    locator: Locator,
}

impl<'a> Engine<'a> {
    fn new(args: &'a Args) -> anyhow::Result<Self> {
        let device = args.engine.open()?;
        let model = weights::load(args.robot.as_deref(), args.weights.as_deref())?;
        let precision = args.precision.into();
        Ok(Self {
            locator: engine::locator(&model, device.as_ref(), precision)?,
            model,
            args: &args.engine,
            precision,
            device,
        })
    }

    fn locate(
        &mut self,
        photo: &Photo,
        camera: &Camera,
        output: Output,
    ) -> anyhow::Result<Estimate> {
        // A device with a fault stays at it: the next image gets another one.
        if self.device.as_ref().is_some_and(|d| d.check().is_err()) {
            let device = self.args.open()?;
            self.locator = engine::locator(&self.model, device.as_ref(), self.precision)?;
            self.device = device;
        }
        Ok(self.locator.locate(&photo.image, camera, output)?)
    }
}

/// Where a camera's intrinsics come from.
#[derive(Debug, Clone, Copy, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum IntrinsicsSource {
    CameraInfo,
    Hfov,
    Exif,
    Assumed,
}

/// Everything that is said about an image.
struct Located {
    file: String,
    robot: String,
    adapter: String,
    camera: Camera,
    source: IntrinsicsSource,
    estimate: Estimate,
    pictures: Option<Pictures>,
    times: Times,
}

struct Pictures {
    mask: PathBuf,
    annotated: PathBuf,
}

impl Pictures {
    /// Pictures of an image, and whether they may be written.
    fn new(out: &Path, stem: &str, force: bool) -> anyhow::Result<Self> {
        let pictures = Self {
            mask: out.join(format!("{stem}.mask.png")),
            annotated: out.join(format!("{stem}.annotated.png")),
        };
        for file in [&pictures.mask, &pictures.annotated] {
            ensure!(
                force || !file.exists(),
                "{} is there already: --force overwrites it",
                file.display()
            );
        }
        Ok(pictures)
    }
}

/// Milliseconds.
#[derive(Debug, Clone, Copy, Serialize)]
struct Times {
    decode: f64,
    locate: f64,
    draw: f64,
}

fn locate(
    args: &Args,
    calibrated: Option<Camera>,
    engine: &mut Engine<'_>,
    path: &Path,
    stems: &mut HashSet<String>,
) -> anyhow::Result<Located> {
    let pictures = args
        .out
        .as_deref()
        .map(|out| Pictures::new(out, &unused_stem(path, stems), args.force))
        .transpose()?;
    let clock = Instant::now();
    let photo = photo::read(path)?;
    let decode = milliseconds(clock);

    let (camera, source) = camera_of(&photo, calibrated, args.hfov)?;
    let output = Output {
        mask: args.out.is_some(),
        mask_only: args.mask_only,
    };
    let clock = Instant::now();
    let estimate = engine.locate(&photo, &camera, output)?;
    let located = milliseconds(clock);

    let clock = Instant::now();
    if let Some(pictures) = &pictures {
        draw_pictures(args, &engine.model, &photo, &camera, &estimate, pictures)?;
    }
    Ok(Located {
        file: path.display().to_string(),
        robot: engine.model.description.robot.clone(),
        adapter: engine.locator.adapter_name().to_owned(),
        camera,
        source,
        estimate,
        pictures,
        times: Times {
            decode,
            locate: located,
            draw: milliseconds(clock),
        },
    })
}

fn milliseconds(since: Instant) -> f64 {
    rounded(since.elapsed().as_secs_f64() * 1e3, 2)
}

pub(super) fn camera_of(
    photo: &Photo,
    calibrated: Option<Camera>,
    hfov: Option<f64>,
) -> anyhow::Result<(Camera, IntrinsicsSource)> {
    let (width, height) = photo.image.dimensions();
    Ok(if let Some(camera) = calibrated {
        (
            camera.for_image(width, height)?,
            IntrinsicsSource::CameraInfo,
        )
    } else if let Some(degrees) = hfov {
        (
            Camera::from_hfov(width, height, degrees.to_radians()),
            IntrinsicsSource::Hfov,
        )
    } else if let Some(millimetres) = photo.focal_35mm {
        (
            Camera::from_focal_35mm(width, height, millimetres),
            IntrinsicsSource::Exif,
        )
    } else {
        (Camera::assumed(width, height), IntrinsicsSource::Assumed)
    })
}

/// The file's stem; `_2`, `_3`, ... is appended where an earlier image has the same.
fn unused_stem(path: &Path, used: &mut HashSet<String>) -> String {
    let stem = path
        .file_stem()
        .map_or_else(|| "image".into(), |stem| stem.to_string_lossy());
    let mut name = stem.to_string();
    // Some file systems take `A` and `a` for the same.
    for number in 2_u32.. {
        if used.insert(name.to_lowercase()) {
            break;
        }
        name = format!("{stem}_{number}");
    }
    name
}

fn draw_pictures(
    args: &Args,
    model: &Model,
    photo: &Photo,
    camera: &Camera,
    estimate: &Estimate,
    pictures: &Pictures,
) -> anyhow::Result<()> {
    let description = &model.description;
    let mask = estimate
        .mask
        .as_ref()
        .context("the mask was not read back")?;
    let threshold = description.presence.mask_threshold;
    let draw_mask = |threshold| draw::mask_image(mask, &description.camera, camera, threshold);
    let hard = draw_mask(Some(threshold));
    let joints: Vec<_> = estimate.joints.iter().map(|joint| joint.px).collect();
    let annotated = draw::annotated(&photo.image, &hard, &joints);
    let mask = if args.soft_mask {
        draw_mask(None)
    } else {
        hard
    };

    let named = |path: &Path| format!("{}: cannot be written", path.display());
    mask.save(&pictures.mask)
        .with_context(|| named(&pictures.mask))?;
    annotated
        .save(&pictures.annotated)
        .with_context(|| named(&pictures.annotated))?;
    Ok(())
}

/// The version of the JSON lines.
const SCHEMA: u32 = 1;

#[derive(Serialize)]
struct LocatedLine<'a> {
    schema: u32,
    file: &'a str,
    robot: &'a str,
    #[serde(flatten)]
    estimate: EstimateLine<'a>,
    intrinsics: IntrinsicsLine,
    adapter: &'a str,
    ms: Times,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    annotated: Option<String>,
}

#[derive(Serialize)]
struct IntrinsicsLine {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    source: IntrinsicsSource,
}

#[derive(Serialize)]
struct ErrorLine<'a> {
    schema: u32,
    file: &'a str,
    status: &'static str,
    message: &'a str,
}

impl Located {
    fn line(&self, json: bool) -> anyhow::Result<String> {
        if json {
            self.json()
        } else {
            Ok(self.summary())
        }
    }

    fn json(&self) -> anyhow::Result<String> {
        let Intrinsics { fx, fy, cx, cy } = self.camera.intrinsics;
        let path = |path: &Path| path.display().to_string();
        let line = LocatedLine {
            schema: SCHEMA,
            file: &self.file,
            robot: &self.robot,
            estimate: EstimateLine::from(&self.estimate),
            intrinsics: IntrinsicsLine {
                fx: rounded(fx, 3),
                fy: rounded(fy, 3),
                cx: rounded(cx, 3),
                cy: rounded(cy, 3),
                source: self.source,
            },
            adapter: &self.adapter,
            ms: self.times,
            mask: self.pictures.as_ref().map(|p| path(&p.mask)),
            annotated: self.pictures.as_ref().map(|p| path(&p.annotated)),
        };
        Ok(serde_json::to_string(&line)?)
    }

    /// For people.
    fn summary(&self) -> String {
        let estimate = &self.estimate;
        let (found, looks) = match estimate.status {
            Status::Found => (format!("{} found", self.robot), "is robot"),
            Status::NotFound => (
                format!("{} not found", self.robot),
                "looks like it, too little of it surely",
            ),
            Status::Invalid => (
                format!("{} seen, but its joints make no sense", self.robot),
                "is robot",
            ),
        };
        let mut text = format!(
            "{}: {found}; {:.1} % of the image {looks}, {:.0} % was seen ({:.0} ms on {})",
            self.file,
            100.0 * estimate.coverage,
            100.0 * estimate.field,
            self.times.locate,
            self.adapter,
        );
        if !estimate.joints.is_empty() {
            text += &format!(
                "\n  {:14} {:>8} {:>8} {:>8} m {:>9} {:>9} px",
                "joint", "x", "y", "z", "u", "v"
            );
        }
        for Joint { name, xyz_m, px } in &estimate.joints {
            text += &format!(
                "\n  {name:14} {:8.3} {:8.3} {:8.3}   {:9.1} {:9.1}",
                xyz_m[0], xyz_m[1], xyz_m[2], px[0], px[1]
            );
        }
        if let Some(pictures) = &self.pictures {
            text += &format!("\n  {}", pictures.mask.display());
            text += &format!("\n  {}", pictures.annotated.display());
        }
        text
    }
}

fn error_line(path: &Path, error: &anyhow::Error) -> anyhow::Result<String> {
    Ok(serde_json::to_string(&ErrorLine {
        schema: SCHEMA,
        file: &path.display().to_string(),
        status: "error",
        message: &format!("{error:#}"),
    })?)
}
