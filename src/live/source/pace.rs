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
    pub fn new(fps: f64, stop: &Arc<Stop>) -> Self {
        Self {
            period: Duration::from_secs_f64(1.0 / fps),
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
