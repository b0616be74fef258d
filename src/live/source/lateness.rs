use std::time::{Duration, Instant};

/// How late a stream's frames come: decoded slower than they are taken, they wait where nobody sees it.
///
/// A stream's own clock tells when each was taken, but for a constant. The frame that came soonest gives that.
#[derive(Debug, Default)]
pub(super) struct Lateness {
    /// When the last frame came, and the least of when frames came less when they were taken, seconds after the first came.
    last: Option<(Instant, f64)>,
    first: Option<Instant>,
}

impl Lateness {
    /// What a camera's clock may go wrong in a second: as much of the least is forgotten.
    const DRIFT: f64 = 1e-3;

    /// Of the frame that came `at` and was taken at `time_s` by the stream's clock.
    pub fn of(&mut self, at: Instant, time_s: f64) -> Duration {
        let first = *self.first.get_or_insert(at);
        let offset = at.saturating_duration_since(first).as_secs_f64() - time_s;
        let least = self.last.map_or(offset, |(last, least)| {
            let passed = at.saturating_duration_since(last).as_secs_f64();
            offset.min(least + Self::DRIFT * passed)
        });
        self.last = Some((at, least));
        // A time that is no number of seconds is no time.
        Duration::try_from_secs_f64(offset - least).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lateness of a frame of 10 a second that are decoded at `rate` a second, by a clock that is `slow` a second.
    fn after(seconds: u32, rate: f64, slow: f64) -> f64 {
        let start = Instant::now();
        let mut lateness = Lateness::default();
        let frames = 0..(f64::from(seconds) * rate) as u32;
        let late = frames.map(|frame| {
            let at = start + Duration::from_secs_f64(f64::from(frame) / rate);
            lateness.of(at, 5.0 + (1.0 - slow) * f64::from(frame) / 10.0)
        });
        late.last().unwrap_or_default().as_secs_f64()
    }

    #[test]
    fn frames_that_wait_are_late_and_a_clock_that_drifts_is_not() {
        // Half as many as come: each second half a second more.
        let late = after(20, 5.0, 0.0);
        assert!((9.8..=10.0).contains(&late), "{late}");
        assert!(after(20, 10.0, 0.0) < 1e-6);
        assert!(after(36_000, 10.0, 1e-4) < 1e-3);
        // Negative control: a clock that is slower than clocks are.
        assert!(after(3_600, 10.0, 1e-2) > 30.0);
    }

    #[test]
    fn a_burst_at_the_beginning_was_late_and_a_jump_is_no_number() {
        let start = Instant::now();
        let mut lateness = Lateness::default();
        // What a server kept comes at once.
        for frame in 0..5 {
            assert_eq!(lateness.of(start, f64::from(frame) / 10.0), Duration::ZERO);
        }
        let late = lateness.of(start + Duration::from_millis(600), 0.5);
        assert!((late.as_secs_f64() - 0.4994).abs() < 1e-6, "{late:?}");
        assert_eq!(lateness.of(start, f64::NAN), Duration::ZERO);
    }
}
