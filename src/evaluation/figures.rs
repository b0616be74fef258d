use serde::Serialize;

use super::{JointErrors, JointScore, MaskCounts, Score, Summary};
use crate::cascade::Status;

/// What the scores of many images come to. Figures of no image are missing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// Images judged.
    pub images: usize,
    /// Those that show a robot, by a pixel at least.
    pub robots: usize,
    /// Those among them that barely do ([`BARELY_IN_VIEW`](super::BARELY_IN_VIEW)): they count in `mask`
    /// alone.
    pub barely_in_view: usize,
    /// The masks.
    pub mask: MaskFigures,
    /// Whether robots were found where there are some.
    pub presence: Presence,
    /// Joints behind the true mask (paper, section 5, "separate").
    pub true_mask: JointFigures,
    /// Joints behind the estimated mask (paper, section 5, "full system"), whether the robot was found or
    /// not.
    pub estimated_mask: JointFigures,
    /// The same where the robot was found: what a user gets to see.
    pub estimated_mask_found: JointFigures,
}

/// How good masks are. All are shares in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MaskFigures {
    /// Of all pixels, those that are right (paper, section 5).
    pub accuracy: Option<f64>,
    /// Mean over the images that show a robot.
    pub iou: Option<f64>,
    /// Of all pixels that were called robot, those that are.
    pub precision: Option<f64>,
    /// Of all robot pixels, those that were called so.
    pub recall: Option<f64>,
}

/// Whether robots were found where there are some.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Presence {
    /// Images with a robot that is more than barely in view.
    pub robot: Statuses,
    /// Images without a robot pixel.
    pub no_robot: Statuses,
}

/// How many images have which status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Statuses {
    /// A robot, with joints.
    pub found: usize,
    /// No robot.
    pub not_found: usize,
    /// A robot whose joints cannot be.
    pub invalid: usize,
}

impl Statuses {
    /// How many images there are.
    pub fn images(&self) -> usize {
        self.found + self.not_found + self.invalid
    }
}

impl FromIterator<Status> for Statuses {
    fn from_iter<I: IntoIterator<Item = Status>>(statuses: I) -> Self {
        let mut counts = Self::default();
        for status in statuses {
            *match status {
                Status::Found => &mut counts.found,
                Status::NotFound => &mut counts.not_found,
                Status::Invalid => &mut counts.invalid,
            } += 1;
        }
        counts
    }
}

/// How far joints are off. An image's error is the mean over its joints (paper, section 5).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JointFigures {
    /// In space, over images, centimetres.
    pub error_cm: Option<Summary>,
    /// In the image as given, over images, pixels.
    pub reprojection_px: Option<Summary>,
    /// Images that `reprojection_px` leaves out: a joint was put behind the camera.
    pub behind_camera: usize,
    /// Each joint's own errors.
    pub joints: Vec<NamedJoint>,
}

/// How far a joint is off, over images.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NamedJoint {
    /// Its name.
    pub name: String,
    /// In space, centimetres.
    pub error_cm: Option<Summary>,
    /// In the image as given, pixels.
    pub reprojection_px: Option<Summary>,
}

impl Figures {
    /// Of `scores` of one model or of several that have the joints `names`.
    pub fn new<'a>(names: &[String], scores: impl IntoIterator<Item = &'a Score>) -> Self {
        let scores: Vec<&Score> = scores.into_iter().collect();
        let shows_robot = |score: &&&Score| score.mask.hits + score.mask.misses > 0;
        let robots: Vec<&Score> = scores.iter().filter(shows_robot).copied().collect();
        let joints = |judged: &dyn Fn(&Score) -> bool, errors: fn(&JointScore) -> &JointErrors| {
            let judged = scores.iter().filter(|score| judged(score));
            let errors = judged.filter_map(|score| score.joints.as_ref().map(errors));
            JointFigures::new(names, &errors.collect::<Vec<_>>())
        };
        let with_joints = |score: &&&Score| score.joints.is_some();
        Self {
            images: scores.len(),
            robots: robots.len(),
            barely_in_view: robots.iter().filter(|s| s.joints.is_none()).count(),
            mask: MaskFigures::new(&scores, &robots),
            presence: Presence {
                robot: scores
                    .iter()
                    .filter(with_joints)
                    .map(|s| s.status)
                    .collect(),
                no_robot: scores
                    .iter()
                    .filter(|s| !shows_robot(s))
                    .map(|s| s.status)
                    .collect(),
            },
            true_mask: joints(&|_| true, |score| &score.true_mask),
            estimated_mask: joints(&|_| true, |score| &score.estimated_mask),
            estimated_mask_found: joints(&|score| score.status == Status::Found, |score| {
                &score.estimated_mask
            }),
        }
    }
}

impl MaskFigures {
    fn new(scores: &[&Score], robots: &[&Score]) -> Self {
        let mut total = MaskCounts::default();
        scores.iter().for_each(|score| total += score.mask);
        let ious = robots.iter().filter_map(|score| score.mask.iou());
        Self {
            accuracy: total.accuracy(),
            iou: Summary::of(ious).map(|summary| summary.mean),
            precision: total.precision(),
            recall: total.recall(),
        }
    }
}

impl JointFigures {
    fn new(names: &[String], errors: &[&JointErrors]) -> Self {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let seen = || errors.iter().filter(|e| !e.px.is_empty());
        let joints = names.iter().enumerate().map(|(index, name)| NamedJoint {
            name: name.clone(),
            error_cm: Summary::of(errors.iter().filter_map(|e| e.cm.get(index).copied())),
            reprojection_px: Summary::of(seen().filter_map(|e| e.px.get(index).copied())),
        });
        Self {
            error_cm: Summary::of(errors.iter().map(|e| e.mean_cm())),
            reprojection_px: Summary::of(seen().map(|e| mean(&e.px))),
            behind_camera: errors.len() - seen().count(),
            joints: joints.collect(),
        }
    }
}
