use glam::DVec3;

/// A low-pass filter of the first order for points, such as joints in one frame: the mean of all before, the weight of
/// each falling by `e` in every time constant.
///
/// What it gives lags behind: points that move steadily are where they were [`Smoother::lag_s`] earlier. The paper
/// judges raw output, and nothing here smooths unasked.
#[derive(Debug, Clone)]
pub struct Smoother {
    time_constant_s: f64,
    last: Option<(f64, Vec<DVec3>)>,
}

impl Smoother {
    /// Seconds; 0 smooths nothing.
    pub fn new(time_constant_s: f64) -> Self {
        Self {
            time_constant_s,
            last: None,
        }
    }

    /// By how many seconds steady motion is late.
    pub fn lag_s(&self) -> f64 {
        self.time_constant_s
    }

    /// The smoothed points at `time_s`; an earlier time than the last counts as that. After five time constants without
    /// points, or where their number changes, it starts anew.
    pub fn step(&mut self, time_s: f64, points: &[DVec3]) -> Vec<DVec3> {
        let before = self
            .last
            .as_ref()
            .map_or(f64::NEG_INFINITY, |(then, _)| *then);
        let time_s = time_s.max(before);
        let passed = time_s - before;
        let smoothed = match &self.last {
            Some((_, last))
                if last.len() == points.len() && passed < 5.0 * self.time_constant_s =>
            {
                let kept = (-passed / self.time_constant_s).exp();
                let pairs = points.iter().zip(last);
                pairs.map(|(&new, &old)| new.lerp(old, kept)).collect()
            }
            _ => points.to_vec(),
        };
        self.last = Some((time_s, smoothed.clone()));
        smoothed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steady_motion_is_late_by_the_lag() {
        let speed = DVec3::new(0.5, 0.0, -1.0);
        let mut smoother = Smoother::new(0.2);
        let mut last = DVec3::ZERO;
        for n in 0..2000 {
            let time = f64::from(n) * 1e-3;
            last = smoother.step(time, &[speed * time])[0];
        }
        let at = |time: f64| last.distance(speed * time);
        assert!(at(1.999 - smoother.lag_s()) < 1e-3);
        assert!(at(1.999) > 0.2);
    }

    #[test]
    fn noise_shrinks_and_gaps_start_anew() {
        let mut smoother = Smoother::new(1.0);
        let mut raw = 0.0;
        let mut smooth = 0.0;
        for n in 0..1000_i32 {
            let point = DVec3::splat(if n % 2 == 0 { 1.0 } else { -1.0 });
            let out = smoother.step(f64::from(n) * 0.1, &[point])[0];
            if n > 100 {
                raw += point.length();
                smooth += out.length();
            }
        }
        assert!(smooth < 0.1 * raw, "{smooth} of {raw}");
        let far = DVec3::splat(9.0);
        assert_eq!(smoother.step(200.0, &[far]), [far]);
        assert_eq!(smoother.step(199.9, &[DVec3::ZERO]), [far]);
        assert_eq!(smoother.step(200.1, &[far, far]).len(), 2);
        let mut off = Smoother::new(0.0);
        off.step(0.0, &[DVec3::ONE]);
        assert_eq!(off.step(0.1, &[far]), [far]);
    }
}
