//! `whereabot recording check`: validates recordings, sums them up, draws contact sheets.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use image::{DynamicImage, ImageFormat, RgbImage, imageops};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde_json::json;

use crate::draw;
use crate::recording::{Header, Reader, RecordingError};

/// Work with recordings on disk
#[derive(Debug, clap::Subcommand)]
pub enum Args {
    Check(CheckArgs),
}

/// Check recordings whole, each line and each picture, and sum them up
///
/// What is wrong goes to stderr with file and line, and the exit code is then 1.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    /// The recordings' folders
    #[arg(value_name = "DIR", required = true)]
    folders: Vec<PathBuf>,
    /// Draw a contact sheet (PNG): samples from the whole of each recording, with masks and joints
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
    /// Overwrite the contact sheet
    #[arg(long, requires = "sheet")]
    force: bool,
    /// Print a line of JSON a recording, for programs
    #[arg(long)]
    json: bool,
}

/// How many faults of a recording are told.
const TOLD: usize = 20;
/// Width of a picture on the contact sheet, pixels.
const THUMB: u32 = 256;
/// How many pictures stand in a row of the contact sheet.
const COLUMNS: usize = 6;

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let Args::Check(args) = args;
    if let Some(sheet) = args
        .sheet
        .as_deref()
        .filter(|sheet| sheet.exists() && !args.force)
    {
        bail!("{}: exists; --force overwrites it", sheet.display());
    }
    if let Some(sheet) = &args.sheet {
        super::ensure_folder_of(sheet)?;
    }
    let opened: Vec<_> = args
        .folders
        .iter()
        .map(|f| Reader::open_with_faults(f))
        .collect();
    let count =
        |opened: &Result<(Reader, _), _>| opened.as_ref().map_or(0, |(r, _)| r.samples().len());
    let bar = progress_bar(opened.iter().map(count).sum());
    // One recording fills four rows; several get at least one each.
    let shown = match &args.sheet {
        Some(_) => (4 / args.folders.len()).max(1) * COLUMNS,
        None => 0,
    };
    let mut failed = false;
    let mut thumbs = Vec::new();
    for (folder, opened) in args.folders.iter().zip(opened) {
        let checked = opened.map(|(reader, faults)| check(folder, &reader, faults, shown, &bar));
        bar.suspend(|| match checked {
            Ok(checked) => {
                failed |= !checked.faults.is_empty();
                let text = checked.text(folder, args.json);
                thumbs.push(checked.thumbs);
                for fault in checked.faults.iter().take(TOLD) {
                    tell(&format!("error: {fault}"));
                }
                if checked.faults.len() > TOLD {
                    tell(&format!("and {} more", checked.faults.len() - TOLD));
                }
                super::print(&format!("{text}\n"))
            }
            Err(error) => {
                failed = true;
                tell(&format!("error: {error}"));
                if args.json {
                    let line = json!({"schema": 1, "recording": folder, "faults": [error.to_string()], "fault_count": 1});
                    return super::print(&format!("{line}\n"));
                }
                Ok(true)
            }
        })?;
    }
    bar.finish_and_clear();
    if let Some(path) = &args.sheet {
        sheet(&thumbs)
            .save_with_format(path, ImageFormat::Png)
            .with_context(|| path.display().to_string())?;
    }
    Ok(if failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

fn tell(line: &str) {
    // Nobody is left to tell where stderr is gone too.
    let _ = writeln!(io::stderr(), "{line}");
}

fn progress_bar(samples: usize) -> ProgressBar {
    if !io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(samples as u64);
    match ProgressStyle::with_template("{bar:40} {pos}/{len} samples, {eta} left") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// What is in a recording, and what is wrong with it.
struct Checked {
    header: Header,
    samples: usize,
    test: usize,
    /// The shares of the pictures that the robot covers, where there is one, in ascending order.
    coverage: Vec<f64>,
    /// The least and the greatest distance of a joint from the camera, metres.
    distance: Option<[f64; 2]>,
    faults: Vec<RecordingError>,
    thumbs: Vec<Option<RgbImage>>,
}

fn check(
    folder: &Path,
    reader: &Reader,
    faults: Vec<RecordingError>,
    shown: usize,
    bar: &ProgressBar,
) -> Checked {
    let (header, samples) = (reader.header(), reader.samples());
    let shown = shown.min(samples.len());
    let chosen: Vec<usize> = (0..shown).map(|i| i * samples.len() / shown).collect();
    let looked_at: Vec<_> = samples
        .par_iter()
        .enumerate()
        .map(|(i, sample)| {
            let (image, mask) = (reader.image(sample), reader.mask(sample));
            bar.inc(1);
            match (image, mask) {
                (Ok(image), Ok(mask)) => {
                    let thumb = chosen.contains(&i).then(|| {
                        let image = DynamicImage::ImageRgb8(image).into_rgba8();
                        let joints = sample.joints_px.as_deref().unwrap_or_default();
                        let picture = draw::annotated(&image, &mask, joints);
                        DynamicImage::ImageRgb8(picture)
                            .thumbnail(THUMB, 2 * THUMB)
                            .into_rgb8()
                    });
                    (thumb, Vec::new())
                }
                (image, mask) => (None, image.err().into_iter().chain(mask.err()).collect()),
            }
        })
        .collect();
    let mut all = faults;
    let mut thumbs = Vec::new();
    for (i, (thumb, faults)) in looked_at.into_iter().enumerate() {
        all.extend(faults);
        if chosen.contains(&i) {
            thumbs.push(thumb);
        }
    }
    all.sort_by_key(|fault| match fault {
        RecordingError::Line { line, .. } => *line,
        _ => u64::MAX,
    });

    let found = samples.len() as u64;
    if let Some(planned) = header.source.planned.filter(|&planned| planned > found) {
        all.push(RecordingError::Header {
            path: folder.join("recording.json"),
            message: format!("source.planned: expected {planned} samples, found {found} good ones"),
        });
    }
    let mut coverage: Vec<f64> = samples
        .iter()
        .filter(|sample| sample.joints_m.is_some())
        .map(|sample| sample.coverage)
        .collect();
    coverage.sort_by(f64::total_cmp);
    let joints = samples.iter().filter_map(|sample| sample.joints_m.as_ref());
    let distance = joints
        .flatten()
        .map(|[x, y, z]| x.hypot(*y).hypot(*z))
        .map(|distance| [distance; 2])
        .reduce(|[least, most], [d, _]| [least.min(d), most.max(d)]);
    Checked {
        header: header.clone(),
        samples: samples.len(),
        test: samples.iter().filter(|sample| sample.is_test()).count(),
        coverage,
        distance,
        faults: all,
        thumbs,
    }
}

impl Checked {
    fn text(&self, folder: &Path, as_json: bool) -> String {
        let quantile = |q: f64| {
            let place = q * self.coverage.len().saturating_sub(1) as f64;
            self.coverage.get(place.round() as usize).copied()
        };
        let quantiles = [0.0, 0.05, 0.5, 0.95, 1.0].map(quantile);
        let with_robot = self.coverage.len();
        let typical = self
            .coverage
            .iter()
            .filter(|c| (0.06..=0.17).contains(*c))
            .count();
        let typical = typical as f64 / with_robot.max(1) as f64;
        let (header, source) = (&self.header, &self.header.source);
        if as_json {
            let told: Vec<String> = self
                .faults
                .iter()
                .take(TOLD)
                .map(ToString::to_string)
                .collect();
            let [min, p05, median, p95, max] = quantiles;
            let line = json!({
                "schema": 1, "recording": folder, "robot": header.robot, "kind": source.kind,
                "protocol": source.protocol, "width": header.width, "height": header.height,
                "samples": self.samples, "planned": source.planned, "train": self.samples - self.test,
                "test": self.test, "with_robot": with_robot,
                "coverage": {"min": min, "p05": p05, "median": median, "p95": p95, "max": max},
                "coverage_6_to_17_percent": typical, "joint_distance_m": self.distance,
                "faults": told, "fault_count": self.faults.len(),
            });
            return line.to_string();
        }
        let (kind, protocol) = (json!(source.kind), json!(source.protocol));
        let mut lines = vec![format!(
            "{}: {}, {}, {} x {}",
            folder.display(),
            header.robot,
            protocol.as_str().or(kind.as_str()).unwrap_or_default(),
            header.width,
            header.height
        )];
        let mut samples = format!("  samples     {}", self.samples);
        if let Some(planned) = source.planned {
            samples += &format!(" of {planned}");
        }
        let train = self.samples - self.test;
        lines.push(format!(
            "{samples}: {train} to train, {} to test with",
            self.test
        ));
        lines.push(format!("  with robot  {with_robot}"));
        if let [Some(min), Some(p05), Some(median), Some(p95), Some(max)] =
            quantiles.map(|q| q.map(|q| 100.0 * q))
        {
            lines.push(format!(
                "  coverage    {min:.1} % to {max:.1} %, median {median:.1} %, nine in ten {p05:.1} % to {p95:.1} %; \
                 {:.0} % of these are within 6 % to 17 %",
                100.0 * typical
            ));
        }
        if let Some([least, most]) = self.distance {
            lines.push(format!(
                "  joints      {least:.2} m to {most:.2} m from the camera"
            ));
        }
        lines.push(match self.faults.len() {
            0 => "  faults      none".to_owned(),
            count => format!("  faults      {count}"),
        });
        lines.join("\n")
    }
}

/// Each recording's pictures in rows; a picture that could not be read is black.
fn sheet(recordings: &[Vec<Option<RgbImage>>]) -> RgbImage {
    let rows: Vec<&[Option<RgbImage>]> =
        recordings.iter().flat_map(|r| r.chunks(COLUMNS)).collect();
    let thumbs = recordings.iter().flatten().flatten();
    let height = thumbs.map(RgbImage::height).max().unwrap_or(THUMB);
    let mut sheet = RgbImage::new(COLUMNS as u32 * THUMB, rows.len().max(1) as u32 * height);
    for (row, thumbs) in (0_i64..).zip(rows) {
        for (column, thumb) in (0_i64..).zip(thumbs) {
            if let Some(thumb) = thumb {
                let (x, y) = (column * i64::from(THUMB), row * i64::from(height));
                imageops::replace(&mut sheet, thumb, x, y);
            }
        }
    }
    sheet
}
