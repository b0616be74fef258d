use super::Intrinsics;

/// Lens distortion, in the models of ROS `camera_info`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Distortion {
    /// A pinhole.
    #[default]
    None,
    /// `plumb_bob` (`k[3..] = 0`) and `rational_polynomial`: radial
    /// `(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`, tangential `p1, p2`.
    Rational {
        /// `k1, k2, k3, k4, k5, k6`.
        k: [f64; 6],
        /// `p1, p2`.
        p: [f64; 2],
    },
    /// `equidistant` (fisheye): `theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`.
    Equidistant {
        /// `k1, k2, k3, k4`.
        k: [f64; 4],
    },
}

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

impl Camera {
    /// A pinhole with square pixels, the principal point in the middle, and a horizontal field of
    /// view of `hfov` radians.
    pub fn from_hfov(width: u32, height: u32, hfov: f64) -> Self {
        let focal = 0.5 * f64::from(width) / (0.5 * hfov).tan();
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
}

impl Camera {
    /// Infinite for now.
    pub fn max_radius(&self) -> f64 {
        f64::INFINITY
    }

    /// Pinhole for now.
    pub fn pixel_of_ray(&self, ray: [f64; 2]) -> [f64; 2] {
        [
            ray[0] * self.intrinsics.fx + self.intrinsics.cx,
            ray[1] * self.intrinsics.fy + self.intrinsics.cy,
        ]
    }
}

impl Camera {
    /// Stub.
    pub fn project(&self, p: [f64; 3]) -> Option<[f64; 2]> {
        self.intrinsics.project(p)
    }

    /// Stub.
    pub fn field_of(&self, _canonical: &Intrinsics, _width: u32, _height: u32) -> f64 {
        1.0
    }
}
