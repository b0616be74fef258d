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
