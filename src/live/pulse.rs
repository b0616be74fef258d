use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::Rates;

/// A camera's life: whether its frames come as they should, and its figures over a second.
#[derive(Debug, Default)]
pub(super) struct Pulse {
    state: State,
    /// Frames come, and the engine does not take them.
    refused: bool,
    last: Option<Instant>,
    /// Between the last frames, the oldest first.
    intervals: VecDeque<Duration>,
    frames: u32,
    ages: Vec<Duration>,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
enum State {
    /// No frame yet, or none since its source failed or ended.
    #[default]
    Silent,
    Live,
    Stale,
}

impl Pulse {
    /// What a frame may be late, besides two periods.
    const GRACE: Duration = Duration::from_millis(100);
    /// How many intervals tell the period.
    const INTERVALS: usize = 16;
    /// The period, at least, until half as many are known: some streams begin with frames that were kept.
    const PERIOD: Duration = Duration::from_millis(500);

    /// A frame came: whether the camera is live from now on.
    pub fn arrived(&mut self, at: Instant) -> bool {
        self.frames += 1;
        let was = std::mem::replace(&mut self.state, State::Live);
        let last = self.last.replace(at);
        match last {
            Some(last) if was != State::Silent => {
                if self.intervals.len() == Self::INTERVALS {
                    self.intervals.pop_front();
                }
                self.intervals.push_back(at.saturating_duration_since(last));
            }
            _ => self.intervals.clear(),
        }
        was != State::Live && !self.refused
    }

    /// Between frames: what three of four intervals do not exceed, so that neither a pause nor a burst counts.
    fn period(&self) -> Duration {
        let mut sorted: Vec<Duration> = self.intervals.iter().copied().collect();
        sorted.sort_unstable();
        let period = percentile(&sorted, 75).unwrap_or_default();
        if sorted.len() < Self::INTERVALS / 2 {
            period.max(Self::PERIOD)
        } else {
            period
        }
    }

    /// The source failed or ended.
    pub fn silenced(&mut self) {
        self.state = State::Silent;
    }

    /// The engine did not take a frame: the camera is not live before one is answered.
    pub fn refused(&mut self) {
        self.silenced();
        self.refused = true;
    }

    /// A frame was answered: whether the camera is live from now on.
    pub fn answered(&mut self, age: Duration) -> bool {
        self.ages.push(age);
        std::mem::take(&mut self.refused) && self.state == State::Live
    }

    /// Until when the next frame must come; `None` where none is expected.
    pub fn deadline(&self) -> Option<Instant> {
        let last = self.last.filter(|_| self.state == State::Live)?;
        Some(last + 2 * self.period() + Self::GRACE)
    }

    /// Whether the camera is stale from now on.
    pub fn is_overdue(&mut self, now: Instant) -> bool {
        let overdue = self.deadline().is_some_and(|deadline| deadline < now);
        if overdue {
            self.state = State::Stale;
        }
        overdue
    }

    /// The figures since the last call, `elapsed` ago.
    pub fn rates(&mut self, elapsed: Duration, dropped: u64) -> Rates {
        self.ages.sort_unstable();
        let seconds = elapsed.as_secs_f64();
        let rates = Rates {
            frames_per_s: f64::from(std::mem::take(&mut self.frames)) / seconds,
            answers_per_s: self.ages.len() as f64 / seconds,
            dropped,
            age_p50: percentile(&self.ages, 50),
            age_p99: percentile(&self.ages, 99),
        };
        self.ages.clear();
        rates
    }
}

/// The least value that `percent` of the sorted `values` do not exceed.
fn percentile(values: &[Duration], percent: usize) -> Option<Duration> {
    let rank = (values.len() * percent).div_ceil(100);
    values.get(rank.saturating_sub(1)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TICK: Duration = Duration::from_millis(40);

    #[test]
    fn a_camera_is_stale_after_two_periods_and_100_ms_and_not_before() {
        let start = Instant::now();
        let mut pulse = Pulse::default();
        assert_eq!(pulse.deadline(), None);
        let mut at = start;
        for frame in 0..100 {
            assert_eq!(pulse.arrived(at), frame == 0);
            at += TICK;
        }
        let last = at - TICK;
        let deadline = last + 2 * TICK + Pulse::GRACE;
        assert_eq!(pulse.deadline(), Some(deadline));
        assert!(!pulse.is_overdue(deadline));
        assert!(pulse.is_overdue(deadline + Duration::from_millis(1)));
        // Once is enough.
        assert!(!pulse.is_overdue(deadline + TICK));
        // The pause is no period.
        assert!(pulse.arrived(last + 100 * TICK));
        assert_eq!(pulse.deadline(), Some(last + 102 * TICK + Pulse::GRACE));
    }

    #[test]
    fn a_burst_at_the_beginning_is_no_pace() {
        let start = Instant::now();
        let mut pulse = Pulse::default();
        let slow = 5 * TICK;
        for _ in 0..4 {
            pulse.arrived(start);
        }
        for frame in 1..20 {
            let at = start + frame * slow;
            assert!(!pulse.is_overdue(at), "{frame}");
            pulse.arrived(at);
        }
        let last = start + 19 * slow;
        assert_eq!(pulse.deadline(), Some(last + 2 * slow + Pulse::GRACE));
    }

    #[test]
    fn a_source_that_failed_is_not_stale_too() {
        let mut pulse = Pulse::default();
        let now = Instant::now();
        pulse.arrived(now);
        pulse.silenced();
        assert!(!pulse.is_overdue(now + Duration::from_secs(60)));
        assert!(pulse.arrived(now + Duration::from_secs(61)));
    }

    #[test]
    fn percentiles_are_of_the_second() {
        let mut pulse = Pulse::default();
        let milliseconds = Duration::from_millis;
        for age in (1..=200).rev() {
            pulse.answered(milliseconds(age));
        }
        let rates = pulse.rates(Duration::from_secs(2), 7);
        assert_eq!(rates.age_p50, Some(milliseconds(100)));
        assert_eq!(rates.age_p99, Some(milliseconds(198)));
        assert_eq!(rates.answers_per_s, 100.0);
        assert_eq!(rates.dropped, 7);
        let rates = pulse.rates(Duration::from_secs(1), 7);
        assert_eq!((rates.age_p50, rates.answers_per_s), (None, 0.0));
    }
}
