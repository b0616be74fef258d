//! What was measured, as JSON and as tables.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::{JudgedPhoto, RecordingScores, Results, RigScores, Split};
use crate::cascade::Status;
use crate::evaluation::{
    BARELY_IN_VIEW, Figures, JointFigures, PhotoFigures, RigFigures, Score, Summary,
};
use crate::recording::{Protocol, SourceKind};

/// The version of the JSON.
const SCHEMA: u32 = 1;

/// Everything that is said. Shares are in [0, 1]; joints are judged in the camera optical frame.
#[derive(Serialize)]
pub struct Report {
    schema: u32,
    adapter: String,
    /// Robots that fill less of the networks' image are left out of joint and presence figures.
    barely_in_view_below: f64,
    models: Vec<ModelLine>,
    recordings: Vec<RecordingLine>,
    /// All recordings of a robot together.
    pub robots: Vec<RobotLine>,
    #[serde(skip_serializing_if = "Option::is_none")]
    photos: Option<PhotosLine>,
    without: Vec<WithoutLine>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    rigs: Vec<RigLine>,
}

#[derive(Serialize)]
struct RigLine {
    rig: String,
    robot: String,
    weights: String,
    #[serde(flatten)]
    figures: RigFigures,
}

#[derive(Serialize)]
struct ModelLine {
    robot: String,
    weights: String,
    family: String,
    /// Whether the joints are moved to where an arm can have them.
    kinematic_fit: bool,
}

#[derive(Serialize)]
struct RecordingLine {
    recording: String,
    robot: String,
    weights: String,
    source: SourceKind,
    #[serde(skip_serializing_if = "Option::is_none")]
    protocol: Option<Protocol>,
    split: Split,
    /// In the recording, whatever the split.
    samples: usize,
    #[serde(flatten)]
    figures: Figures,
}

/// All recordings of a robot together.
#[derive(Serialize)]
pub struct RobotLine {
    /// The robot.
    pub robot: String,
    weights: String,
    recordings: usize,
    /// What its scores come to.
    #[serde(flatten)]
    pub figures: Figures,
}

#[derive(Serialize)]
struct PhotosLine {
    #[serde(flatten)]
    figures: PhotoFigures,
    each: Vec<PhotoLine>,
}

#[derive(Serialize)]
struct PhotoLine {
    file: String,
    robot: String,
    /// The robot that the weights were made for.
    weights_of: String,
    scene: String,
    status: &'static str,
    iou: Option<f64>,
    /// Share of the photo that the networks saw.
    field: f64,
    /// Mean over the joints that are seen; only where the robot was found.
    seen_px: Option<f64>,
    /// Mean over the joints that are hidden; only where the robot was found.
    hidden_px: Option<f64>,
}

#[derive(Serialize)]
struct WithoutLine {
    folder: String,
    robot: String,
    weights: String,
    images: usize,
    /// Those in which the robot was found, though it is not there.
    found: Vec<String>,
    found_share: f64,
}

fn named(path: &Path) -> String {
    path.display().to_string()
}

