//! What was measured, as charts and as pictures.

use std::path::Path;

use anyhow::Context;
use image::{DynamicImage, GrayImage, RgbImage, RgbaImage};

use super::report::{Report, in_words, status};
use super::{Judged, JudgedPhoto, RecordingScores, Results, photo_camera, read};
use crate::camera::Camera;
use crate::cascade::{Mask, Output, Status};
use crate::draw::{self, BarChart, BarGroup, Line, LineChart, SheetRow};
use crate::evaluation::Score;

/// Worst cases on a sheet.
const WORST: usize = 8;
/// Samples in the figure of masks.
const EXAMPLES: usize = 6;
/// Photos on a sheet, the worst first.
const PHOTOS: usize = 24;

/// Draws everything into `folder`.
pub fn draw(results: &mut Results, report: &Report, folder: &Path) -> anyhow::Result<()> {
    if let Some(chart) = training(&results.models)? {
        save(&chart, folder, "training.png")?;
    }
    if !report.robots.is_empty() {
        save(&joint_errors(report)?, folder, "joint_errors.png")?;
    }
    for by in 0..results.models.len() {
        let model = &mut results.models[by];
        let own: Vec<_> = results.recordings.iter().filter(|r| r.by == by).collect();
        let cases: Vec<Case> = own
            .iter()
            .flat_map(|recording| recording.scores.iter().map(|score| (*recording, score)))
            // Of robots that are barely in view little can be expected.
            .filter(|(_, score)| score.joints.is_some())
            .collect();
        if cases.is_empty() {
            continue;
        }
        let name = file_name(model.robot());
        let iou = |score: &Score| score.mask.iou().unwrap_or(0.0);
        let error = |score: &Score| {
            let joints = score.joints.as_ref();
            joints.map_or(0.0, |joints| joints.estimated_mask.mean_cm())
        };
        let sheet = side_by_side(model, &worst(&cases, iou))?;
        save(&sheet, folder, &format!("worst_masks_{name}.png"))?;
        let sheet = side_by_side(model, &worst(&cases, |score| -error(score)))?;
        save(&sheet, folder, &format!("worst_joints_{name}.png"))?;
        let step = cases.len().div_ceil(EXAMPLES);
        let examples: Vec<Case> = cases.iter().step_by(step).copied().collect();
        save(
            &masks(model, &examples)?,
            folder,
            &format!("masks_{name}.png"),
        )?;
    }
    if !results.photos.is_empty() {
        let sheet = photos(&mut results.models, &results.photos)?;
        save(&sheet, folder, "photos.png")?;
    }
    Ok(())
}

/// A judged sample.
type Case<'a> = (&'a RecordingScores, &'a Score);

fn save(picture: &RgbImage, folder: &Path, name: &str) -> anyhow::Result<()> {
    let path = folder.join(name);
    let cannot = || format!("{}: cannot be written", path.display());
    picture.save(&path).with_context(cannot)
}

/// A robot's name as a part of a file's.
fn file_name(robot: &str) -> String {
    let safe = |c: char| if c.is_alphanumeric() { c } else { '_' };
    robot.chars().map(safe).collect()
}

/// The paper's three plots: accuracy over training iterations. `None` without curves.
fn training(models: &[Judged]) -> anyhow::Result<Option<RgbImage>> {
    let mut charts = [
        ("mask_accuracy", "mask accuracy, %", 100.0),
        ("true_mask_cm", "joint error, true mask, cm", 1.0),
        ("estimated_mask_cm", "joint error, full system, cm", 1.0),
    ]
    .map(|(key, title, scale)| {
        let chart = LineChart {
            title: title.to_owned(),
            x: "training iteration".to_owned(),
            lines: Vec::new(),
        };
        (key, scale, chart)
    });
    for model in models {
        let curves = &model.model.description.card["curves"];
        for (key, scale, chart) in &mut charts {
            let curve = &curves[&**key];
            if curve.is_null() {
                log::warn!(
                    "{}: its card has no curves.{key}: it is not drawn",
                    model.file.display()
                );
                continue;
            }
            let points = serde_json::from_value::<Vec<[f64; 2]>>(curve.clone()).ok();
            let points = points
                .filter(|points| !points.is_empty())
                .with_context(|| {
                    format!(
                        "{}: card: curves.{key}: expected [[iteration, value], ...], found {curve}",
                        model.file.display()
                    )
                })?;
            let stem = model.file.file_stem().unwrap_or_default();
            chart.lines.push(Line {
                name: stem.to_string_lossy().into_owned(),
                points: points.into_iter().map(|[x, y]| [x, *scale * y]).collect(),
            });
        }
    }
    let drawn = charts.into_iter().map(|(.., chart)| chart);
    let drawn: Vec<LineChart> = drawn.filter(|chart| !chart.lines.is_empty()).collect();
    Ok(if drawn.is_empty() {
        None
    } else {
        Some(draw::line_charts(&drawn)?)
    })
}

fn joint_errors(report: &Report) -> anyhow::Result<RgbImage> {
    let charts: Vec<BarChart> = report
        .robots
        .iter()
        .map(|robot| {
            let (separate, whole) = (&robot.figures.true_mask, &robot.figures.estimated_mask);
            let groups = separate.joints.iter().zip(&whole.joints);
            BarChart {
                title: format!(
                    "{}: joint error, cm: median and 95th percentile",
                    robot.robot
                ),
                legend: vec!["true mask".into(), "full system".into()],
                groups: groups
                    .map(|(separate, whole)| BarGroup {
                        name: separate.name.clone(),
                        bars: [separate.error_cm, whole.error_cm]
                            .into_iter()
                            .flatten()
                            .map(|summary| [summary.median, summary.p95])
                            .collect(),
                    })
                    .collect(),
            }
        })
        .collect();
    Ok(draw::bar_charts(&charts)?)
}

