use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use super::engine::{Engine, IN_FLIGHT};
use super::guard::guarded;
use super::mailbox::{Mail, Mailboxes};
use super::message::{Answer, Message};
use super::service::Service;
use super::{Frame, Observation, Stop};
use crate::cascade::{Estimate, LocateError};
use crate::gpu::{Device, GpuError};

/// Takes what is fresh from the mailboxes to the engine, and answers from it, in a thread of its own.
///
/// The camera that waits longest is served first, so that too much work drops frames of all cameras alike. Frames of a
/// rig's cameras are taken together: some time apart they would say nothing of where the cameras are.
pub(super) struct Scheduler {
    engine: Box<dyn Engine>,
    /// Each camera's robot and rig.
    cameras: Vec<(usize, Option<usize>)>,
    /// The longest side that the engine takes now, in pixels, for the readers.
    max_side: Arc<AtomicU32>,
    mailboxes: Arc<Mailboxes>,
    messages: Sender<Message>,
    stop: Arc<Stop>,
    /// In which round each camera was served last.
    served: Vec<u64>,
    /// Of each camera.
    trust: Vec<Trust>,
    round: u64,
    /// Frames that were taken with others of their rig, and go next.
    held: VecDeque<Frame>,
    under_way: VecDeque<Submission>,
    service: Service,
    /// Each camera's last answer, which nobody may have looked at yet.
    answers: Vec<Answer>,
    /// How long to wait before a device is opened again: not at all after an answer.
    patience: Duration,
    /// Used again each time: the cameras that have a frame.
    fresh: Vec<usize>,
}