impl Report {
    /// What `results` come to.
    pub fn new(results: &Results) -> Self {
        let Results {
            split,
            models,
            recordings,
            photos,
            without,
            rigs,
        } = results;
        let adapter = models.first().map(|m| m.locator.adapter_name().to_owned());
        let figures = |by: usize, of: &[&RecordingScores]| -> Figures {
            let scores = of.iter().flat_map(|r| &r.scores);
            Figures::new(&models[by].model.description.joints, scores)
        };
        let recording_line = |r: &RecordingScores| {
            let header = r.reader.header();
            RecordingLine {
                recording: named(&r.folder),
                robot: header.robot.clone(),
                weights: named(&models[r.by].file),
                source: header.source.kind,
                protocol: header.source.protocol,
                split: *split,
                samples: r.reader.samples().len(),
                figures: figures(r.by, &[r]),
            }
        };
        let robot_line = |(by, model): (usize, &super::Judged)| {
            let of: Vec<_> = recordings.iter().filter(|r| r.by == by).collect();
            (!of.is_empty()).then(|| RobotLine {
                robot: model.robot().to_owned(),
                weights: named(&model.file),
                recordings: of.len(),
                figures: figures(by, &of),
            })
        };
        let photo_line = |photo: &JudgedPhoto| {
            let score = &photo.score;
            let mean = |values: &[f64]| Summary::of(values.iter().copied()).map(|s| s.mean);
            PhotoLine {
                file: score.file.clone(),
                robot: photo.annotation.robot.clone(),
                weights_of: models[photo.by].robot().to_owned(),
                scene: score.scene.clone(),
                status: status(score.status),
                iou: score.mask.iou(),
                field: score.field,
                seen_px: mean(&score.seen_px),
                hidden_px: mean(&score.hidden_px),
            }
        };
        Self {
            schema: SCHEMA,
            adapter: adapter.unwrap_or_default(),
            barely_in_view_below: BARELY_IN_VIEW,
            models: models
                .iter()
                .map(|m| ModelLine {
                    robot: m.robot().to_owned(),
                    weights: named(&m.file),
                    family: m.model.description.family.clone(),
                    kinematic_fit: m.model.description.arm.is_some(),
                })
                .collect(),
            recordings: recordings.iter().map(recording_line).collect(),
            robots: models.iter().enumerate().filter_map(robot_line).collect(),
            photos: (!photos.is_empty()).then(|| PhotosLine {
                figures: PhotoFigures::new(photos.iter().map(|photo| &photo.score)),
                each: photos.iter().map(photo_line).collect(),
            }),
            without: without
                .iter()
                .map(|w| WithoutLine {
                    folder: named(&w.folder),
                    robot: models[w.by].robot().to_owned(),
                    weights: named(&models[w.by].file),
                    images: w.images,
                    found: w.found.iter().map(|path| named(path)).collect(),
                    found_share: w.found.len() as f64 / w.images as f64,
                })
                .collect(),
            rigs: rigs
                .iter()
                .map(|r: &RigScores| RigLine {
                    rig: named(&r.folder),
                    robot: models[r.by].robot().to_owned(),
                    weights: named(&models[r.by].file),
                    figures: r.figures.clone(),
                })
                .collect(),
        }
    }
}

/// What a status is called.
pub fn status(status: Status) -> &'static str {
    match status {
        Status::Found => "found",
        Status::NotFound => "not_found",
        Status::Invalid => "invalid",
    }
}

/// `IoU 0.53, joints off by 23.1 cm, found`.
pub fn in_words(score: &Score) -> String {
    let mut words = Vec::new();
    words.extend(score.mask.iou().map(|iou| format!("IoU {iou:.2}")));
    words.extend(score.joints.as_ref().map(|joints| {
        let (whole, separate) = (&joints.estimated_mask, &joints.true_mask);
        format!(
            "joints off by {:.1} cm (behind the true mask {:.1} cm)",
            whole.mean_cm(),
            separate.mean_cm()
        )
    }));
    words.push(status(score.status).replace('_', " "));
    words.join(", ")
}

// --- tables ----------------------------------------------------------------------------------------

/// What the paper's table of results says of its own recordings (section 5): robot, mask accuracy in
/// percent, joint error in centimetres with the true mask and of the full system.
const PAPER: [(&str, f64, f64, f64); 3] = [
    ("ur3", 93.1, 2.5, 2.57),
    ("ur5", 98.1, 2.02, 2.42),
    ("ur10", 92.8, 3.21, 3.89),
];

type Row = Vec<String>;

/// The first column to the left, the others to the right.
fn write_table(f: &mut fmt::Formatter<'_>, rows: &[Row]) -> fmt::Result {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    for row in rows {
        let cells = row
            .iter()
            .zip(&widths)
            .enumerate()
            .map(|(index, (cell, &width))| {
                if index == 0 {
                    format!("{cell:width$}")
                } else {
                    format!("{cell:>width$}")
                }
            });
        writeln!(f, "{}", cells.collect::<Vec<_>>().join("  ").trim_end())?;
    }
    Ok(())
}

fn row<const N: usize>(cells: [&str; N]) -> Row {
    cells.map(str::to_owned).to_vec()
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
}

