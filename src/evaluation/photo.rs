//! Photos of which nothing is known but what a person has drawn on them.

use std::collections::BTreeMap;
use std::path::Path;

use image::{GrayImage, Luma, RgbaImage};
use serde::{Deserialize, Serialize};
use tiny_skia::{FillRule, PathBuilder, Transform};

use super::score::check_finite;
use super::{EvaluationError, MaskCounts, Summary, distances_px};
use crate::camera::Camera;
use crate::cascade::{Locator, Output, Status};
use crate::draw;

/// A photo with a hand-made mask and joints, in pixels of the upright photo; (0, 0) is the centre of the
/// top-left pixel.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(try_from = "Entry")]
pub struct Annotation {
    /// The photo's file, relative to the folder of photos.
    pub file: String,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The robot that it shows: whose weights to use.
    pub robot: String,
    /// What was photographed: photos of one scene are not independent.
    pub scene: String,
    /// The main arm's joints, as far as they are known.
    pub joints: Vec<JointMark>,
    polygons: Vec<Polygon>,
    holes: Vec<Polygon>,
    ignored: Vec<Polygon>,
}

/// Where a person says that a joint is.
#[derive(Debug, Clone, PartialEq)]
pub struct JointMark {
    /// The joint's name.
    pub name: String,
    /// In pixels.
    pub px: [f64; 2],
    /// Whether it is seen; else it is guessed at behind something.
    pub seen: bool,
}

type Polygon = Vec<[f64; 2]>;

/// An annotation as it is written.
#[derive(Deserialize)]
struct Entry {
    file: String,
    width: u32,
    height: u32,
    robot: String,
    scene: String,
    polygons: Vec<Polygon>,
    #[serde(default)]
    holes: Vec<Polygon>,
    #[serde(default)]
    ignore_polygons: Vec<Polygon>,
    #[serde(default)]
    joints2d: BTreeMap<String, [f64; 3]>,
}

impl TryFrom<Entry> for Annotation {
    type Error = String;

    fn try_from(entry: Entry) -> Result<Self, String> {
        let file = &entry.file;
        // tiny-skia's canvas has no more, and photos have less.
        let size = 1..=32_768;
        if !size.contains(&entry.width) || !size.contains(&entry.height) {
            return Err(format!(
                "{file}: expected sides of 1 to 32768 pixels, found {} x {}",
                entry.width, entry.height
            ));
        }
        if entry.polygons.is_empty() {
            return Err(format!(
                "{file}: polygons: expected at least one, found none"
            ));
        }
        for (key, polygons) in [
            ("polygons", &entry.polygons),
            ("holes", &entry.holes),
            ("ignore_polygons", &entry.ignore_polygons),
        ] {
            if let Some(short) = polygons.iter().find(|polygon| polygon.len() < 3) {
                let found = short.len();
                return Err(format!(
                    "{file}: {key}: expected at least three points, found {found}"
                ));
            }
        }
        let mut joints = Vec::new();
        for (name, [x, y, v]) in entry.joints2d {
            match v {
                0.0 => {}
                1.0 | 2.0 => joints.push(JointMark {
                    name,
                    px: [x, y],
                    seen: v == 2.0,
                }),
                _ => {
                    return Err(format!(
                        "{file}: joints2d: {name}: expected v = 0, 1 or 2, found {v}"
                    ));
                }
            }
        }
        Ok(Self {
            joints,
            file: entry.file,
            width: entry.width,
            height: entry.height,
            robot: entry.robot,
            scene: entry.scene,
            polygons: entry.polygons,
            holes: entry.holes,
            ignored: entry.ignore_polygons,
        })
    }
}

