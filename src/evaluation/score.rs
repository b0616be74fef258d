use image::{GrayImage, Rgba, RgbaImage};

use super::{EvaluationError, MaskCounts, NotFinite, distances_cm, distances_px};
use crate::camera::{Camera, Gaze, Rectification};
use crate::cascade::{Locator, Mask, Output, Status};
use crate::network::Description;
use crate::reference;

/// A robot that fills less of the networks' image than this is barely in view: nothing can be said of
/// its joints, and they are not judged.
pub const BARELY_IN_VIEW: f64 = 0.005;

/// What a model made of one image of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// The sample's number.
    pub id: u64,
    /// Its mask, at the networks' size.
    pub mask: MaskCounts,
    /// Whether it found a robot.
    pub status: Status,
    /// The joints; `None` without a robot, or with one that is barely in view.
    pub joints: Option<JointScore>,
}

/// How far a model's joints are off in one image.
#[derive(Debug, Clone, PartialEq)]
pub struct JointScore {
    /// Behind the true mask (paper, section 5, "separate"; there without a kinematic fit).
    pub true_mask: JointErrors,
    /// Behind the model's own mask (paper, section 5, "full system"), whether it found a robot or not.
    pub estimated_mask: JointErrors,
}

/// How far joints are off, in the model's order.
#[derive(Debug, Clone, PartialEq)]
pub struct JointErrors {
    /// In space, centimetres.
    pub cm: Vec<f64>,
    /// In the image as given, pixels. Empty where an estimate cannot be seen, which is behind the camera.
    pub px: Vec<f64>,
}

impl JointErrors {
    /// The error in space, averaged over the joints (paper, section 5), in centimetres.
    pub fn mean_cm(&self) -> f64 {
        self.cm.iter().sum::<f64>() / self.cm.len() as f64
    }

    fn of(
        truth: &[[f64; 3]],
        estimate: &[[f64; 3]],
        camera: &Camera,
    ) -> Result<Self, EvaluationError> {
        let lens = camera.lens();
        let seen = |joints: &[[f64; 3]]| -> Option<Vec<[f64; 2]>> {
            joints.iter().map(|&joint| lens.project(joint)).collect()
        };
        let px = match (seen(truth), seen(estimate)) {
            (Some(truth), Some(estimate)) => distances_px(&truth, &estimate)?,
            _ => Vec::new(),
        };
        let cm = distances_cm(truth, estimate)?;
        Ok(Self { cm, px })
    }
}

impl Score {
    /// Judges what `locator` makes of `image`, taken by `camera`.
    ///
    /// `mask` has the image's size and is 255 where the robot is seen; `joints` are in the model's
    /// order, in metres, in the camera optical frame, and `None` without a robot.
    ///
    /// # Errors
    /// As [`Locator::locate`], and answers that are not finite.
    pub fn new(
        id: u64,
        locator: &mut Locator,
        camera: &Camera,
        image: &RgbaImage,
        mask: &GrayImage,
        joints: Option<&[[f64; 3]]>,
    ) -> Result<Self, EvaluationError> {
        let all = Output {
            mask: true,
            mask_only: false,
        };
        let estimate = locator.locate(image, camera, all)?;
        let found = estimate.mask.unwrap_or_else(|| Mask {
            width: 0,
            height: 0,
            probability: Vec::new(),
        });
        check_finite(&found)?;
        let truth = network_mask(mask, camera, locator.description());
        let threshold = locator.description().presence.mask_threshold;
        let pairs = truth.probability.iter().zip(&found.probability);
        let counts: MaskCounts = pairs.map(|(&t, &p)| (t > 0.0, p >= threshold)).collect();

        let judged = counts.coverage().is_some_and(|c| c >= BARELY_IN_VIEW);
        let joints = match joints.filter(|_| judged) {
            Some(joints) => {
                let separate = locator.joints_with_mask(image, camera, &truth)?;
                // Where a robot was found its joints are already there, all of them.
                let whole = if estimate.status == Status::Found {
                    estimate.joints.iter().map(|joint| joint.xyz_m).collect()
                } else {
                    locator.joints_with_mask(image, camera, &found)?
                };
                Some(JointScore {
                    true_mask: JointErrors::of(joints, &separate, camera)?,
                    estimated_mask: JointErrors::of(joints, &whole, camera)?,
                })
            }
            None => None,
        };
        Ok(Self {
            id,
            mask: counts,
            status: estimate.status,
            joints,
        })
    }
}

pub(super) fn check_finite(mask: &Mask) -> Result<(), NotFinite> {
    match mask.probability.iter().find(|v| !v.is_finite()) {
        Some(&found) => Err(NotFinite {
            what: "mask",
            found: f64::from(found),
        }),
        None => Ok(()),
    }
}

/// A true mask, of the size of `camera`'s images and 255 where the robot is, as the networks would see
/// it: 1 where at least half of a pixel's footprint is robot, else 0. Of an image of twice the networks'
/// size, taken by their camera, a footprint is a block of 2 x 2 pixels.
pub fn network_mask(mask: &GrayImage, camera: &Camera, description: &Description) -> Mask {
    // Rounding moves the samples by some millionths of a pixel.
    const HALF: f32 = 0.5 - 1e-3;
    let input = description.input;
    let rectification = Rectification::new(camera, &description.camera, input.width, input.height);
    let colour = RgbaImage::from_fn(mask.width(), mask.height(), |x, y| {
        let [value] = mask.get_pixel(x, y).0;
        Rgba([value, value, value, 255])
    });
    let (width, height) = (input.width as usize, input.height as usize);
    let seen = reference::rectify(&colour, &rectification, &Gaze::CANONICAL, height, width);
    let red = seen.data().iter().take(width * height);
    Mask {
        width: input.width,
        height: input.height,
        probability: red.map(|&share| f32::from(share >= HALF)).collect(),
    }
}