fn percent(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |share| format!("{:.1} %", 100.0 * share))
}

fn of(part: usize, whole: usize) -> String {
    if whole == 0 {
        "-".to_owned()
    } else {
        format!("{part} of {whole}")
    }
}

/// Mean, median and 95th percentile.
fn three(summary: Option<Summary>) -> [String; 3] {
    let cell = |value: fn(Summary) -> f64| number(summary.map(value), 1);
    [cell(|s| s.mean), cell(|s| s.median), cell(|s| s.p95)]
}

impl Report {
    /// The rows of tables about recordings: what they are, and their figures.
    fn subjects(&self) -> Vec<(String, &Figures)> {
        let mut subjects = Vec::new();
        for robot in &self.robots {
            let own = |line: &&RecordingLine| line.weights == robot.weights;
            for line in self.recordings.iter().filter(own) {
                let name = format!("{} {}", line.robot, line.recording);
                subjects.push((name, &line.figures));
            }
            if robot.recordings > 1 {
                let name = format!("{} all {} recordings", robot.robot, robot.recordings);
                subjects.push((name, &robot.figures));
            }
        }
        subjects
    }

    fn write_recordings(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for line in &self.recordings {
            let source = match (line.source, line.protocol) {
                (SourceKind::Real, _) => "real",
                (SourceKind::Synthetic, Some(Protocol::FixedCamera)) => "synthetic, fixed camera",
                (SourceKind::Synthetic, Some(Protocol::FreeCamera)) => "synthetic, free camera",
                (SourceKind::Synthetic, None) => "synthetic",
            };
            let split = match line.split {
                Split::Test => "those to test with",
                Split::Train => "those to train with",
                Split::All => "all",
            };
            writeln!(
                f,
                "{}: {}, {source}; {} of {} samples ({split}), by {}",
                line.recording, line.robot, line.figures.images, line.samples, line.weights
            )?;
        }
        let subjects = self.subjects();
        let paper = || {
            let known = |robot: &RobotLine| PAPER.iter().find(|(name, ..)| *name == robot.robot);
            self.robots.iter().filter_map(known)
        };

        writeln!(f, "\nMasks (IoU: mean over the images that show a robot)")?;
        let mut rows = vec![row([
            "",
            "images",
            "with robot",
            "accuracy",
            "IoU",
            "precision",
            "recall",
        ])];
        rows.extend(subjects.iter().map(|(name, figures)| {
            let mask = figures.mask;
            vec![
                name.clone(),
                figures.images.to_string(),
                figures.robots.to_string(),
                percent(mask.accuracy),
                number(mask.iou, 3),
                number(mask.precision, 3),
                number(mask.recall, 3),
            ]
        }));
        rows.extend(paper().map(|(robot, accuracy, ..)| {
            let name = format!("{robot} the paper, on its own recordings");
            vec![name, "".into(), "".into(), format!("{accuracy:.1} %")]
        }));
        write_table(f, &rows)?;

        writeln!(
            f,
            "\nPresence (robots that fill less than {} % of the image are left out, as below)",
            100.0 * self.barely_in_view_below
        )?;
        let mut rows = vec![row([
            "",
            "left out",
            "robots found",
            "invalid",
            "no robot: not found",
            "found",
            "invalid",
        ])];
        rows.extend(subjects.iter().map(|(name, figures)| {
            let (with, without) = (figures.presence.robot, figures.presence.no_robot);
            vec![
                name.clone(),
                figures.barely_in_view.to_string(),
                of(with.found, with.images()),
                with.invalid.to_string(),
                of(without.not_found, without.images()),
                without.found.to_string(),
                without.invalid.to_string(),
            ]
        }));
        write_table(f, &rows)?;

        writeln!(
            f,
            "\nJoint error in space, cm: mean, median, 95th percentile over images (all: of the mean over \
             an image's joints)"
        )?;
        for model in self.models.iter().filter(|model| model.kinematic_fit) {
            writeln!(
                f,
                "{}: moved to where an arm can have them, as the paper's are not (--no-fit leaves it out)",
                model.robot
            )?;
        }
        let mut rows = joint_rows(
            &subjects,
            |j| j.error_cm,
            |j| j.joints.iter().map(|joint| joint.error_cm).collect(),
        );
        rows.extend(paper().map(|(robot, _, separate, whole)| {
            let mut cells = vec![
                format!("{robot} the paper, on its own recordings"),
                "".into(),
            ];
            cells.extend([separate.to_string(), "".into(), "".into(), "".into()]);
            cells.extend(["".into(), whole.to_string()]);
            cells
        }));
        write_table(f, &rows)?;

        writeln!(
            f,
            "\nJoint error in the image, px: mean, median, 95th percentile over images"
        )?;
        let rows = joint_rows(
            &subjects,
            |j| j.reprojection_px,
            |j| j.joints.iter().map(|joint| joint.reprojection_px).collect(),
        );
        write_table(f, &rows)?;
        let behind = |figures: &Figures| {
            figures.true_mask.behind_camera + figures.estimated_mask.behind_camera
        };
        for (name, figures) in subjects.iter().filter(|(_, figures)| behind(figures) > 0) {
            writeln!(
                f,
                "{name}: left out of it for a joint behind the camera: {} images (true mask), {} (estimated)",
                figures.true_mask.behind_camera, figures.estimated_mask.behind_camera
            )?;
        }
        Ok(())
    }

