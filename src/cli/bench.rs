//! `whereabot bench`: how fast networks run here.

use std::ffi::OsStr;
use std::fs::{self, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{ExitCode, Stdio};
use std::time::Instant;

use anyhow::{Context, anyhow, bail, ensure};
use clap::error::ErrorKind;
use image::{ImageFormat, RgbImage, RgbaImage};
use indicatif::ProgressBar;

use super::engine::{self, PrecisionName};
use super::weights;
use crate::benchmark::{self, LayerFigures, Options, Report, Start, Weights, compare};
use crate::camera::Camera;
use crate::cascade::Output;
use crate::draw::{self, Row, RowChart};
use crate::gpu::Precision;
use crate::network::Model;

/// Measure how fast the networks run: layer by layer, and the whole cascade
///
/// Prints tables. --json writes the same for programs; --compare says what became of earlier figures. Only
/// figures of one machine that does nothing else compare well. Exits with 0 if all was measured; with 1 if
/// something failed; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The model file to run [default: that of the UR5, where `locate` looks for it]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    engine: engine::EngineArgs,
    /// Numbers of images that are searched at once [default: 1,4,16]
    #[arg(long, value_name = "N,N,...", value_delimiter = ',',
          value_parser = clap::value_parser!(u32).range(1..))]
    batch: Vec<u32>,
    /// What to store activations in; f16 is for GPUs [default: f32]
    #[arg(long, value_enum, value_name = "NAME,NAME", value_delimiter = ',')]
    precision: Vec<PrecisionName>,
    /// How often each batch is measured [default: for three seconds, 3 to 500 times]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: Option<u32>,
    /// Write the figures into this new file, or with - to standard output (and the tables to standard
    /// error)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Draw where the time goes, layer by layer, at the first batch size, into this new file (PNG)
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Compare with the figures that --json wrote earlier; two files are compared with each other, and
    /// nothing is measured
    #[arg(long, value_name = "FILE", num_args(1..=2))]
    compare: Vec<PathBuf>,
    /// Search one image, say so, and end: what a start costs
    #[arg(long, hide = true)]
    first_result: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.first_result {
        return first_result(args);
    }
    let earlier: Vec<Report> = args
        .compare
        .iter()
        .map(|file| read(file))
        .collect::<anyhow::Result<_>>()?;
    let name = |index: usize| -> String {
        let file = args.compare.get(index);
        file.map_or("this run".to_owned(), |file| file.display().to_string())
    };
    if let [old, new] = earlier.as_slice() {
        args.refuse_measuring();
        let text = compare((&name(0), &name(1)), old, new);
        super::print(&text)?;
        return Ok(ExitCode::SUCCESS);
    }
    let json = args.json.as_deref();
    let to_stdout = json.is_some_and(|file| file.as_os_str() == "-");
    for file in json
        .filter(|_| !to_stdout)
        .into_iter()
        .chain(args.plot.as_deref())
    {
        // Better said before minutes of measuring than after.
        ensure_new(file)?;
    }

    let report = measure(args)?;
    let mut text = report.to_string();
    if let [old] = earlier.as_slice() {
        text += "\n";
        text += &compare((&name(0), &name(1)), old, &report);
    }
    let figures = format!("{}\n", serde_json::to_string_pretty(&report)?);
    if to_stdout {
        // Nobody is left to tell where stderr is gone too.
        let _ = io::stderr().lock().write_all(text.as_bytes());
        super::print(&figures)?;
    } else {
        super::print(&text)?;
    }
    if let Some(file) = json.filter(|_| !to_stdout) {
        OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(file)
            .and_then(|mut file| file.write_all(figures.as_bytes()))
            .with_context(|| format!("{}: cannot be written", file.display()))?;
    }
    if let Some(file) = &args.plot {
        layers_picture(&report)?
            .save_with_format(file, ImageFormat::Png)
            .with_context(|| format!("{}: cannot be written", file.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// The layers of the first batch size and precision as bars, coloured by kernel.
fn layers_picture(report: &Report) -> anyhow::Result<RgbImage> {
    let first = report.layers.first().map(|l| (l.batch, l.precision));
    let of_first = |l: &&LayerFigures| Some((l.batch, l.precision)) == first;
    let layers: Vec<_> = report.layers.iter().filter(of_first).collect();
    let all: f64 = layers.iter().map(|layer| layer.ms_p50).sum();
    let row = |layer: &&LayerFigures| Row {
        name: layer.layer.clone(),
        kind: layer.kernel.clone(),
        value: layer.ms_p50,
        note: match layer.gflop_per_s {
            Some(rate) if layer.gflop > 0.0 => format!("{:.2} ms, {rate:.0} GFLOP/s", layer.ms_p50),
            _ => format!("{:.2} ms", layer.ms_p50),
        },
    };
    let title = match first {
        Some((batch, precision)) => format!(
            "{all:.1} ms for {batch} image{}, {precision}, on {}",
            if batch == 1 { "" } else { "s" },
            report.adapter.name
        ),
        None => report.adapter.name.clone(),
    };
    let rows = layers.iter().map(row).collect();
    Ok(draw::row_chart(&RowChart { title, rows })?)
}

impl Args {
    /// Ends the program where something is to be measured and two files to be compared.
    fn refuse_measuring(&self) {
        let wanted = [
            ("--weights", self.weights.is_some()),
            ("--adapter", self.engine.adapter.is_some()),
            ("--backend", self.engine.backend.is_some()),
            ("--no-tuning", self.engine.no_tuning),
            ("--batch", !self.batch.is_empty()),
            ("--precision", !self.precision.is_empty()),
            ("--frames", self.frames.is_some()),
            ("--json", self.json.is_some()),
            ("--plot", self.plot.is_some()),
        ];
        if let Some((flag, _)) = wanted.iter().find(|(_, given)| *given) {
            let message = format!(
                "the argument '{flag}' cannot be used with two files to '--compare': nothing is measured"
            );
            super::refuse("bench", ErrorKind::ArgumentConflict, &message);
        }
    }

    fn options(&self) -> Options {
        let mut options = Options {
            batches: vec![1, 4, 16],
            runs: self.frames.map(|runs| runs as usize),
            ..Options::default()
        };
        if !self.batch.is_empty() {
            options.batches = once_each(self.batch.iter().map(|&batch| batch as usize));
        }
        if !self.precision.is_empty() {
            options.precisions = once_each(self.precision.iter().map(|&name| name.into()));
        }
        options
    }
}

/// In the order in which they come first.
fn once_each<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    values.fold(Vec::new(), |mut all, value| {
        if !all.contains(&value) {
            all.push(value);
        }
        all
    })
}

fn read(file: &Path) -> anyhow::Result<Report> {
    let json = fs::read(file).with_context(|| format!("{}: cannot be read", file.display()))?;
    Report::from_json(&json).map_err(|problem| anyhow!("{}: {problem}", file.display()))
}

fn ensure_new(file: &Path) -> anyhow::Result<()> {
    ensure!(
        fs::symlink_metadata(file).is_err(),
        "{}: exists already, and is not overwritten",
        file.display()
    );
    super::ensure_folder_of(file)
}

fn measure(args: &Args) -> anyhow::Result<Report> {
    let device = args.engine.open()?;
    let file = weights::path(None, args.weights.as_deref())?;
    let bytes = fs::read(&file).with_context(|| format!("{}: cannot be read", file.display()))?;
    let model = Model::from_bytes(&bytes, &file)?;
    let named = Weights::new(&model, &bytes);

    let bar = ProgressBar::new_spinner();
    let mut progress = |what: &str| {
        bar.set_message(format!("measuring: {what}"));
        bar.tick();
    };
    let options = args.options();
    let mut report = match &device {
        Some(device) => benchmark::on_gpu(device, &model, named, &options, &mut progress)?,
        None => benchmark::on_cpu(&model, named, &options, &mut progress)?,
    };
    if let Some(device) = &device {
        engine::remember(device);
    }
    progress("the start of a process");
    match start(args, &file, device.is_some()) {
        Ok(start) => report.start = Some(start),
        // What was measured before is worth more than this.
        Err(error) => log::warn!("the start of a process could not be measured: {error:#}"),
    }
    bar.finish_and_clear();
    Ok(report)
}

/// What `--first-result` does: everything from an adapter to an answer.
fn first_result(args: &Args) -> anyhow::Result<ExitCode> {
    let device = args.engine.open()?;
    let model = weights::load(None, args.weights.as_deref())?;
    let mut locator = engine::locator(&model, device.as_ref(), Precision::F32)?;
    let image = RgbaImage::new(640, 480);
    locator.locate(&image, &Camera::assumed(640, 480), Output::default())?;
    super::print("done\n")?;
    Ok(ExitCode::SUCCESS)
}

/// Starts this program with empty caches of shaders, then with those that it left.
fn start(args: &Args, weights: &Path, on_gpu: bool) -> anyhow::Result<Start> {
    let cache = Folder::new()?;
    let first = time_to_first_result(args, weights, &cache)?;
    let kept = size_of(&cache.driver())?;
    let again = [
        time_to_first_result(args, weights, &cache)?,
        time_to_first_result(args, weights, &cache)?,
    ];
    let warm_ms = again[0].min(again[1]);
    let (cold_ms, note) = if !on_gpu {
        (None, "plain Rust compiles no shaders: no start is cold")
    } else if kept < 4096 {
        let note = "the driver's cache of shaders could not be emptied: warm is as that cache was";
        (None, note)
    } else {
        let note = "cold: the driver's cache of shaders was empty; warm: it was full";
        (Some(first), note)
    };
    Ok(Start {
        cold_ms: cold_ms.map(|ms| (ms * 10.0).round() / 10.0),
        warm_ms: (warm_ms * 10.0).round() / 10.0,
        note: note.to_owned(),
    })
}

/// From the start of this program, with what its driver compiles kept in `cache`, to its first result, in
/// milliseconds.
fn time_to_first_result(args: &Args, weights: &Path, cache: &Folder) -> anyhow::Result<f64> {
    let mut command = std::process::Command::new(std::env::current_exe()?);
    command.args(["bench", "--first-result", "--weights"]);
    command.arg(weights);
    let engine = &args.engine;
    for (flag, value) in [
        ("--adapter", &engine.adapter),
        ("--backend", &engine.backend),
    ] {
        if let Some(value) = value {
            command.args([flag, value]);
        }
    }
    if engine.no_tuning {
        command.arg("--no-tuning");
    }
    // Mesa's variables and NVIDIA's. Others have none.
    command
        .env("MESA_SHADER_CACHE_DIR", cache.driver())
        .env("__GL_SHADER_DISK_CACHE_PATH", cache.driver())
        .env(engine::PIPELINES_FOLDER, cache.own())
        .env_remove("MESA_SHADER_CACHE_DISABLE")
        .env_remove("__GL_SHADER_DISK_CACHE")
        // Nobody reads stderr before the result is there: a log that fills the pipe would wait for ever.
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let clock = Instant::now();
    let mut child = command.spawn()?;
    let mut line = String::new();
    if let Some(stdout) = child.stdout.take() {
        BufReader::new(stdout).read_line(&mut line)?;
    }
    let elapsed = clock.elapsed().as_secs_f64() * 1e3;
    let mut problem = String::new();
    if let Some(stderr) = &mut child.stderr {
        stderr.read_to_string(&mut problem)?;
    }
    if !child.wait()?.success() || line.is_empty() {
        bail!("{}", problem.trim());
    }
    Ok(elapsed)
}

/// Bytes of all files in a folder, but for Mesa's index, which is as large when it is empty.
fn size_of(folder: &Path) -> io::Result<u64> {
    let mut size = 0;
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let kind = entry.file_type()?;
        if kind.is_dir() {
            size += size_of(&entry.path())?;
        } else if entry.file_name() != OsStr::new("index") {
            size += entry.metadata()?.len();
        }
    }
    Ok(size)
}

/// A new folder for files that nobody keeps.
struct Folder {
    path: PathBuf,
}

impl Folder {
    fn new() -> anyhow::Result<Self> {
        let path = std::env::temp_dir().join(format!("whereabot-bench-{}", std::process::id()));
        let create = |path: &Path| {
            fs::create_dir(path).with_context(|| format!("{}: cannot be created", path.display()))
        };
        create(&path)?;
        let folder = Self { path };
        create(&folder.driver())?;
        create(&folder.own())?;
        Ok(folder)
    }

    /// For the driver's own cache.
    fn driver(&self) -> PathBuf {
        self.path.join("driver")
    }

    /// For what this program keeps of what the driver compiled.
    fn own(&self) -> PathBuf {
        self.path.join("own")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What is left behind lies among other temporary files.
        let _ = fs::remove_dir_all(&self.path);
    }
}
