use std::ops::AddAssign;

use serde::Serialize;

use super::NotFinite;

/// How an estimated mask agrees with the true one, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MaskCounts {
    /// Robot in both.
    pub hits: u64,
    /// Robot in truth alone.
    pub misses: u64,
    /// Robot in the estimate alone.
    pub false_alarms: u64,
    /// Background in both.
    pub background: u64,
}

impl MaskCounts {
    /// The share of pixels that are right (paper, section 5, "mask accuracy"); `None` without pixels.
    pub fn accuracy(&self) -> Option<f64> {
        let right = self.hits + self.background;
        share(right, right + self.misses + self.false_alarms)
    }

    /// Intersection over union; `None` where neither mask has a robot.
    pub fn iou(&self) -> Option<f64> {
        share(self.hits, self.hits + self.misses + self.false_alarms)
    }

    /// The share of estimated robot pixels that are right; `None` without any.
    pub fn precision(&self) -> Option<f64> {
        share(self.hits, self.hits + self.false_alarms)
    }

    /// The share of true robot pixels that are found; `None` without any.
    pub fn recall(&self) -> Option<f64> {
        share(self.hits, self.hits + self.misses)
    }

    /// The share of pixels that are robot in truth; `None` without pixels.
    pub fn coverage(&self) -> Option<f64> {
        let robot = self.hits + self.misses;
        share(robot, robot + self.false_alarms + self.background)
    }
}

fn share(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

/// Counts pairs (robot in truth, robot in the estimate).
impl FromIterator<(bool, bool)> for MaskCounts {
    fn from_iter<I: IntoIterator<Item = (bool, bool)>>(pairs: I) -> Self {
        let mut counts = Self::default();
        for pair in pairs {
            *match pair {
                (true, true) => &mut counts.hits,
                (true, false) => &mut counts.misses,
                (false, true) => &mut counts.false_alarms,
                (false, false) => &mut counts.background,
            } += 1;
        }
        counts
    }
}

impl AddAssign for MaskCounts {
    fn add_assign(&mut self, other: Self) {
        self.hits += other.hits;
        self.misses += other.misses;
        self.false_alarms += other.false_alarms;
        self.background += other.background;
    }
}

/// What many values come to.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// How many.
    pub count: usize,
    /// Their mean.
    pub mean: f64,
    /// Half of them are at most this.
    pub median: f64,
    /// 95 % of them are at most this.
    pub p95: f64,
}

impl Summary {
    /// Of finite values, in any order; `None` of none. Between two values that a percentile falls
    /// between, it is interpolated linearly.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.into_iter().collect();
        sorted.sort_by(f64::total_cmp);
        Some(Self {
            count: sorted.len(),
            mean: sorted.iter().sum::<f64>() / sorted.len() as f64,
            median: percentile(&sorted, 0.5)?,
            p95: percentile(&sorted, 0.95)?,
        })
    }
}

/// The value that the share `part` of `sorted` does not exceed; `None` of none.
fn percentile(sorted: &[f64], part: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let place = part * last as f64;
    let low = *sorted.get(place.floor() as usize)?;
    let high = *sorted.get(place.ceil() as usize)?;
    Some(low + (high - low) * place.fract())
}

/// Euclidean distances between pairs of points in metres, in centimetres (paper, section 5).
///
/// # Errors
/// A coordinate that is not finite.
pub fn distances_cm(truth: &[[f64; 3]], estimate: &[[f64; 3]]) -> Result<Vec<f64>, NotFinite> {
    let metres = distances(truth, estimate, "joints (metres)")?;
    Ok(metres.into_iter().map(|d| 100.0 * d).collect())
}

/// Euclidean distances between pairs of points in an image, in its pixels.
///
/// # Errors
/// A coordinate that is not finite.
pub fn distances_px(truth: &[[f64; 2]], estimate: &[[f64; 2]]) -> Result<Vec<f64>, NotFinite> {
    distances(truth, estimate, "joints (pixels)")
}

fn distances<const N: usize>(
    truth: &[[f64; N]],
    estimate: &[[f64; N]],
    what: &'static str,
) -> Result<Vec<f64>, NotFinite> {
    let pairs = truth.iter().zip(estimate);
    pairs
        .map(|(a, b)| {
            let square = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
            let distance = square.sqrt();
            if distance.is_finite() {
                Ok(distance)
            } else {
                let found = a.iter().chain(b).copied().find(|v| !v.is_finite());
                let found = found.unwrap_or(distance);
                Err(NotFinite { what, found })
            }
        })
        .collect()
}
