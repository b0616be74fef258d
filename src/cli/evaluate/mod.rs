//! `whereabot evaluate`: how good models are.

mod pictures;
mod report;
mod rig;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail, ensure};
use clap::{ArgGroup, ValueEnum};
use image::{GrayImage, RgbaImage};
use indicatif::ProgressBar;
use serde::Serialize;

use super::engine::{self, PrecisionName};
use super::{locate, photo};
use crate::camera::{Camera, Distortion};
use crate::cascade::{Locator, Output, Status};
use crate::evaluation::{Annotation, PhotoScore, RigFigures, Score, read_annotations};
use crate::network::Model;
use crate::recording::{Reader, Sample};
use report::Report;

/// Measure how good models are, on recordings and on annotated photos
///
/// Prints tables (or, with --json, one JSON object), and draws pictures into --plots. Each recording and
/// each photo is judged with the weights of its robot. Exits with 0 if all was judged, however good; with
/// 1 if something could not be read or judged; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
#[command(group(ArgGroup::new("subject").required(true).multiple(true).args(["recording", "photos", "without", "rig"])))]
pub struct Args {
    /// Recordings to judge
    #[arg(long, value_name = "DIR", num_args(1..))]
    recording: Vec<PathBuf>,
    /// The models to judge: one a robot
    #[arg(long, value_name = "FILE", num_args(1..), required = true)]
    weights: Vec<PathBuf>,
    /// Which samples of a recording: one in five is there to test with
    #[arg(long, value_enum, default_value_t = Split::All, requires = "recording")]
    split: Split,
    /// A folder of photos to judge
    #[arg(long, value_name = "DIR", requires = "annotations")]
    photos: Option<PathBuf>,
    /// What the photos show (JSON)
    #[arg(long, value_name = "FILE", requires = "photos")]
    annotations: Option<PathBuf>,
    /// Folders of photos without the robot: how often is it found all the same?
    #[arg(long, value_name = "DIR", num_args(1..))]
    without: Vec<PathBuf>,
    /// Recordings of several cameras at once (`whereabot record --cameras`): how well do the joints tell where the
    /// cameras are, and how much better are the joints of several?
    #[arg(long, value_name = "DIR", num_args(1..))]
    rig: Vec<PathBuf>,
    /// Draw charts and sheets of pictures (PNG) into this folder
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Draw into a folder that holds files, and overwrite those of the same name
    #[arg(long, requires = "plots")]
    force: bool,
    /// Judge joints where the joint network puts them, not moved to where an arm can have them
    #[arg(long)]
    no_fit: bool,
    /// One JSON object instead of tables
    #[arg(long)]
    json: bool,
    /// What to store activations in; f16 is for GPUs
    #[arg(long, value_enum, value_name = "NAME", default_value = "f32")]
    precision: PrecisionName,
    #[command(flatten)]
    engine: engine::EngineArgs,
}

/// Which samples of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
enum Split {
    Test,
    Train,
    All,
}

impl Split {
    fn has(self, sample: &Sample) -> bool {
        match self {
            Self::Test => sample.is_test(),
            Self::Train => !sample.is_test(),
            Self::All => true,
        }
    }
}

/// A model, and what runs it.
struct Judged {
    file: PathBuf,
    model: Model,
    locator: Locator,
}

impl Judged {
    fn robot(&self) -> &str {
        &self.model.description.robot
    }
}

/// A recording, and what its model made of it.
struct RecordingScores {
    folder: PathBuf,
    reader: Reader,
    /// Which model.
    by: usize,
    scores: Vec<Score>,
}

impl RecordingScores {
    fn sample(&self, score: &Score) -> anyhow::Result<&Sample> {
        let sample = self.reader.samples().iter().find(|s| s.id == score.id);
        sample.with_context(|| format!("{}: sample {} is gone", self.folder.display(), score.id))
    }
}

/// An annotated photo, and what a model made of it.
struct JudgedPhoto {
    annotation: Annotation,
    path: PathBuf,
    /// Which model.
    by: usize,
    score: PhotoScore,
}

/// A folder of photos without the robot, and in which of them a model found it.
struct WithoutRobot {
    folder: PathBuf,
    /// Which model.
    by: usize,
    images: usize,
    found: Vec<PathBuf>,
}

/// Cameras that saw a robot at the same time, and what their model made of it.
struct RigScores {
    folder: PathBuf,
    /// Which model.
    by: usize,
    figures: RigFigures,
}

