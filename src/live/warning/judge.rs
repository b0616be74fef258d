use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::{State, Why};

/// How close is too close, in order of danger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// Farther than `warn_m`.
    Clear,
    /// Within `warn_m`.
    Warn,
    /// Within `stop_m`.
    Stop,
}

impl From<Level> for State {
    fn from(level: Level) -> Self {
        match level {
            Level::Clear => Self::Clear,
            Level::Warn => Self::Warn,
            Level::Stop => Self::Stop,
        }
    }
}

/// What a camera's distances are judged by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Within this it is [`Level::Warn`], in metres.
    pub warn_m: f64,
    /// Within this it is [`Level::Stop`], in metres; less than `warn_m`.
    pub stop_m: f64,
    /// How much farther than a limit it must be to be less dangerous again, in metres.
    pub hysteresis_m: f64,
    /// So many frames must agree before anything changes; at least 1.
    pub agree: usize,
    /// A frame says nothing about now once it is older than this.
    pub max_age: Duration,
}

impl Limits {
    fn level(&self, distance_m: f64) -> Level {
        if distance_m <= self.stop_m {
            Level::Stop
        } else if distance_m <= self.warn_m {
            Level::Warn
        } else {
            Level::Clear
        }
    }
}

/// Judges what one camera measures. It has no clock: callers say when it is.
///
/// - Known is what the last `agree` usable frames say, and unknown what `agree` unusable ones in a row do.
/// - More dangerous: all of them are within the limit. Less dangerous: all are beyond the limit and the hysteresis.
/// - From unknown, what the least of their distances says with hysteresis.
/// - Unknown at once: no usable frame that is younger than `max_age`; a camera that is lost.
#[derive(Debug, Clone)]
pub struct Judge {
    limits: Limits,
    /// Of the last usable frames, `agree` at most.
    distances: VecDeque<f64>,
    /// Unusable frames in a row.
    unusable: usize,
    /// When the last usable frame was taken.
    usable_at: Option<Instant>,
    /// What was taken before this says nothing.
    lost_at: Option<Instant>,
    judged: Result<Level, Why>,
}

impl Judge {
    /// Unknown.
    pub fn new(limits: Limits) -> Self {
        Self {
            limits,
            distances: VecDeque::with_capacity(limits.agree),
            unusable: 0,
            usable_at: None,
            lost_at: None,
            judged: Err(Why::Starting),
        }
    }

    /// What is known, or why nothing is.
    pub fn judged(&self) -> Result<Level, Why> {
        self.judged
    }

    /// The last usable distance, in metres, while anything is known.
    pub fn distance_m(&self) -> Option<f64> {
        self.judged.ok().and(self.distances.back().copied())
    }

    /// A frame taken at `acquired_at` was answered: the distance in metres, less the uncertainty, or why there is none.
    pub fn frame(&mut self, acquired_at: Instant, distance_m: Result<f64, Why>, now: Instant) {
        self.tick(now);
        if self.lost_at.is_some_and(|lost| acquired_at < lost) {
            return;
        }
        if now.saturating_duration_since(acquired_at) > self.limits.max_age {
            self.forget(Why::Late);
            return;
        }
        match distance_m {
            Ok(distance_m) if !distance_m.is_nan() => self.usable(acquired_at, distance_m),
            Ok(_) => self.unusable(Why::Invalid),
            Err(why) => self.unusable(why),
        }
    }

    /// Time passes.
    pub fn tick(&mut self, now: Instant) {
        let too_old = |at| now.saturating_duration_since(at) > self.limits.max_age;
        if self.usable_at.is_some_and(too_old) {
            self.forget(Why::NoAnswer);
        }
    }

    /// The camera gives nothing more; frames taken before `now` that are still on their way do not count.
    pub fn lost(&mut self, why: Why, now: Instant) {
        self.lost_at = Some(now);
        self.forget(why);
    }

    fn usable(&mut self, acquired_at: Instant, distance_m: f64) {
        self.unusable = 0;
        self.usable_at = Some(acquired_at);
        if self.distances.len() >= self.limits.agree {
            self.distances.pop_front();
        }
        self.distances.push_back(distance_m);
        if self.distances.len() < self.limits.agree {
            return;
        }
        let farthest = self.distances.iter().copied().fold(f64::MIN, f64::max);
        let nearest = self.distances.iter().copied().fold(f64::MAX, f64::min);
        // All agree that it is at least this dangerous, and at most that.
        let least = self.limits.level(farthest);
        let most = self.limits.level(nearest - self.limits.hysteresis_m);
        self.judged = Ok(match self.judged {
            Ok(level) => level.max(least).min(most),
            Err(_) => most,
        });
    }

    fn unusable(&mut self, why: Why) {
        self.unusable += 1;
        if self.unusable >= self.limits.agree {
            self.forget(why);
        }
    }

    fn forget(&mut self, why: Why) {
        self.distances.clear();
        self.usable_at = None;
        self.judged = Err(why);
    }
}