/// The cases of which `goodness` is least.
fn worst<'a>(cases: &[Case<'a>], goodness: impl Fn(&Score) -> f64) -> Vec<Case<'a>> {
    let mut sorted = cases.to_vec();
    sorted.sort_by(|(_, a), (_, b)| goodness(a).total_cmp(&goodness(b)));
    sorted.truncate(WORST);
    sorted
}

/// A sample as it is, and as a model sees it.
struct Look {
    image: RgbaImage,
    truth: GrayImage,
    /// Pixels.
    true_joints: Vec<[f64; 2]>,
    probability: GrayImage,
    estimate: GrayImage,
    /// Pixels; of the joints in front of the camera, whether the robot was found or not.
    joints: Vec<[f64; 2]>,
}

impl Look {
    fn new(model: &mut Judged, (recording, score): Case) -> anyhow::Result<Self> {
        let sample = recording.sample(score)?;
        let (image, truth, camera) = read(&recording.reader, sample)?;
        let (mask, joints) = search(model, &image, &camera)?;
        let description = &model.model.description;
        let threshold = description.presence.mask_threshold;
        let at = |threshold| draw::mask_image(&mask, &description.camera, &camera, threshold);
        Ok(Self {
            truth,
            true_joints: sample.joints_px.clone().unwrap_or_default(),
            probability: at(None),
            estimate: at(Some(threshold)),
            joints,
            image,
        })
    }
}

/// The mask, and the joints in front of the camera, in pixels.
fn search(
    model: &mut Judged,
    image: &RgbaImage,
    camera: &Camera,
) -> anyhow::Result<(Mask, Vec<[f64; 2]>)> {
    let all = Output {
        mask: true,
        mask_only: false,
    };
    let estimate = model.locator.locate(image, camera, all)?;
    let mask = estimate.mask.context("the mask was not read back")?;
    let joints = if estimate.status == Status::Found {
        estimate.joints.iter().map(|joint| joint.px).collect()
    } else {
        let lens = camera.lens();
        let joints = model.locator.joints_with_mask(image, camera, &mask)?;
        joints.into_iter().filter_map(|j| lens.project(j)).collect()
    };
    Ok((mask, joints))
}

fn caption((recording, score): Case) -> String {
    format!(
        "{}, sample {}: {}",
        recording.folder.display(),
        score.id,
        in_words(score)
    )
}

fn side_by_side(model: &mut Judged, cases: &[Case]) -> anyhow::Result<RgbImage> {
    let rows = cases
        .iter()
        .map(|&case| {
            let look = Look::new(model, case)?;
            let truth = draw::annotated(&look.image, &look.truth, &look.true_joints);
            let estimate = draw::annotated(&look.image, &look.estimate, &look.joints);
            Ok(SheetRow {
                caption: caption(case),
                pictures: vec![DynamicImage::from(look.image).into_rgb8(), truth, estimate],
            })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    Ok(draw::sheet(&["image", "truth", "estimate"], &rows)?)
}

/// The paper's figure of masks.
fn masks(model: &mut Judged, cases: &[Case]) -> anyhow::Result<RgbImage> {
    let grey = |mask: GrayImage| DynamicImage::from(mask).into_rgb8();
    let rows = cases
        .iter()
        .map(|&case| {
            let look = Look::new(model, case)?;
            Ok(SheetRow {
                caption: caption(case),
                pictures: vec![
                    DynamicImage::from(look.image).into_rgb8(),
                    grey(look.truth),
                    grey(look.probability),
                    grey(look.estimate),
                ],
            })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let headings = ["image", "true mask", "probability", "thresholded"];
    Ok(draw::sheet(&headings, &rows)?)
}

fn photos(models: &mut [Judged], photos: &[JudgedPhoto]) -> anyhow::Result<RgbImage> {
    let iou = |photo: &JudgedPhoto| photo.score.mask.iou().unwrap_or(0.0);
    let mut sorted: Vec<&JudgedPhoto> = photos.iter().collect();
    sorted.sort_by(|a, b| iou(a).total_cmp(&iou(b)));
    sorted.truncate(PHOTOS);
    let rows = sorted
        .into_iter()
        .map(|photo| {
            let (image, camera) = photo_camera(&photo.path)?;
            let model = &mut models[photo.by];
            let (mask, joints) = search(model, &image, &camera)?;
            let description = &model.model.description;
            let threshold = Some(description.presence.mask_threshold);
            let estimate = draw::mask_image(&mask, &description.camera, &camera, threshold);
            // Along the arm.
            let marks = description.joints.iter().filter_map(|name| {
                let mut marks = photo.annotation.joints.iter();
                Some(marks.find(|mark| mark.name == *name)?.px)
            });
            let marks: Vec<_> = marks.collect();
            Ok(SheetRow {
                caption: format!(
                    "{} ({}): IoU {:.2}, {}",
                    photo.annotation.file,
                    photo.annotation.robot,
                    iou(photo),
                    status(photo.score.status).replace('_', " ")
                ),
                pictures: vec![
                    DynamicImage::from(image.clone()).into_rgb8(),
                    draw::annotated(&image, &photo.annotation.mask(), &marks),
                    draw::annotated(&image, &estimate, &joints),
                ],
            })
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    Ok(draw::sheet(&["photo", "truth", "estimate"], &rows)?)
}