/// Reads a file of annotations: a JSON list.
///
/// # Errors
/// A file that cannot be read, or holds something else; the error names file and line.
pub fn read_annotations(path: &Path) -> Result<Vec<Annotation>, EvaluationError> {
    let text = std::fs::read(path).map_err(|cause| EvaluationError::Io {
        path: path.to_owned(),
        cause,
    })?;
    let fault = |line: usize, message: String| EvaluationError::Annotation {
        path: path.to_owned(),
        line,
        message,
    };
    let annotations: Vec<Annotation> = serde_json::from_slice(&text).map_err(|e| {
        let message = e.to_string();
        let what = message.split(" at line ").next().unwrap_or_default();
        fault(e.line(), what.to_owned())
    })?;
    if annotations.is_empty() {
        return Err(fault(1, "expected at least one photo, found none".into()));
    }
    Ok(annotations)
}

impl Annotation {
    /// The mask, of the photo's size: 255 where the robot is, else 0.
    pub fn mask(&self) -> GrayImage {
        let robot = self.filled(&self.polygons);
        let holes = self.filled(&self.holes);
        GrayImage::from_fn(self.width, self.height, |x, y| {
            let index = y as usize * self.width as usize + x as usize;
            let at = |filled: &[bool]| filled.get(index).copied().unwrap_or(false);
            Luma([if at(&robot) && !at(&holes) { 255 } else { 0 }])
        })
    }

    /// Which pixels lie within one of `polygons`, row by row.
    fn filled(&self, polygons: &[Polygon]) -> Vec<bool> {
        let Some(mut canvas) = tiny_skia::Mask::new(self.width, self.height) else {
            return Vec::new();
        };
        for polygon in polygons {
            let mut path = PathBuilder::new();
            for (index, point) in polygon.iter().enumerate() {
                // tiny-skia's (0, 0) is the corner of the top-left pixel.
                let [x, y] = point.map(|v| (v + 0.5) as f32);
                if index == 0 {
                    path.move_to(x, y);
                } else {
                    path.line_to(x, y);
                }
            }
            path.close();
            if let Some(path) = path.finish() {
                canvas.fill_path(&path, FillRule::Winding, false, Transform::identity());
            }
        }
        canvas.data().iter().map(|&value| value > 0).collect()
    }
}

/// What a model made of one annotated photo.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotoScore {
    /// The photo's file.
    pub file: String,
    /// Its scene.
    pub scene: String,
    /// The mask at the photo's size, without what the annotation ignores. What the networks do not see of
    /// the photo counts as background.
    pub mask: MaskCounts,
    /// Whether a robot was found.
    pub status: Status,
    /// Share of the photo that the networks saw.
    pub field: f64,
    /// The photo's diagonal, pixels.
    pub diagonal: f64,
    /// How far joints that are seen are off, in pixels, where the robot was found.
    pub seen_px: Vec<f64>,
    /// The same for joints that are hidden.
    pub hidden_px: Vec<f64>,
}

impl PhotoScore {
    /// Judges what `locator` makes of `photo`, which has the annotation's size, if `camera` took it.
    ///
    /// # Errors
    /// As [`Locator::locate`]; answers that are not finite; a joint that the model does not have.
    pub fn new(
        locator: &mut Locator,
        camera: &Camera,
        photo: &RgbaImage,
        annotation: &Annotation,
    ) -> Result<Self, EvaluationError> {
        let all = Output {
            mask: true,
            mask_only: false,
        };
        let estimate = locator.locate(photo, camera, all)?;
        let description = locator.description();
        let mut counts = MaskCounts::default();
        if let Some(mask) = &estimate.mask {
            check_finite(mask)?;
            let threshold = description.presence.mask_threshold;
            let found = draw::mask_image(mask, &description.camera, camera, Some(threshold));
            let truth = annotation.mask();
            let ignored = annotation.filled(&annotation.ignored);
            let pairs = truth.iter().zip(found.iter()).zip(&ignored);
            counts = pairs
                .filter(|(_, ignored)| !**ignored)
                .map(|((&truth, &found), _)| (truth > 0, found > 0))
                .collect();
        }
        let mut marks = annotation.joints.iter();
        if let Some(unknown) = marks.find(|mark| !description.joints.contains(&mark.name)) {
            return Err(EvaluationError::Joints {
                expected: description.joints.clone(),
                found: vec![unknown.name.clone()],
            });
        }
        let errors = |seen: bool| {
            let marks = annotation.joints.iter().filter(|mark| mark.seen == seen);
            let pairs = marks.filter_map(|mark| {
                let joint = estimate.joints.iter().find(|j| j.name == mark.name)?;
                Some((mark.px, joint.px))
            });
            let (truth, found): (Vec<_>, Vec<_>) = pairs.unzip();
            distances_px(&truth, &found)
        };
        Ok(Self {
            file: annotation.file.clone(),
            scene: annotation.scene.clone(),
            mask: counts,
            status: estimate.status,
            field: estimate.field,
            diagonal: f64::from(photo.width()).hypot(f64::from(photo.height())),
            seen_px: errors(true)?,
            hidden_px: errors(false)?,
        })
    }
}