/// What is known of a camera's frames since its last answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Trust {
    /// Nothing bad.
    Full,
    /// One was in a submission of several that the engine refused: it may be the one to blame, so the next goes alone.
    Alone,
    /// One was refused alone, and that is told. They still go alone.
    Refused,
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
        cameras: Vec<(usize, Option<usize>)>,
        max_side: Arc<AtomicU32>,
        mailboxes: Arc<Mailboxes>,
        messages: Sender<Message>,
        stop: Arc<Stop>,
    ) -> Self {
        Self {
            engine,
            served: vec![0; cameras.len()],
            answers: cameras.iter().map(|_| Answer::default()).collect(),
            trust: vec![Trust::Full; cameras.len()],
            fresh: Vec::with_capacity(cameras.len()),
            held: VecDeque::with_capacity(cameras.len()),
            cameras,
            max_side,
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
            // wgpu panics over some devices that are lost.
            match guarded(|| self.step()) {
                Ok(Ok(true)) => {}
                Ok(Ok(false)) => return,
                Ok(Err(error)) => self.recover(error.to_string()),
                Err(words) => self.recover(format!("the engine panicked: {words}")),
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
        let mail = if self.held.is_empty() {
            self.mailboxes.wait(wait)
        } else {
            Mail::Fresh
        };
        match mail {
            Mail::Fresh => self.submit()?,
            Mail::Closed if self.under_way.is_empty() => return Ok(false),
            Mail::Closed => std::thread::sleep(Self::POLL),
            Mail::Empty => {}
        }
        Ok(true)
    }

    /// Takes frames for a submission: of the robot whose camera waits longest. What its rig's cameras have besides is held.
    fn take(&mut self) -> Vec<Frame> {
        if let Some(frame) = self.held.pop_front() {
            return vec![frame];
        }
        let (served, trust, cameras) = (&self.served, &self.trust, &self.cameras);
        self.mailboxes.fresh(&mut self.fresh);
        self.fresh.sort_by_key(|&camera| served.get(camera));
        let Some(&oldest) = self.fresh.first() else {
            return Vec::new();
        };
        let of = |camera: usize| cameras.get(camera).copied().unwrap_or_default();
        let (robot, rig) = of(oldest);
        let is_partner = |camera: usize| rig.is_some() && of(camera).1 == rig;
        let trusted = |camera: usize| trust.get(camera) == Some(&Trust::Full);
        if trusted(oldest) {
            self.fresh
                .retain(|&camera| of(camera).0 == robot && trusted(camera));
            self.fresh.sort_by_key(|&camera| !is_partner(camera));
        } else {
            self.fresh.truncate(1);
        }
        let batch = self.engine.batch(robot, self.fresh.len());
        let partners = self.fresh.iter().filter(|&&c| is_partner(c)).count();
        self.fresh.truncate(batch.max(partners));
        self.round += 1;
        for &camera in &self.fresh {
            if let Some(served) = self.served.get_mut(camera) {
                *served = self.round;
            }
        }
        let frames = self.fresh.iter().filter_map(|&c| self.mailboxes.take(c));
        let mut frames: Vec<Frame> = frames.collect();
        self.held.extend(frames.drain(batch.min(frames.len())..));
        frames
    }

    /// Submits the next frames.
    fn submit(&mut self) -> Result<(), LocateError> {
        let frames = self.take();
        let camera = frames.first().and_then(|f| self.cameras.get(f.camera));
        let Some(&(robot, _)) = camera else {
            return Ok(());
        };
        let begun = Instant::now();
        self.under_way.push_back(Submission {
            frames,
            submitted: begun,
        });
        if let Some(submission) = self.under_way.back_mut() {
            match self.engine.submit(robot, &submission.frames) {
                Ok(()) => {
                    submission.submitted = Instant::now();
                    self.service.submitted(submission.submitted - begun);
                }
                Err(error) if is_of_device(&error) => return Err(error),
                Err(error) => self.refused(&error),
            }
        }
        Ok(())
    }

    /// The engine did not take the newest submission. What is on its way does not suffer.
    fn refused(&mut self, error: &LocateError) {
        let frames = self
            .under_way
            .pop_back()
            .map_or_else(Vec::new, |s| s.frames);
        let alone = frames.len() == 1;
        for frame in frames {
            self.mailboxes.lose(frame.camera);
            let Some(trust) = self.trust.get_mut(frame.camera) else {
                continue;
            };
            let now = if alone { Trust::Refused } else { Trust::Alone };
            let before = std::mem::replace(trust, now);
            if alone && before != Trust::Refused {
                self.tell(Message::Refused {
                    camera: frame.camera,
                    reason: error.to_string(),
                });
            }
        }
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
            if let Some(trust) = self.trust.get_mut(frame.camera) {
                *trust = Trust::Full;
            }
            self.publish(Observation {
                camera: frame.camera,
                frame: frame.number,
                acquired: frame.acquired,
                acquired_at: frame.acquired_at,
                answered_at,
                file: frame.file,
                image: frame.image,
                view: frame.view,
                estimate,
            });
        }
    }

    /// Takes the place of an answer of the same camera that nobody looked at: a sink that waits does not fill the memory.
    fn publish(&mut self, observation: Observation) {
        let camera = observation.camera;
        let answer = Answer::new(observation);
        self.tell(Message::Answered(answer.clone()));
        if let Some(last) = self.answers.get_mut(camera)
            && std::mem::replace(last, answer).take().is_some()
        {
            self.mailboxes.lose(camera);
        }
    }

    /// Opens the device again; what was under way is lost.
    fn recover(&mut self, reason: String) {
        let under_way = self.under_way.drain(..).flat_map(|s| s.frames);
        for frame in under_way.chain(self.held.drain(..)) {
            self.mailboxes.lose(frame.camera);
        }
        self.service = Service::default();
        self.tell(Message::DeviceLost { reason });
        loop {
            if !self.patience.is_zero() && self.stop.wait(self.patience) {
                return;
            }
            self.patience = (2 * self.patience).clamp(Self::RETRY, Self::RETRY_MOST);
            let opened = guarded(|| self.engine.reopen());
            match opened.and_then(|opened| opened.map_err(|error| error.to_string())) {
                Ok(()) => {
                    self.max_side
                        .store(self.engine.max_side(), Ordering::Relaxed);
                    return self.tell(Message::DeviceBack);
                }
                Err(reason) => {
                    log::warn!("no device: {reason}; tried again in {:?}", self.patience);
                }
            }
        }
    }

    fn tell(&self, message: Message) {
        // Nobody listens any more when everything stops.
        let _ = self.messages.send(message);
    }
}

/// Whether a submission failed by the device, which is to be opened again then; else by the frames themselves. A device that has a
/// fault says so in [`Engine::finished`], too.
fn is_of_device(error: &LocateError) -> bool {
    use GpuError::{Driver, Lost, Timeout};
    matches!(error, LocateError::Gpu(Lost(_) | Timeout(_) | Driver(_)))
}
