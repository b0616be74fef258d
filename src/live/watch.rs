use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use super::engine::Engine;
use super::mailbox::Mailboxes;
use super::message::Message;
use super::pulse::Pulse;
use super::reader::Reader;
use super::scheduler::Scheduler;
use super::{Event, EventKind, Input, Sink, SinkError, Statistics, Stop, Word};

/// Watches cameras until `stop` is set, or all sources came to their end and all their frames are answered. Then
/// `sinks` finish; what kept any from it is returned. What arrives from `words`, where sinks send what they have to
/// say, goes to all sinks.
///
/// Threads that cannot be stopped in time (a driver that does not return) are left behind.
pub fn watch(
    inputs: Vec<Input>,
    engine: Box<dyn Engine>,
    sinks: Vec<Box<dyn Sink>>,
    words: Receiver<Word>,
    stop: &Arc<Stop>,
) -> Vec<SinkError> {
    let mailboxes = Arc::new(Mailboxes::new(inputs.len()));
    let max_side = Arc::new(AtomicU32::new(engine.max_side()));
    let (sender, messages) = channel();
    let cameras = inputs.iter().map(|input| (input.robot, input.rig));
    let pulses = inputs.iter().map(|_| Pulse::default()).collect();
    let scheduler = Scheduler::new(
        engine,
        cameras.collect(),
        Arc::clone(&max_side),
        Arc::clone(&mailboxes),
        sender.clone(),
        Arc::clone(stop),
    );
    thread::spawn(move || scheduler.run());
    for (camera, input) in inputs.into_iter().enumerate() {
        let reader = Reader {
            camera,
            input,
            max_side: Arc::clone(&max_side),
            mailboxes: Arc::clone(&mailboxes),
            messages: sender.clone(),
            stop: Arc::clone(stop),
        };
        thread::spawn(move || reader.run());
    }
    drop(sender);
    let mut desk = Desk {
        sinks,
        words,
        pulses,
        mailboxes,
        ticked: Instant::now(),
    };
    desk.run(&messages, stop);
    desk.pass_on();
    let finished = desk.sinks.iter_mut().map(|sink| sink.finish());
    finished.filter_map(Result::err).collect()
}

/// Where all that happens comes together, in order.
struct Desk {
    sinks: Vec<Box<dyn Sink>>,
    words: Receiver<Word>,
    pulses: Vec<Pulse>,
    mailboxes: Arc<Mailboxes>,
    /// When the last second was over.
    ticked: Instant,
}

impl Desk {
    const SECOND: Duration = Duration::from_secs(1);
    /// The longest wait for anything.
    const LOOK: Duration = Duration::from_millis(50);
    /// Most messages between two looks at the clock.
    const MOST: usize = 1000;
    /// How long threads have to end.
    const FAREWELL: Duration = Duration::from_millis(250);

    fn run(&mut self, messages: &Receiver<Message>, stop: &Stop) {
        while !stop.is_set() {
            // A frame that came in time is not late because we are.
            for message in messages.try_iter().take(Self::MOST) {
                self.handle(message);
            }
            let now = Instant::now();
            self.look(now);
            self.pass_on();
            match messages.recv_timeout(self.wait(now)) {
                Ok(message) => self.handle(message),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
        // Until all threads have hung up.
        let end = Instant::now() + Self::FAREWELL;
        while let Some(left) = end.checked_duration_since(Instant::now()) {
            match messages.recv_timeout(left) {
                Ok(message) => self.handle(message),
                Err(_) => return,
            }
        }
    }

    /// Until something is due.
    fn wait(&self, now: Instant) -> Duration {
        let deadlines = self.pulses.iter().filter_map(Pulse::deadline);
        let due = deadlines.chain([self.ticked + Self::SECOND]).min();
        let wait = due.map_or(Self::LOOK, |due| due.saturating_duration_since(now));
        // A deadline is over a moment after it.
        (wait + Duration::from_micros(1)).min(Self::LOOK)
    }

    /// What has become due.
    fn look(&mut self, now: Instant) {
        for camera in 0..self.pulses.len() {
            let pulse = self.pulses.get_mut(camera);
            if pulse.is_some_and(|pulse| pulse.is_overdue(now)) {
                self.event(Some(camera), EventKind::Stale);
            }
        }
        let elapsed = now.saturating_duration_since(self.ticked);
        if elapsed >= Self::SECOND {
            self.ticked = now;
            let cameras = self.pulses.iter_mut().enumerate();
            let cameras =
                cameras.map(|(camera, p)| p.rates(elapsed, self.mailboxes.dropped(camera)));
            let statistics = Statistics {
                at: SystemTime::now(),
                cameras: cameras.collect(),
            };
            for sink in &mut self.sinks {
                sink.statistics(&statistics);
            }
        }
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Arrived { camera, at } => {
                let pulse = self.pulses.get_mut(camera);
                if pulse.is_some_and(|pulse| pulse.arrived(at)) {
                    self.event(Some(camera), EventKind::Live);
                }
            }
            Message::Failed {
                camera,
                reason,
                retry_in,
            } => {
                self.silence(camera);
                self.event(Some(camera), EventKind::Failed { reason, retry_in });
            }
            Message::Refused { camera, reason } => {
                if let Some(pulse) = self.pulses.get_mut(camera) {
                    pulse.refused();
                }
                // With the next frame.
                let retry_in = Some(Duration::ZERO);
                self.event(Some(camera), EventKind::Failed { reason, retry_in });
            }
            Message::Ended { camera } => {
                self.silence(camera);
                self.event(Some(camera), EventKind::Ended);
            }
            Message::Answered(answer) => {
                // A newer one is on its way where there is none.
                let Some(observation) = answer.take() else {
                    return;
                };
                let pulse = self.pulses.get_mut(observation.camera);
                if pulse.is_some_and(|pulse| pulse.answered(observation.age())) {
                    self.event(Some(observation.camera), EventKind::Live);
                }
                for sink in &mut self.sinks {
                    sink.observation(&observation);
                }
                // What a sink says of this answer does not wait for the next one.
                self.pass_on();
            }
            Message::DeviceLost { reason } => self.event(None, EventKind::DeviceLost { reason }),
            Message::DeviceBack => self.event(None, EventKind::DeviceBack),
        }
    }

    fn silence(&mut self, camera: usize) {
        if let Some(pulse) = self.pulses.get_mut(camera) {
            pulse.silenced();
        }
    }

    fn event(&mut self, camera: Option<usize>, kind: EventKind) {
        self.tell(&Event {
            at: SystemTime::now(),
            camera,
            kind,
        });
        self.pass_on();
    }

    /// Tells all sinks what one of them said.
    fn pass_on(&mut self) {
        while let Ok(word) = self.words.try_recv() {
            match word {
                Word::Event(event) => self.tell(&event),
                Word::Fused(fused) => {
                    for sink in &mut self.sinks {
                        sink.fused(&fused);
                    }
                }
            }
        }
    }

    fn tell(&mut self, event: &Event) {
        for sink in &mut self.sinks {
            sink.event(event);
        }
    }
}
