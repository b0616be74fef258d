use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use super::engine::{Engine, IN_FLIGHT};
use super::mailbox::{Mail, Mailboxes};
use super::message::Message;
use super::service::Service;
use super::{Frame, Observation, Stop};
use crate::cascade::{Estimate, LocateError};
use crate::gpu::{Device, GpuError};

/// Takes what is fresh from the mailboxes to the engine, and answers from it, in a thread of its own.
///
/// The camera that waits longest is served first, so that too much work drops frames of all cameras alike.
pub(super) struct Scheduler {
    engine: Box<dyn Engine>,
    /// Each camera's robot.
    robots: Vec<usize>,
    mailboxes: Arc<Mailboxes>,
    messages: Sender<Message>,
    stop: Arc<Stop>,
    /// In which round each camera was served last.
    served: Vec<u64>,
    round: u64,
    under_way: VecDeque<Submission>,
    service: Service,
    /// How long to wait before a device is opened again: not at all after an answer.
    patience: Duration,
    /// Used again each time: the cameras that have a frame.
    fresh: Vec<usize>,
}

struct Submission {
    frames: Vec<Frame>,
    submitted: Instant,
}

impl Scheduler {
    /// Between two looks at the engine, at least; at most as long as this while nothing happens.
    const POLL: Duration = Duration::from_micros(200);
    const IDLE: Duration = Duration::from_millis(50);
    /// Between two tries to open a device: twice as long each time.
    const RETRY: Duration = Duration::from_millis(100);
    const RETRY_MOST: Duration = Duration::from_secs(5);

    pub fn new(
        engine: Box<dyn Engine>,
        robots: Vec<usize>,
        mailboxes: Arc<Mailboxes>,
        messages: Sender<Message>,
        stop: Arc<Stop>,
    ) -> Self {
        Self {
            engine,
            served: vec![0; robots.len()],
            fresh: Vec::with_capacity(robots.len()),
            robots,
            mailboxes,
            messages,
            stop,
            round: 0,
            under_way: VecDeque::with_capacity(IN_FLIGHT),
            service: Service::default(),
            patience: Duration::ZERO,
        }
    }

    /// Until everything is to stop, or no camera has more frames and all are answered.
    pub fn run(mut self) {
        while !self.stop.is_set() {
            match self.step() {
                Ok(true) => {}
                Ok(false) => return,
                Err(error) => self.recover(&error),
            }
        }
    }

    /// Does what is to be done now, or waits for it a little. False at the end.
    fn step(&mut self) -> Result<bool, LocateError> {
        if let Some(estimates) = self.engine.finished()? {
            self.answer(estimates);
            return Ok(true);
        }
        let now = Instant::now();
        let wait = match self.under_way.front() {
            None => Self::IDLE,
            Some(oldest) if oldest.submitted.elapsed() > Device::TIMEOUT => {
                return Err(GpuError::Timeout(Device::TIMEOUT).into());
            }
            Some(oldest) => {
                let count = oldest.frames.len();
                let left = self.service.left(oldest.submitted, count, now);
                if self.under_way.len() == IN_FLIGHT || !self.service.is_time_for_next(left, count)
                {
                    std::thread::sleep((left / 8).clamp(Self::POLL, 10 * Self::POLL));
                    return Ok(true);
                }
                Self::POLL
            }
        };
        match self.mailboxes.wait(wait) {
            Mail::Fresh => self.submit()?,
            Mail::Closed if self.under_way.is_empty() => return Ok(false),
            Mail::Closed => std::thread::sleep(Self::POLL),
            Mail::Empty => {}
        }
        Ok(true)
    }

    /// Submits frames of the robot whose camera waits longest.
    fn submit(&mut self) -> Result<(), LocateError> {
        self.mailboxes.fresh(&mut self.fresh);
        let served = &self.served;
        self.fresh.sort_by_key(|&camera| served.get(camera));
        let robot = |camera: &usize| self.robots.get(*camera).copied().unwrap_or_default();
        let Some(first) = self.fresh.first().map(robot) else {
            return Ok(());
        };
        self.fresh.retain(|camera| robot(camera) == first);
        self.fresh
            .truncate(self.engine.batch(first, self.fresh.len()));
        self.round += 1;
        for &camera in &self.fresh {
            if let Some(served) = self.served.get_mut(camera) {
                *served = self.round;
            }
        }
        let frames = self.fresh.iter().filter_map(|&c| self.mailboxes.take(c));
        let frames: Vec<Frame> = frames.collect();
        let begun = Instant::now();
        self.under_way.push_back(Submission {
            frames,
            submitted: begun,
        });
        if let Some(submission) = self.under_way.back_mut() {
            self.engine.submit(first, &submission.frames)?;
            submission.submitted = Instant::now();
            self.service.submitted(submission.submitted - begun);
        }
        Ok(())
    }

    /// Tells what was found in the oldest submission.
    fn answer(&mut self, estimates: Vec<Estimate>) {
        let answered_at = Instant::now();
        self.patience = Duration::ZERO;
        let Some(submission) = self.under_way.pop_front() else {
            return;
        };
        let count = submission.frames.len();
        self.service
            .finished(submission.submitted, count, answered_at);
        for (frame, estimate) in submission.frames.into_iter().zip(estimates) {
            self.tell(Message::Answered(Box::new(Observation {
                camera: frame.camera,
                frame: frame.number,
                acquired: frame.acquired,
                acquired_at: frame.acquired_at,
                answered_at,
                image: frame.image,
                view: frame.view,
                estimate,
            })));
        }
    }

    /// Opens the device again; what was under way is lost.
    fn recover(&mut self, error: &LocateError) {
        for frame in self.under_way.drain(..).flat_map(|s| s.frames) {
            self.mailboxes.lose(frame.camera);
        }
        self.service = Service::default();
        self.tell(Message::DeviceLost {
            reason: error.to_string(),
        });
        loop {
            if !self.patience.is_zero() && self.stop.wait(self.patience) {
                return;
            }
            self.patience = (2 * self.patience).clamp(Self::RETRY, Self::RETRY_MOST);
            match self.engine.reopen() {
                Ok(()) => return self.tell(Message::DeviceBack),
                Err(error) => log::warn!("no device: {error}; tried again in {:?}", self.patience),
            }
        }
    }

    fn tell(&self, message: Message) {
        // Nobody listens any more when everything stops.
        let _ = self.messages.send(message);
    }
}
