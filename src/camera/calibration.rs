use std::path::PathBuf;

use super::{Distortion, Intrinsics, Lens};

/// The camera that took an image: its size, intrinsics and lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Columns of its images.
    pub width: u32,
    /// Rows of its images.
    pub height: u32,
    /// Pinhole parameters, in pixels.
    pub intrinsics: Intrinsics,
    /// What the lens does before them.
    pub distortion: Distortion,
}

/// What is wrong with a camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// The file cannot be read.
    #[error("{}: {cause}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// The file holds no usable camera.
    #[error("{}: {cause}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        cause: Box<CameraError>,
    },
    /// The text is not a `camera_info` in YAML.
    #[error("not a camera_info in YAML: {0}")]
    Format(String),
    /// A value that no camera has.
    #[error("{field}: expected {expected}, found {found}")]
    Value {
        /// The field's name.
        field: &'static str,
        /// What a camera has.
        expected: &'static str,
        /// What there is.
        found: String,
    },
    /// All of K is zero: how ROS says that a camera was never calibrated.
    #[error("the camera is not calibrated: K is all zero; calibrate it, or give its field of view")]
    Uncalibrated,
    /// The camera takes images of another size.
    #[error(
        "the camera was calibrated at {camera_width} x {camera_height} pixels, but the image has {image_width} x {image_height}"
    )]
    Size {
        /// Columns of the camera's images.
        camera_width: u32,
        /// Rows of the camera's images.
        camera_height: u32,
        /// Columns of the image.
        image_width: u32,
        /// Rows of the image.
        image_height: u32,
    },
}

impl Camera {
    /// A pinhole with square pixels, the principal point in the middle, and a horizontal field of
    /// view of `hfov` radians, in (0, pi).
    pub fn from_hfov(width: u32, height: u32, hfov: f64) -> Self {
        Self::centred(width, height, 0.5 * f64::from(width) / (0.5 * hfov).tan())
    }

    /// A pinhole with square pixels, the principal point in the middle, and a focal length of
    /// `millimetres` in terms of 35 mm film, as EXIF's `FocalLengthIn35mmFilm` has it. Equivalent is
    /// what has the same field of view along the diagonal (CIPA DCG-001), 43.27 mm on film.
    pub fn from_focal_35mm(width: u32, height: u32, millimetres: f64) -> Self {
        let film = 36_f64.hypot(24.0);
        let diagonal = f64::from(width).hypot(f64::from(height));
        Self::centred(width, height, diagonal * millimetres / film)
    }

    /// The camera of an image of which nothing is known: a phone's main camera, a pinhole that sees
    /// 69.4 degrees along the longer side (26 mm where that side of the film has 36 mm).
    pub fn assumed(width: u32, height: u32) -> Self {
        Self::centred(width, height, f64::from(width.max(height)) * 26.0 / 36.0)
    }

    fn centred(width: u32, height: u32, focal: f64) -> Self {
        Self {
            width,
            height,
            intrinsics: Intrinsics {
                fx: focal,
                fy: focal,
                cx: 0.5 * (f64::from(width) - 1.0),
                cy: 0.5 * (f64::from(height) - 1.0),
            },
            distortion: Distortion::None,
        }
    }

    /// The camera made ready for many points.
    pub fn lens(&self) -> Lens {
        Lens::new(self.intrinsics, self.distortion)
    }

    /// [`Lens::max_radius`] of this camera.
    pub fn max_radius(&self) -> f64 {
        self.lens().max_radius()
    }

    /// Where a ray `[x / z, y / z]` meets the image, in pixels; meaningless beyond
    /// [`Camera::max_radius`].
    pub fn pixel_of_ray(&self, ray: [f64; 2]) -> [f64; 2] {
        self.intrinsics.pixel(self.distortion.distort(ray))
    }

    /// [`Lens::project`] for a single point.
    pub fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        self.lens().project(point)
    }

    /// [`Lens::unproject`] for a single pixel.
    pub fn unproject(&self, pixel: [f64; 2]) -> Option<[f64; 2]> {
        self.lens().unproject(pixel)
    }

    /// Share of this camera's image, in [0, 1], that `other`, in the same place, sees as well.
    /// Counted on a grid of up to 64 x 64 pixels.
    pub fn field_of(&self, other: &Self) -> f64 {
        const MOST: u32 = 64;
        let (lens, other_lens) = (self.lens(), other.lens());
        let (columns, rows) = (self.width.min(MOST), self.height.min(MOST));
        let centre = |index: u32, count: u32, size: u32| {
            (f64::from(index) + 0.5) * f64::from(size) / f64::from(count) - 0.5
        };
        // Pixels reach half a pixel beyond their centres.
        let within = |at: f64, side: u32| (-0.5..=f64::from(side) - 0.5).contains(&at);
        let seen = (0..rows)
            .flat_map(|row| (0..columns).map(move |column| (column, row)))
            .filter(|&(column, row)| {
                let pixel = [
                    centre(column, columns, self.width),
                    centre(row, rows, self.height),
                ];
                lens.unproject(pixel)
                    .and_then(|[x, y]| other_lens.project([x, y, 1.0]))
                    .is_some_and(|[u, v]| within(u, other.width) && within(v, other.height))
            })
            .count();
        seen as f64 / f64::from((columns * rows).max(1))
    }

    /// This camera, for an image of the given size.
    ///
    /// # Errors
    /// [`CameraError::Size`] where the camera takes images of another size.
    pub fn for_image(self, width: u32, height: u32) -> Result<Self, CameraError> {
        if (self.width, self.height) == (width, height) {
            return Ok(self);
        }
        Err(CameraError::Size {
            camera_width: self.width,
            camera_height: self.height,
            image_width: width,
            image_height: height,
        })
    }

    /// Checks that the values are those of a camera.
    ///
    /// # Errors
    /// [`CameraError::Value`] for an empty image, a focal length that is not positive, and values that
    /// are not finite; [`CameraError::Uncalibrated`].
    pub fn check(&self) -> Result<(), CameraError> {
        let wrong = |field, expected, found: &dyn std::fmt::Display| CameraError::Value {
            field,
            expected,
            found: found.to_string(),
        };
        for (field, size) in [("width", self.width), ("height", self.height)] {
            if size == 0 {
                return Err(wrong(field, "at least 1 pixel", &size));
            }
        }
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        if [fx, fy, cx, cy] == [0.0; 4] {
            return Err(CameraError::Uncalibrated);
        }
        for (field, focal) in [("fx", fx), ("fy", fy)] {
            if !(focal.is_finite() && focal > 0.0) {
                return Err(wrong(field, "a positive focal length in pixels", &focal));
            }
        }
        for (field, centre) in [("cx", cx), ("cy", cy)] {
            if !centre.is_finite() {
                return Err(wrong(field, "a finite number of pixels", &centre));
            }
        }
        let coefficients = self.distortion.coefficients();
        match coefficients.iter().find(|c| !c.is_finite()) {
            Some(c) => Err(wrong("distortion", "finite coefficients", c)),
            None => Ok(()),
        }
    }
}