    fn write_photos(&self, f: &mut fmt::Formatter<'_>, photos: &PhotosLine) -> fmt::Result {
        let figures = &photos.figures;
        writeln!(
            f,
            "\nPhotos (the mask's median IoU at the photo's size; joints: median distance where the robot was \
             found)"
        )?;
        let mut rows = vec![row(["", "photos", "found", "IoU", "IoU where found"])];
        rows.extend(figures.scenes.iter().map(|scene| {
            vec![
                format!("scene {}", scene.name),
                scene.photos.to_string(),
                scene.found.to_string(),
                number(scene.iou.map(|s| s.median), 3),
            ]
        }));
        rows.push(vec![
            "all scenes, each once".into(),
            figures.scenes.len().to_string(),
            "".into(),
            number(figures.iou_scenes.map(|s| s.median), 3),
        ]);
        rows.push(vec![
            "all photos".into(),
            figures.photos.to_string(),
            figures.found.to_string(),
            number(figures.iou.map(|s| s.median), 3),
            number(figures.iou_found.map(|s| s.median), 3),
        ]);
        write_table(f, &rows)?;
        writeln!(f)?;
        let mut rows = vec![row([
            "",
            "joints",
            "px",
            "mean px",
            "95 % px",
            "% of diagonal",
            "mean",
            "95 %",
        ])];
        for (name, px, share) in [
            ("joints that are seen", figures.seen_px, figures.seen_share),
            (
                "joints that are hidden",
                figures.hidden_px,
                figures.hidden_share,
            ),
        ] {
            let px_cells = [
                number(px.map(|s| s.median), 0),
                number(px.map(|s| s.mean), 0),
                number(px.map(|s| s.p95), 0),
            ];
            let mut cells = vec![name.to_owned(), px.map_or(0, |s| s.count).to_string()];
            cells.extend(px_cells);
            cells.extend([
                percent(share.map(|s| s.median)),
                percent(share.map(|s| s.mean)),
                percent(share.map(|s| s.p95)),
            ]);
            rows.push(cells);
        }
        write_table(f, &rows)?;
        let strange = photos.each.iter().filter(|p| p.robot != p.weights_of);
        let strange: Vec<&PhotoLine> = strange.collect();
        if let Some(first) = strange.first() {
            let files: Vec<String> = strange
                .iter()
                .map(|photo| format!("{} ({})", photo.file, photo.robot))
                .collect();
            writeln!(
                f,
                "judged with the weights of {}, the only ones given: {}",
                first.weights_of,
                files.join(", ")
            )?;
        }
        Ok(())
    }
}

