use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Tells everything that runs to stop, once and for all; who waits is woken.
#[derive(Debug, Default)]
pub struct Stop {
    set: Mutex<bool>,
    woken: Condvar,
}

impl Stop {
    /// Stops everything.
    pub fn set(&self) {
        *self.set.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.woken.notify_all();
    }

    /// Whether everything is to stop.
    pub fn is_set(&self) -> bool {
        *self.set.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sleeps for `time`, or until everything is to stop: whether it is.
    pub fn wait(&self, time: Duration) -> bool {
        let set = self.set.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.woken.wait_timeout_while(set, time, |set| !*set);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }
}
