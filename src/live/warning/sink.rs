use std::fmt;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use super::action::{Actions, Emit};
use super::config::{Config, ConfigError, Observer};
use super::monitor::{Monitor, Told};
use crate::live::{Event, EventKind, Observation, Sink, Statistics};

/// Why warnings could not be started.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WarningsError {
    /// The configuration is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The system gives no thread.
    #[error("no thread for warnings: {0}")]
    Thread(#[from] std::io::Error),
}

/// Judges observations by the configuration's rules, tells every change as an event, and acts on it.
///
/// A thread of its own watches the time: rules become unknown even if nobody calls.
pub struct Warnings {
    watch: Arc<Watch>,
    /// Ends the thread when it is dropped.
    _end: Sender<()>,
}

impl fmt::Debug for Warnings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Warnings")
            .field("cameras", &self.watch.cameras)
            .finish_non_exhaustive()
    }
}

/// Shared by the sink and its thread.
struct Watch {
    cameras: Vec<String>,
    /// Locked until all that changed is told, so that it is told in order.
    monitor: Mutex<Monitor>,
    actions: Actions,
    emit: Emit,
}

impl Warnings {
    /// How often the time is looked at.
    pub const TICK: Duration = Duration::from_millis(20);

    /// Starts to watch `cameras`, in the order of [`Observation::camera`]. `emit` gets the events, each rule's first one at
    /// once; it must not wait, and is called from several threads. What it emits may come back through [`Sink::event`].
    ///
    /// # Errors
    /// Where the configuration is wrong, or the system gives no thread.
    pub fn start(
        config: &Config,
        cameras: &[Observer],
        emit: impl Fn(Event) + Send + Sync + 'static,
    ) -> Result<Self, WarningsError> {
        let monitor = Monitor::new(config, cameras)?;
        let emit: Emit = Arc::new(emit);
        let watch = Arc::new(Watch {
            cameras: cameras.iter().map(|camera| camera.name.clone()).collect(),
            monitor: Mutex::new(monitor),
            actions: Actions::start(config, &emit)?,
            emit,
        });
        let (end, ended) = mpsc::channel::<()>();
        let ticking = Arc::clone(&watch);
        thread::Builder::new()
            .name("warnings".into())
            .spawn(move || {
                while ended.recv_timeout(Self::TICK) == Err(RecvTimeoutError::Timeout) {
                    ticking.judge(Monitor::tick);
                }
            })?;
        // Last: what it acts on cannot be taken back.
        watch.judge(Monitor::tick);
        Ok(Self { watch, _end: end })
    }
}

impl Watch {
    fn judge(&self, judge: impl FnOnce(&mut Monitor, Instant) -> Vec<Told>) {
        let mut monitor = self.monitor.lock().unwrap_or_else(PoisonError::into_inner);
        // Of those who wait for each other, the later one has the later time.
        for (camera, warning) in judge(&mut monitor, Instant::now()) {
            let at = SystemTime::now();
            let name = camera
                .and_then(|camera| self.cameras.get(camera))
                .map(String::as_str);
            self.actions.act(&warning, name, at);
            (self.emit)(Event {
                at,
                camera,
                kind: EventKind::Warning(warning),
            });
        }
    }
}

impl Drop for Warnings {
    fn drop(&mut self) {
        self.watch.actions.close();
    }
}

impl Sink for Warnings {
    fn observation(&mut self, observation: &Observation) {
        self.watch.judge(|monitor, now| {
            monitor.frame(
                observation.camera,
                observation.frame,
                observation.acquired_at,
                &observation.estimate,
                now,
            )
        });
    }

    fn event(&mut self, event: &Event) {
        self.watch
            .judge(|monitor, now| monitor.event(event.camera, &event.kind, now));
    }

    fn statistics(&mut self, _: &Statistics) {}
}