impl RigLine {
    fn write(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let figures = &self.figures;
        let found: Vec<String> = figures.found.iter().map(usize::to_string).collect();
        writeln!(
            f,
            "\n{}: {}, {} cameras, {} instants, found in {}, by {}",
            self.rig,
            self.robot,
            figures.found.len(),
            figures.instants,
            found.join(", "),
            self.weights
        )?;
        writeln!(
            f,
            "\nA camera's pose in the base frame, by the joints of so many frames: how far it is off (median, 95th \
             percentile), and the standard deviation that was stated (median)"
        )?;
        let mut rows = vec![row([
            "frames",
            "tries",
            "not told",
            "place, cm",
            "95 %",
            "stated",
            "turn, degrees",
            "95 %",
            "stated",
        ])];
        rows.extend(figures.poses.iter().map(|line| {
            let median = |summary: Option<Summary>| number(summary.map(|s| s.median), 1);
            let p95 = |summary: Option<Summary>| number(summary.map(|s| s.p95), 1);
            vec![
                line.frames.map_or("all".into(), |n| n.to_string()),
                line.tries.to_string(),
                line.undetermined.to_string(),
                median(line.place_cm),
                p95(line.place_cm),
                median(line.place_sigma_cm),
                median(line.turn_deg),
                p95(line.turn_deg),
                median(line.turn_sigma_deg),
            ]
        }));
        write_table(f, &rows)?;
        writeln!(
            f,
            "\nJoint error by so many cameras together, cm: mean, median, 95th percentile over instants, in the first \
             camera's frame (nothing known of the cameras before), and in the base frame (cameras calibrated by the \
             joint angles of the first half; judged on the second)"
        )?;
        let mut rows = vec![row([
            "cameras",
            "first camera's: mean",
            "median",
            "95 %",
            "base: mean",
            "median",
            "95 %",
        ])];
        rows.extend(figures.together.iter().map(|line| {
            let mut cells = vec![line.cameras.to_string()];
            cells.extend(three(line.first_camera_cm));
            cells.extend(three(line.base_cm));
            cells
        }));
        write_table(f, &rows)
    }
}

/// A block of rows a subject: all joints, then each.
fn joint_rows(
    subjects: &[(String, &Figures)],
    all: fn(&JointFigures) -> Option<Summary>,
    each: fn(&JointFigures) -> Vec<Option<Summary>>,
) -> Vec<Row> {
    let mut rows = vec![row([
        "",
        "images",
        "true mask: mean",
        "median",
        "95 %",
        "full system: mean",
        "median",
        "95 %",
        "where found: images",
        "mean",
        "median",
        "95 %",
    ])];
    for (name, figures) in subjects {
        let three_ways = [
            &figures.true_mask,
            &figures.estimated_mask,
            &figures.estimated_mask_found,
        ];
        let mut push = |name: String, [separate, whole, found]: [Option<Summary>; 3]| {
            let count = |summary: Option<Summary>| summary.map_or(0, |s| s.count).to_string();
            let mut cells = vec![name, count(separate)];
            cells.extend(three(separate));
            cells.extend(three(whole));
            cells.push(count(found));
            cells.extend(three(found));
            rows.push(cells);
        };
        push(name.clone(), three_ways.map(all));
        let joints = three_ways.map(each);
        for (index, joint) in figures.true_mask.joints.iter().enumerate() {
            let own = |joints: &Vec<Option<Summary>>| joints.get(index).copied().flatten();
            push(format!("  {}", joint.name), joints.each_ref().map(own));
        }
    }
    rows
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.recordings.is_empty() {
            self.write_recordings(f)?;
        }
        if let Some(photos) = &self.photos {
            self.write_photos(f, photos)?;
        }
        if !self.without.is_empty() {
            writeln!(f, "\nPhotos without the robot")?;
            let mut rows = vec![row(["", "wrongly found", ""])];
            rows.extend(self.without.iter().map(|line| {
                vec![
                    format!("{} in {}", line.robot, line.folder),
                    of(line.found.len(), line.images),
                    percent(Some(line.found_share)),
                ]
            }));
            write_table(f, &rows)?;
            for file in self.without.iter().flat_map(|line| &line.found) {
                writeln!(f, "  {file}")?;
            }
        }
        for rig in &self.rigs {
            rig.write(f)?;
        }
        writeln!(f, "\nrun on {}", self.adapter)
    }
}
