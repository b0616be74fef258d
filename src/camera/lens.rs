use super::Intrinsics;

/// Lens distortion, in the models of ROS `camera_info`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
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

impl Distortion {
    /// Where the lens puts a ray: from normalised coordinates `[x / z, y / z]` to distorted ones.
    /// Beyond [`Lens::max_radius`] the formula goes on, but no light comes from there.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        match self {
            Self::None => [x, y],
            Self::Rational { k, p } => {
                let radial = radial(k, x * x + y * y).factor;
                tangential(p, [x, y], radial)
            }
            Self::Equidistant { k } => {
                let r = x.hypot(y);
                // The factor tends to 1 at the axis.
                let scale = if r > 0.0 {
                    fisheye(k, r.atan()).0 / r
                } else {
                    1.0
                };
                [x * scale, y * scale]
            }
        }
    }

    /// The coefficients.
    pub(super) fn coefficients(&self) -> Vec<f64> {
        match self {
            Self::None => Vec::new(),
            Self::Rational { k, p } => k.iter().chain(p).copied().collect(),
            Self::Equidistant { k } => k.to_vec(),
        }
    }

    /// See [`Lens::max_radius`].
    fn max_radius(&self) -> f64 {
        // In terms of t = tan(angle / 2), the radius is 2 t / (1 - t^2): even steps in t are nearly
        // even in angle, and cost no trigonometry.
        let radius = |t: f64| 2.0 * t / (1.0 - t * t);
        let one_to_one = |t: f64| match self {
            Self::None => true,
            Self::Rational { k, .. } => {
                let radial = radial(k, radius(t).powi(2));
                radial.denominator > 0.0 && radial.slope > 0.0
            }
            Self::Equidistant { k } => fisheye(k, radius(t).atan()).1 > 0.0,
        };
        if *self == Self::None {
            return f64::INFINITY;
        }
        // A fold narrower than a step, 0.2 degrees, hardly shows in a picture.
        const STEPS: u32 = 512;
        let widest = (0.5 * WIDEST.to_radians()).tan();
        let at = |step: u32| widest * f64::from(step) / f64::from(STEPS);
        let Some(folded) = (1..=STEPS).find(|&step| !one_to_one(at(step))) else {
            return radius(widest);
        };
        let (mut inside, mut outside) = (at(folded - 1), at(folded));
        for _ in 0..50 {
            let middle = 0.5 * (inside + outside);
            if one_to_one(middle) {
                inside = middle;
            } else {
                outside = middle;
            }
        }
        radius(inside)
    }
}

/// The widest angle to the axis, in degrees, at which a lens that is no pinhole is followed.
const WIDEST: f64 = 89.9;

/// The radial part of the rational model at `s = r^2`.
struct Radial {
    /// Distorted radius over radius.
    factor: f64,
    /// Derivative of `factor` by `s`.
    factor_slope: f64,
    /// Derivative of the distorted radius by the radius.
    slope: f64,
    denominator: f64,
}

fn radial(k: &[f64; 6], s: f64) -> Radial {
    let [k1, k2, k3, k4, k5, k6] = *k;
    let numerator = 1.0 + s * (k1 + s * (k2 + s * k3));
    let denominator = 1.0 + s * (k4 + s * (k5 + s * k6));
    let numerator_slope = k1 + s * (2.0 * k2 + s * 3.0 * k3);
    let denominator_slope = k4 + s * (2.0 * k5 + s * 3.0 * k6);
    let factor = numerator / denominator;
    let factor_slope = (numerator_slope - factor * denominator_slope) / denominator;
    Radial {
        factor,
        factor_slope,
        slope: factor + 2.0 * s * factor_slope,
        denominator,
    }
}

fn tangential([p1, p2]: &[f64; 2], [x, y]: [f64; 2], radial: f64) -> [f64; 2] {
    let s = x * x + y * y;
    [
        x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
        y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
    ]
}

/// The distorted angle of the fisheye model, and its derivative.
fn fisheye(k: &[f64; 4], angle: f64) -> (f64, f64) {
    let [k1, k2, k3, k4] = *k;
    let s = angle * angle;
    (
        angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))),
        1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))),
    )
}

/// A camera made ready for many points: how far its lens is one to one is worked out once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    intrinsics: Intrinsics,
    distortion: Distortion,
    max_radius: f64,
}

impl Lens {
    pub(super) fn new(intrinsics: Intrinsics, distortion: Distortion) -> Self {
        Self {
            intrinsics,
            distortion,
            max_radius: distortion.max_radius(),
        }
    }

    /// The largest radius `r = hypot(x, y) / z` that the lens maps one to one; infinite for a
    /// pinhole. What lies beyond is not in the picture: a distortion polynomial folds it back over
    /// what is.
    pub fn max_radius(&self) -> f64 {
        self.max_radius
    }

    /// Projects a point of the camera optical frame, in metres, to pixels. `None` for a point that
    /// is behind the camera, not finite, or beyond [`Lens::max_radius`].
    pub fn project(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        if !(z > 0.0 && z.is_finite()) {
            return None;
        }
        let ray = [x / z, y / z];
        if !self.one_to_one(ray) {
            return None;
        }
        let pixel = self.intrinsics.pixel(self.distortion.distort(ray));
        pixel.iter().all(|v| v.is_finite()).then_some(pixel)
    }

