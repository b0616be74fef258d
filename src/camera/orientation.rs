use bytemuck::{Pod, Zeroable};
use image::metadata::Orientation;

use super::{Camera, Distortion, Intrinsics};

/// Where the pixels of a camera's image lie in what holds it, in texels: a phone's sensor lies on its
/// side, a front camera's picture is mirrored, and what is of interest may be a part.
///
/// Pixel `[u, v]` is texel `origin + across * u + down * v`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Texels {
    /// From a pixel to the next one to its right.
    pub across: [i32; 2],
    /// From a pixel to the next one below.
    pub down: [i32; 2],
    /// Of pixel (0, 0).
    pub origin: [i32; 2],
}

/// A part of an image as it is stored, in texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Crop {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Crop {
    /// All of an image of `width` x `height`.
    pub fn whole(width: u32, height: u32) -> Self {
        Self {
            x: 0,
            y: 0,
            width,
            height,
        }
    }

    /// Columns and rows of what it holds, once turned as `orientation` says.
    pub fn turned(&self, orientation: Orientation) -> [u32; 2] {
        if is_on_its_side(orientation) {
            [self.height, self.width]
        } else {
            [self.width, self.height]
        }
    }
}

impl Texels {
    /// Of an image that was stored as it is.
    pub const PLAIN: Self = Self {
        across: [1, 0],
        down: [0, 1],
        origin: [0, 0],
    };

    /// Of what `crop` holds, which is upright once turned as `orientation` says (EXIF).
    pub fn new(crop: Crop, orientation: Orientation) -> Self {
        let [left, top] = [crop.x, crop.y].map(|v| v as i32);
        let right = left + crop.width as i32 - 1;
        let bottom = top + crop.height as i32 - 1;
        let (across, down, origin) = match orientation {
            Orientation::NoTransforms => ([1, 0], [0, 1], [left, top]),
            Orientation::FlipHorizontal => ([-1, 0], [0, 1], [right, top]),
            Orientation::Rotate180 => ([-1, 0], [0, -1], [right, bottom]),
            Orientation::FlipVertical => ([1, 0], [0, -1], [left, bottom]),
            Orientation::Rotate90FlipH => ([0, 1], [1, 0], [left, top]),
            Orientation::Rotate90 => ([0, -1], [1, 0], [left, bottom]),
            Orientation::Rotate270FlipH => ([0, -1], [-1, 0], [right, bottom]),
            Orientation::Rotate270 => ([0, 1], [-1, 0], [right, top]),
        };
        Self {
            across,
            down,
            origin,
        }
    }

    /// The texel of pixel `[u, v]`.
    pub fn at(&self, [u, v]: [i32; 2]) -> [i32; 2] {
        [0, 1].map(|axis| self.origin[axis] + self.across[axis] * u + self.down[axis] * v)
    }

    /// The pixel of texel `at`, which may lie between texels.
    pub fn pixel(&self, at: [f64; 2]) -> [f64; 2] {
        let from = [0, 1].map(|axis| at[axis] - f64::from(self.origin[axis]));
        // The two steps are at right angles, and one texel long.
        [self.across, self.down]
            .map(|step| from[0] * f64::from(step[0]) + from[1] * f64::from(step[1]))
    }
}

fn is_on_its_side(orientation: Orientation) -> bool {
    matches!(
        orientation,
        Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH
    )
}

impl Camera {
    /// The camera of the part of this one's images that `crop` holds.
    #[must_use]
    pub fn cropped(self, crop: Crop) -> Self {
        let Intrinsics { cx, cy, .. } = self.intrinsics;
        Self {
            width: crop.width,
            height: crop.height,
            intrinsics: Intrinsics {
                cx: cx - f64::from(crop.x),
                cy: cy - f64::from(crop.y),
                ..self.intrinsics
            },
            ..self
        }
    }

    /// The camera of this one's images turned as `orientation` says: its optical frame turns with
    /// them. A picture that is mirrored by it was a mirror's.
    #[must_use]
    pub fn oriented(self, orientation: Orientation) -> Self {
        let stored = Crop::whole(self.width, self.height);
        let texels = Texels::new(stored, orientation);
        let [width, height] = stored.turned(orientation);
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let [cx, cy] = texels.pixel([cx, cy]);
        let (fx, fy) = if is_on_its_side(orientation) {
            (fy, fx)
        } else {
            (fx, fy)
        };
        let distortion = match self.distortion {
            // Tangential distortion has a direction, (p2, p1).
            Distortion::Rational { k, p: [p1, p2] } => {
                let [p2, p1] = [texels.across, texels.down]
                    .map(|step| p2 * f64::from(step[0]) + p1 * f64::from(step[1]));
                Distortion::Rational { k, p: [p1, p2] }
            }
            other => other,
        };
        Self {
            width,
            height,
            intrinsics: Intrinsics { fx, fy, cx, cy },
            distortion,
        }
    }
}