/// What the scores of many photos come to. Figures of no photo are missing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotoFigures {
    /// How many there are, each showing a robot.
    pub photos: usize,
    /// In how many it was found.
    pub found: usize,
    /// The mask's IoU over all photos.
    pub iou: Option<Summary>,
    /// The mask's IoU over those in which the robot was found.
    pub iou_found: Option<Summary>,
    /// The scenes' median IoU over the scenes.
    pub iou_scenes: Option<Summary>,
    /// Each scene.
    pub scenes: Vec<Scene>,
    /// Joints that are seen, where the robot was found: pixels of the photo.
    pub seen_px: Option<Summary>,
    /// The same as shares of the photo's diagonal.
    pub seen_share: Option<Summary>,
    /// Joints that are hidden, where the robot was found: pixels of the photo.
    pub hidden_px: Option<Summary>,
    /// The same as shares of the photo's diagonal.
    pub hidden_share: Option<Summary>,
}

/// The photos of one scene, which are not independent.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scene {
    /// Its name.
    pub name: String,
    /// How many there are.
    pub photos: usize,
    /// In how many the robot was found.
    pub found: usize,
    /// The mask's IoU.
    pub iou: Option<Summary>,
}

impl PhotoFigures {
    /// Of `scores` of one model or several.
    pub fn new<'a>(scores: impl IntoIterator<Item = &'a PhotoScore>) -> Self {
        let scores: Vec<&PhotoScore> = scores.into_iter().collect();
        let found = |score: &&&PhotoScore| score.status == Status::Found;
        let iou = |score: &&PhotoScore| score.mask.iou();
        let mut by_scene: BTreeMap<&str, Vec<&PhotoScore>> = BTreeMap::new();
        for &score in &scores {
            by_scene.entry(&score.scene).or_default().push(score);
        }
        let scenes: Vec<Scene> = by_scene
            .into_iter()
            .map(|(name, scores)| Scene {
                name: name.to_owned(),
                photos: scores.len(),
                found: scores.iter().filter(found).count(),
                iou: Summary::of(scores.iter().filter_map(iou)),
            })
            .collect();
        let joints = |errors: fn(&PhotoScore) -> &Vec<f64>, share: bool| {
            Summary::of(scores.iter().flat_map(|score| {
                let scale = if share { 1.0 / score.diagonal } else { 1.0 };
                errors(score).iter().map(move |error| scale * error)
            }))
        };
        Self {
            photos: scores.len(),
            found: scores.iter().filter(found).count(),
            iou: Summary::of(scores.iter().filter_map(iou)),
            iou_found: Summary::of(scores.iter().filter(found).filter_map(iou)),
            iou_scenes: Summary::of(scenes.iter().filter_map(|s| Some(s.iou?.median))),
            scenes,
            seen_px: joints(|score| &score.seen_px, false),
            seen_share: joints(|score| &score.seen_px, true),
            hidden_px: joints(|score| &score.hidden_px, false),
            hidden_share: joints(|score| &score.hidden_px, true),
        }
    }
}
