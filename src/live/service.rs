use std::time::{Duration, Instant};

/// How long submissions take, learnt from those that are done: tells when to submit the next one.
///
/// A frame that is taken from its mailbox early waits where no newer one can replace it. So the next submission is
/// made as late as it can be without the GPU running dry.
#[derive(Debug, Default)]
pub(super) struct Service {
    /// On the GPU, by the number of frames.
    times: Vec<Option<Duration>>,
    /// What a submission costs on the CPU.
    cost: Duration,
    /// When the GPU was done the last time.
    last: Option<Instant>,
}

impl Service {
    /// A submission was made, which took so long.
    pub fn submitted(&mut self, cost: Duration) {
        self.cost = mixed(self.cost, cost);
    }

    /// A submission of `count` frames is done.
    pub fn finished(&mut self, submitted: Instant, count: usize, now: Instant) {
        let begun = self.last.map_or(submitted, |last| last.max(submitted));
        let took = now.saturating_duration_since(begun);
        self.last = Some(now);
        if self.times.len() <= count {
            self.times.resize(count + 1, None);
        }
        if let Some(time) = self.times.get_mut(count) {
            *time = Some(time.map_or(took, |time| mixed(time, took)));
        }
    }

    /// How long the oldest submission will still take. Zero where nothing is known.
    pub fn left(&self, submitted: Instant, count: usize, now: Instant) -> Duration {
        let begun = self.last.map_or(submitted, |last| last.max(submitted));
        let end = begun + self.time(count).unwrap_or_default();
        end.saturating_duration_since(now)
    }

    /// Whether the next submission is to be made now, as the oldest, of `count` frames, takes `left` still.
    /// Not before anything is known.
    pub fn is_time_for_next(&self, left: Duration, count: usize) -> bool {
        self.time(count)
            .is_some_and(|time| left <= self.cost + time / 8)
    }

    fn time(&self, count: usize) -> Option<Duration> {
        self.times.get(count).copied().flatten()
    }
}

/// A mean that follows the new.
fn mixed(old: Duration, new: Duration) -> Duration {
    (3 * old + new) / 4
}
