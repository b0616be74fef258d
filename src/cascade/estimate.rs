use super::Output;
use super::view::View;
use crate::camera::Lens;
use crate::gpu::Frame;
use crate::network::Description;

/// What an image was found to show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// A robot, with joints.
    Found,
    /// No robot: too few pixels surely belong to one. There are no joints.
    NotFound,
    /// A mask that is not finite, or joints that cannot be: not finite, behind the camera or where
    /// its lens shows nothing. There are no joints.
    Invalid,
}

/// A joint's position.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// The model's name for it, such as `shoulder_pan`.
    pub name: String,
    /// Position in the camera optical frame (REP 103: x right, y down, z forward), in metres.
    pub xyz_m: [f64; 3],
    /// Position in the image as given, in pixels; (0, 0) is the centre of the top-left pixel.
    pub px: [f64; 2],
}

/// The mask at the network's size, in the canonical camera of the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Probability that a pixel shows the robot, row by row, in [0, 1].
    pub probability: Vec<f32>,
}

/// What was found in one image.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Whether there is a robot.
    pub status: Status,
    /// Share of the image as given that is robot, in [0, 1]; what the networks did not see counts
    /// as background.
    pub coverage: f64,
    /// Smallest box round the mask `[x0, y0, x1, y1]` in pixels of the image as given; `None` for an
    /// empty mask.
    pub bbox_px: Option<[f64; 4]>,
    /// Share of the image as given that lies within the networks' field of view, in [0, 1].
    pub field: f64,
    /// The joints in the model's order; empty unless `status` is [`Status::Found`].
    pub joints: Vec<Joint>,
    /// The mask, where it was asked for.
    pub mask: Option<Mask>,
}

impl Estimate {
    /// What a frame of the networks says about the image as given.
    pub(super) fn new(
        description: &Description,
        frame: Frame,
        view: &View,
        output: Output,
    ) -> Self {
        let (width, height) = (description.input.width, description.input.height);
        let pixels = width * height;
        let share = f64::from(frame.coverage.pixels) / f64::from(pixels);
        let bbox_px = frame.coverage.bbox.and_then(|bbox| view.bbox(bbox));

        let (status, joints) = if frame.coverage.not_finite > 0 {
            (Status::Invalid, Vec::new())
        } else if frame.coverage.sure < description.presence.min_sure_pixels(pixels) {
            (Status::NotFound, Vec::new())
        } else if output.mask_only {
            (Status::Found, Vec::new())
        } else {
            match joints(&frame.joints, &description.joints, &view.lens) {
                Some(joints) => (Status::Found, joints),
                None => (Status::Invalid, Vec::new()),
            }
        };
        Self {
            status,
            coverage: view.share_of_image(share),
            bbox_px,
            field: view.field,
            joints,
            mask: output.mask.then_some(Mask {
                width,
                height,
                probability: frame.mask,
            }),
        }
    }
}

/// The joints in the camera's image; `None` unless all are finite, in front of the camera and where
/// its lens can show them.
fn joints(values: &[f32], names: &[String], lens: &Lens) -> Option<Vec<Joint>> {
    values
        .chunks_exact(3)
        .zip(names)
        .map(|(xyz, name)| {
            let xyz_m = [xyz[0], xyz[1], xyz[2]].map(f64::from);
            Some(Joint {
                name: name.clone(),
                xyz_m,
                px: lens.project(xyz_m)?,
            })
        })
        .collect()
}
