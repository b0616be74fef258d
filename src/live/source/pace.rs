use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::live::Stop;

/// Lets pictures that lie on a disk come one at a time, as a camera's.
#[derive(Debug)]
pub(super) struct Pace {
    period: Duration,
    next: Instant,
    stop: Arc<Stop>,
}

impl Pace {
    /// Between two pictures, where `fps` asks for more, or for none.
    const LONGEST: Duration = Duration::from_secs(24 * 60 * 60);

    pub fn new(fps: f64, stop: &Arc<Stop>) -> Self {
        Self {
            period: Duration::try_from_secs_f64(1.0 / fps)
                .map_or(Self::LONGEST, |period| period.min(Self::LONGEST)),
            next: Instant::now(),
            stop: Arc::clone(stop),
        }
    }

    /// Waits until it is time for the next picture: false when everything is to stop.
    pub fn wait(&mut self) -> bool {
        let now = Instant::now();
        if self.stop.wait(self.next.saturating_duration_since(now)) {
            return false;
        }
        // A picture that took too long does not make the next ones hurry.
        self.next = self.next.max(now) + self.period;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_pace_is_too_slow_to_be_told() {
        for (fps, period) in [
            (4.0, Duration::from_millis(250)),
            (1e-30, Pace::LONGEST),
            (0.0, Pace::LONGEST),
            (f64::NAN, Pace::LONGEST),
        ] {
            let mut pace = Pace::new(fps, &Arc::default());
            assert_eq!(pace.period, period);
            assert!(pace.wait());
        }
    }
}
