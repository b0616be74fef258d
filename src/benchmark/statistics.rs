/// Values that were measured again and again.
#[derive(Debug, Clone, Default)]
pub(super) struct Sample(Vec<f64>);

impl Sample {
    pub fn push(&mut self, value: f64) {
        self.0.push(value);
    }

    /// The smallest value that is not below a `share` of all, by nearest rank; `None` without values.
    pub fn percentile(&self, share: f64) -> Option<f64> {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.max(1) - 1).copied()
    }

    pub fn least(&self) -> Option<f64> {
        self.percentile(0.0)
    }

    pub fn median(&self) -> Option<f64> {
        self.percentile(0.5)
    }
}

/// To six digits: more than a clock is good for.
pub(super) fn rounded(value: f64) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let scale = 10_f64.powi(5 - value.abs().log10().floor() as i32);
    (value * scale).round() / scale
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_values_that_were_measured() {
        let mut sample = Sample::default();
        assert_eq!(sample.median(), None);
        for value in (1..=100).rev() {
            sample.push(f64::from(value));
        }
        let percentiles = [0.0, 0.5, 0.95, 0.99, 1.0].map(|share| sample.percentile(share));
        assert_eq!(percentiles, [1.0, 50.0, 95.0, 99.0, 100.0].map(Some));
        sample.push(1000.0);
        assert_eq!(sample.percentile(1.0), Some(1000.0));
    }
}