    /// The ray `[x / z, y / z]` that a pixel sees. `None` where the lens leads no ray to it.
    pub fn unproject(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let distorted = [(u - cx) / fx, (v - cy) / fy];
        if !distorted.iter().all(|v| v.is_finite()) {
            return None;
        }
        let ray = match &self.distortion {
            Distortion::None => distorted,
            Distortion::Rational { k, p } => self.invert_rational(k, p, distorted)?,
            Distortion::Equidistant { k } => {
                let target = distorted[0].hypot(distorted[1]);
                let angle = invert(target, self.max_radius.atan(), |angle| fisheye(k, angle))?;
                // The factor tends to 1 at the axis.
                let scale = if target > 0.0 {
                    angle.tan() / target
                } else {
                    1.0
                };
                distorted.map(|v| v * scale)
            }
        };
        self.one_to_one(ray).then_some(ray)
    }

    fn one_to_one(&self, ray: [f64; 2]) -> bool {
        let r = ray[0].hypot(ray[1]);
        r.is_finite()
            && r <= self.max_radius
            && match &self.distortion {
                // The bound is that of the radial part; the tangential part shifts it a little.
                Distortion::Rational { k, p } => determinant(jacobian(k, p, ray)) > 0.0,
                Distortion::None | Distortion::Equidistant { .. } => true,
            }
    }

    /// Newton's method in two dimensions, from the inverse of the radial part.
    fn invert_rational(&self, k: &[f64; 6], p: &[f64; 2], distorted: [f64; 2]) -> Option<[f64; 2]> {
        let target = distorted[0].hypot(distorted[1]);
        let start = invert(target, self.max_radius, |r| {
            let radial = radial(k, r * r);
            (r * radial.factor, radial.slope)
        })
        .unwrap_or(self.max_radius);
        let scale = if target > 0.0 { start / target } else { 1.0 };
        let mut ray = distorted.map(|v| v * scale);
        for _ in 0..MOST_STEPS {
            let reached = tangential(p, ray, radial(k, ray[0] * ray[0] + ray[1] * ray[1]).factor);
            let [[a, b], [c, d]] = jacobian(k, p, ray);
            let determinant = determinant([[a, b], [c, d]]);
            let miss = [reached[0] - distorted[0], reached[1] - distorted[1]];
            let step = [
                (d * miss[0] - b * miss[1]) / determinant,
                (a * miss[1] - c * miss[0]) / determinant,
            ];
            ray = [ray[0] - step[0], ray[1] - step[1]];
            let length = step[0].hypot(step[1]);
            if !length.is_finite() {
                return None;
            }
            if length <= CONVERGED * (1.0 + ray[0].hypot(ray[1])) {
                return Some(ray);
            }
        }
        None
    }
}

/// Newton's method stops at a step of this size, relative to the value.
const CONVERGED: f64 = 1e-12;
/// Newton's method gives up after so many steps; four or five is the rule.
const MOST_STEPS: usize = 30;

/// The derivative of the rational model's distorted point by the ray.
fn jacobian(k: &[f64; 6], [p1, p2]: &[f64; 2], [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
    let Radial {
        factor,
        factor_slope,
        ..
    } = radial(k, x * x + y * y);
    let mixed = 2.0 * x * y * factor_slope + 2.0 * p1 * x + 2.0 * p2 * y;
    [
        [
            factor + 2.0 * x * x * factor_slope + 2.0 * p1 * y + 6.0 * p2 * x,
            mixed,
        ],
        [
            mixed,
            factor + 2.0 * y * y * factor_slope + 6.0 * p1 * y + 2.0 * p2 * x,
        ],
    ]
}

fn determinant([[a, b], [c, d]]: [[f64; 2]; 2]) -> f64 {
    a * d - b * c
}

/// The argument in `[0, upper]` at which an increasing function that is 0 at 0 reaches `target`:
/// Newton's method, kept within bounds by bisection. `f` gives the value and its derivative.
fn invert(target: f64, upper: f64, f: impl Fn(f64) -> (f64, f64)) -> Option<f64> {
    if f(upper).0 < target {
        return None;
    }
    let (mut low, mut high) = (0.0, upper);
    let mut argument = target.min(upper);
    // Bisection alone needs 53 steps for all digits.
    for _ in 0..64 {
        let (value, slope) = f(argument);
        if value > target {
            high = argument;
        } else {
            low = argument;
        }
        let newton = argument - (value - target) / slope;
        // Beside a pole the slope is so steep that Newton's steps are small far from the target.
        let stuck = (newton - argument).abs() <= CONVERGED * (1.0 + argument)
            && (value - target).abs() > 1e-9 * (1.0 + target);
        let next = if (low..=high).contains(&newton) && !stuck {
            newton
        } else {
            0.5 * (low + high)
        };
        let step = (next - argument).abs();
        argument = next;
        if step <= CONVERGED * (1.0 + argument) {
            break;
        }
    }
    Some(argument)
}