/// Everything that was judged.
struct Results {
    split: Split,
    models: Vec<Judged>,
    recordings: Vec<RecordingScores>,
    photos: Vec<JudgedPhoto>,
    without: Vec<WithoutRobot>,
    rigs: Vec<RigScores>,
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(folder) = &args.plots {
        prepare(folder, args.force)?;
    }
    let models = load(args)?;
    // What can be refused is refused before the work.
    let mut recordings = args
        .recording
        .iter()
        .map(|folder| open(folder, &models, args.split))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let photos = annotated(args, &models)?;
    let mut without = Vec::new();
    for folder in &args.without {
        let images = photo::in_folder(folder).with_context(|| folder.display().to_string())?;
        without.push((folder, images));
    }

    let rigs = args
        .rig
        .iter()
        .map(|folder| rig::open(folder, &models))
        .collect::<anyhow::Result<Vec<_>>>()?;

    let samples = |r: &RecordingScores| -> usize {
        let samples = r.reader.samples().iter();
        samples.filter(|sample| args.split.has(sample)).count()
    };
    let images = recordings.iter().map(samples).sum::<usize>()
        + photos.len()
        + models.len() * without.iter().map(|(_, i)| i.len()).sum::<usize>()
        + rigs.iter().map(rig::OpenRig::images).sum::<usize>();
    let bar = locate::progress_bar(images);
    let mut models = models;
    for recording in &mut recordings {
        judge(recording, &mut models, args.split, &bar)?;
    }
    let photos = photos
        .into_iter()
        .map(|(annotation, path, by)| {
            let score = judge_photo(&annotation, &path, &mut models, by)
                .with_context(|| path.display().to_string())?;
            bar.inc(1);
            Ok(JudgedPhoto {
                annotation,
                path,
                by,
                score,
            })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let each_model = 0..models.len();
    let without = without
        .iter()
        .flat_map(|(folder, images)| each_model.clone().map(move |by| (folder, images, by)))
        .map(|(folder, images, by)| {
            Ok(WithoutRobot {
                found: found_in(images, &mut models, by, &bar)?,
                folder: (*folder).clone(),
                by,
                images: images.len(),
            })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let rigs = rigs
        .into_iter()
        .map(|rig| rig::judge(rig, &mut models, &bar))
        .collect::<anyhow::Result<Vec<_>>>()?;
    bar.finish_and_clear();

    let mut results = Results {
        split: args.split,
        models,
        recordings,
        photos,
        without,
        rigs,
    };
    let report = Report::new(&results);
    let text = if args.json {
        serde_json::to_string_pretty(&report)? + "\n"
    } else {
        report.to_string()
    };
    super::print(&text)?;
    if let Some(folder) = &args.plots {
        pictures::draw(&mut results, &report, folder)?;
    }
    Ok(ExitCode::SUCCESS)
}

fn prepare(folder: &Path, force: bool) -> anyhow::Result<()> {
    let named = || folder.display().to_string();
    std::fs::create_dir_all(folder).with_context(named)?;
    let mut entries = std::fs::read_dir(folder).with_context(named)?;
    ensure!(
        force || entries.next().is_none(),
        "{}: holds files; --force draws into it all the same",
        folder.display()
    );
    Ok(())
}

fn load(args: &Args) -> anyhow::Result<Vec<Judged>> {
    let device = args.engine.open()?;
    args.weights
        .iter()
        .map(|file| {
            let mut model = Model::load(file)?;
            if args.no_fit {
                model.description.arm = None;
            }
            Ok(Judged {
                file: file.clone(),
                locator: engine::locator(&model, device.as_ref(), args.precision.into())?,
                model,
            })
        })
        .collect()
}

/// The one model of `robot`.
fn model_of(robot: &str, models: &[Judged]) -> anyhow::Result<Option<usize>> {
    let mut of_robot = (0..).zip(models).filter(|(_, m)| m.robot() == robot);
    let first = of_robot.next();
    if let (Some((_, first)), Some((_, second))) = (first, of_robot.next()) {
        bail!(
            "robot: expected one weights file of {robot}, found {} and {}",
            first.file.display(),
            second.file.display()
        );
    }
    Ok(first.map(|(index, _)| index))
}

fn names(models: &[Judged]) -> String {
    let names = models
        .iter()
        .map(|m| format!("{} ({})", m.robot(), m.file.display()));
    names.collect::<Vec<_>>().join(", ")
}

fn open(folder: &Path, models: &[Judged], split: Split) -> anyhow::Result<RecordingScores> {
    let reader = Reader::open(folder)?;
    let header = reader.header();
    let file = folder.join("recording.json");
    let by = model_of(&header.robot, models)
        .with_context(|| file.display().to_string())?
        .with_context(|| {
            format!(
                "{}: robot: expected weights of {}, found those of {}",
                file.display(),
                header.robot,
                names(models)
            )
        })?;
    let expected = &models[by].model.description.joints;
    ensure!(
        header.joints == *expected,
        "{}: joints: expected those of {}, {expected:?}, found {:?}",
        file.display(),
        models[by].file.display(),
        header.joints
    );
    ensure!(
        reader.samples().iter().any(|sample| split.has(sample)),
        "{}: expected a sample to judge, found none in this split",
        folder.display()
    );
    Ok(RecordingScores {
        folder: folder.to_owned(),
        reader,
        by,
        scores: Vec::new(),
    })
}

/// A sample's picture and camera.
fn picture(reader: &Reader, sample: &Sample) -> anyhow::Result<(RgbaImage, Camera)> {
    let image = image::DynamicImage::from(reader.image(sample)?).into_rgba8();
    let camera = Camera {
        width: image.width(),
        height: image.height(),
        intrinsics: sample.intrinsics,
        distortion: Distortion::None,
    };
    Ok((image, camera))
}

/// A sample's picture, mask and camera.
fn read(reader: &Reader, sample: &Sample) -> anyhow::Result<(RgbaImage, GrayImage, Camera)> {
    let (image, camera) = picture(reader, sample)?;
    Ok((image, reader.mask(sample)?, camera))
}

fn judge(
    recording: &mut RecordingScores,
    models: &mut [Judged],
    split: Split,
    bar: &ProgressBar,
) -> anyhow::Result<()> {
    let locator = &mut models[recording.by].locator;
    let samples = recording.reader.samples().iter();
    for sample in samples.filter(|sample| split.has(sample)) {
        let (image, mask, camera) = read(&recording.reader, sample)?;
        let joints = sample.joints_m.as_deref();
        let score =
            Score::new(sample.id, locator, &camera, &image, &mask, joints).with_context(|| {
                let file = recording.folder.join("samples.jsonl");
                // Ids count from 0 without gaps.
                format!("{}:{}", file.display(), sample.id + 1)
            })?;
        recording.scores.push(score);
        bar.inc(1);
    }
    Ok(())
}

/// The annotated photos, and which model judges each.
fn annotated(args: &Args, models: &[Judged]) -> anyhow::Result<Vec<(Annotation, PathBuf, usize)>> {
    let (Some(folder), Some(file)) = (&args.photos, &args.annotations) else {
        return Ok(Vec::new());
    };
    read_annotations(file)?
        .into_iter()
        .map(|annotation| {
            let place = || format!("{}: {}", file.display(), annotation.file);
            let by = match model_of(&annotation.robot, models).with_context(place)? {
                Some(by) => by,
                None if models.len() == 1 => 0,
                None => bail!(
                    "{}: robot: expected weights of {}, found those of {}",
                    place(),
                    annotation.robot,
                    names(models)
                ),
            };
            let path = folder.join(&annotation.file);
            Ok((annotation, path, by))
        })
        .collect()
}

/// As `locate` sees it: by EXIF's focal length, or else by the assumed one.
fn photo_camera(path: &Path) -> anyhow::Result<(RgbaImage, Camera)> {
    let photo = photo::read(path)?;
    let (camera, _) = locate::camera_of(&photo, None, None)?;
    Ok((photo.image, camera))
}

fn judge_photo(
    annotation: &Annotation,
    path: &Path,
    models: &mut [Judged],
    by: usize,
) -> anyhow::Result<PhotoScore> {
    let (image, camera) = photo_camera(path)?;
    let expected = (annotation.width, annotation.height);
    ensure!(
        image.dimensions() == expected,
        "expected the annotation's {} x {} pixels, found {} x {}",
        expected.0,
        expected.1,
        image.width(),
        image.height()
    );
    let locator = &mut models[by].locator;
    Ok(PhotoScore::new(locator, &camera, &image, annotation)?)
}

fn found_in(
    images: &[PathBuf],
    models: &mut [Judged],
    by: usize,
    bar: &ProgressBar,
) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for path in images {
        let named = || path.display().to_string();
        let (image, camera) = photo_camera(path).with_context(named)?;
        let estimate = models[by]
            .locator
            .locate(&image, &camera, Output::default());
        if estimate.with_context(named)?.status == Status::Found {
            found.push(path.clone());
        }
        bar.inc(1);
    }
    Ok(found)
}
