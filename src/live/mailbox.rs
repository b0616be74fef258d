use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::Frame;

/// A mailbox a camera, in which a newer frame replaces an older one: never a queue.
#[derive(Debug)]
pub(super) struct Mailboxes {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    frames: Vec<Option<Frame>>,
    dropped: Vec<u64>,
    /// Readers that may still put frames in.
    readers: usize,
}

/// What there is in mailboxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mail {
    /// At least one frame.
    Fresh,
    /// None yet.
    Empty,
    /// None, and none will come.
    Closed,
}

impl Mailboxes {
    /// Of `cameras` cameras, with a reader each.
    pub fn new(cameras: usize) -> Self {
        Self {
            state: Mutex::new(State {
                frames: (0..cameras).map(|_| None).collect(),
                dropped: vec![0; cameras],
                readers: cameras,
            }),
            changed: Condvar::new(),
        }
    }

    /// Puts a frame into its camera's mailbox. One that lies there still is dropped, and counted.
    pub fn put(&self, frame: Frame) {
        let mut state = self.lock();
        let camera = frame.camera;
        let old = state
            .frames
            .get_mut(camera)
            .and_then(|place| place.replace(frame));
        if old.is_some() {
            state.count_dropped(camera);
        }
        drop(state);
        self.changed.notify_all();
    }

    /// A reader will put in nothing more.
    pub fn close(&self) {
        let mut state = self.lock();
        state.readers = state.readers.saturating_sub(1);
        drop(state);
        self.changed.notify_all();
    }

    /// Waits until there is a frame or none will come, at most for `timeout`.
    pub fn wait(&self, timeout: Duration) -> Mail {
        let empty = |state: &mut State| state.mail() == Mail::Empty;
        let waited = self.changed.wait_timeout_while(self.lock(), timeout, empty);
        waited.unwrap_or_else(PoisonError::into_inner).0.mail()
    }

    /// The cameras that have a frame.
    pub fn fresh(&self, cameras: &mut Vec<usize>) {
        cameras.clear();
        let state = self.lock();
        let frames = state.frames.iter().enumerate();
        cameras.extend(
            frames
                .filter(|(_, f)| f.is_some())
                .map(|(camera, _)| camera),
        );
    }

    /// Takes a camera's frame out.
    pub fn take(&self, camera: usize) -> Option<Frame> {
        self.lock().frames.get_mut(camera)?.take()
    }

    /// Counts a frame that was taken out and got no answer.
    pub fn lose(&self, camera: usize) {
        self.lock().count_dropped(camera);
    }

    /// How many frames of a camera got no answer.
    pub fn dropped(&self, camera: usize) -> u64 {
        self.lock().dropped.get(camera).copied().unwrap_or_default()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn mail(&self) -> Mail {
        if self.frames.iter().any(Option::is_some) {
            Mail::Fresh
        } else if self.readers == 0 {
            Mail::Closed
        } else {
            Mail::Empty
        }
    }

    fn count_dropped(&mut self, camera: usize) {
        if let Some(count) = self.dropped.get_mut(camera) {
            *count += 1;
        }
    }
}
