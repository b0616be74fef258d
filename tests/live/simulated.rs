//! Cameras, engines and sinks that are not there.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant, SystemTime};

use image::{Rgba, RgbaImage};
use whereabot::camera::{Camera, Orientation};
use whereabot::cascade::{Estimate, LocateError, Status};
use whereabot::gpu::GpuError;
use whereabot::live::{
    Calibration, Engine, Event, EventKind, Frame, IN_FLIGHT, Input, KnownModel, Observation, Shot,
    Sink, Source, SourceError, Statistics, Stop, Stream,
};

/// A model's place, of which nothing is known.
pub const fn known(place: usize) -> KnownModel {
    KnownModel {
        place,
        uncertainty_m: None,
    }
}

/// Watches with sinks that say nothing.
pub fn watch(
    inputs: Vec<Input>,
    engine: Box<dyn Engine>,
    sinks: Vec<Box<dyn Sink>>,
    stop: &Arc<Stop>,
) {
    let (_, emitted) = mpsc::channel();
    let errors = whereabot::live::watch(inputs, engine, sinks, emitted, stop);
    assert!(errors.is_empty(), "{errors:?}");
}

/// A camera that gives `count` frames, one each `period`.
pub struct Simulated {
    pub period: Duration,
    pub count: u64,
    /// Before which frame it stops for how long.
    pub pause: Option<(u64, Duration)>,
    /// From which frame on its clock is how much behind.
    pub clock_back: Option<(u64, Duration)>,
    /// At which frame it panics, each time that it is opened.
    pub panics_at: Option<u64>,
    /// What it says its camera is; its images have 64 x 48 pixels.
    pub camera: Option<Camera>,
}

impl Simulated {
    pub fn new(period: Duration, count: u64) -> Self {
        Self {
            period,
            count,
            pause: None,
            clock_back: None,
            panics_at: None,
            camera: None,
        }
    }

    pub fn input(self) -> Input {
        Input {
            source: Box::new(self),
            calibration: Calibration::Hfov(1.2),
            orientation: Orientation::NoTransforms,
            robot: 0,
            rig: None,
        }
    }
}

impl Source for Simulated {
    fn open(&mut self, stop: &Arc<Stop>) -> Result<Box<dyn Stream>, SourceError> {
        Ok(Box::new(Frames {
            period: self.period,
            left: self.count,
            number: 0,
            next: Instant::now(),
            pause: self.pause,
            clock_back: self.clock_back,
            panics_at: self.panics_at,
            camera: self.camera,
            stop: Arc::clone(stop),
        }))
    }
}

struct Frames {
    period: Duration,
    left: u64,
    number: u64,
    next: Instant,
    pause: Option<(u64, Duration)>,
    clock_back: Option<(u64, Duration)>,
    panics_at: Option<u64>,
    camera: Option<Camera>,
    stop: Arc<Stop>,
}

impl Stream for Frames {
    fn next(&mut self, image: &mut RgbaImage) -> Result<Option<Shot>, SourceError> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        if let Some((frame, pause)) = self.pause
            && frame == self.number
        {
            self.next += pause;
        }
        let now = Instant::now();
        assert_ne!(self.panics_at, Some(self.number), "this source is broken");
        if self.stop.wait(self.next.saturating_duration_since(now)) {
            return Ok(None);
        }
        self.next += self.period;
        if image.dimensions() != (64, 48) {
            *image = RgbaImage::new(64, 48);
        }
        let red = 128 + (self.number * 37 % 128) as u8;
        image.pixels_mut().for_each(|p| *p = Rgba([red, 0, 0, 255]));
        let mut shot = Shot {
            camera: self.camera,
            ..Shot::now()
        };
        if let Some((frame, back)) = self.clock_back
            && self.number >= frame
        {
            shot.acquired = SystemTime::now() - back;
        }
        self.number += 1;
        Ok(Some(shot))
    }
}

/// A GPU that takes `service` for any submission of up to `batch` frames, one after the other.
pub struct StandIn {
    pub service: Duration,
    pub batch: usize,
    pub max_side: u32,
    /// The camera whose frames it cannot take.
    pub refuses: Option<usize>,
    /// Its device is lost after so many submissions; the next one takes a longest side of so many pixels.
    pub lost: Option<(usize, u32)>,
    /// It panics after so many submissions, and once more when it is opened again.
    pub panics: Option<usize>,
    under_way: VecDeque<(Instant, usize)>,
}

impl StandIn {
    pub fn new(service: Duration, batch: usize) -> Self {
        Self {
            service,
            batch,
            max_side: 8192,
            refuses: None,
            lost: None,
            panics: None,
            under_way: VecDeque::new(),
        }
    }
}

impl Engine for StandIn {
    fn max_side(&self) -> u32 {
        self.max_side
    }

    fn batch(&self, _robot: usize, ready: usize) -> usize {
        ready.min(self.batch)
    }

    fn submit(&mut self, _robot: usize, frames: &[Frame]) -> Result<(), LocateError> {
        assert!(self.under_way.len() < IN_FLIGHT && frames.len() <= self.batch);
        if frames.iter().any(|f| self.refuses == Some(f.camera)) {
            return Err(GpuError::OutOfMemory("no place for that".into()).into());
        }
        if let Some(left) = &mut self.panics {
            *left = left.checked_sub(1).expect("this engine is broken");
        }
        match &mut self.lost {
            Some((0, _)) => return Err(GpuError::Lost("unplugged".into()).into()),
            Some((left, _)) => *left -= 1,
            None => {}
        }
        let now = Instant::now();
        let begin = self.under_way.back().map_or(now, |&(end, _)| end.max(now));
        self.under_way
            .push_back((begin + self.service, frames.len()));
        Ok(())
    }

    fn finished(&mut self) -> Result<Option<Vec<Estimate>>, LocateError> {
        match self.under_way.front() {
            Some(&(end, count)) if end <= Instant::now() => {
                self.under_way.pop_front();
                Ok(Some(vec![nothing(); count]))
            }
            _ => Ok(None),
        }
    }

    fn reopen(&mut self) -> Result<(), LocateError> {
        self.under_way.clear();
        assert!(self.panics.take().is_none(), "this engine is broken, too");
        if let Some((_, max_side)) = self.lost.take() {
            self.max_side = max_side;
        }
        Ok(())
    }
}

fn nothing() -> Estimate {
    Estimate {
        status: Status::NotFound,
        coverage: 0.0,
        bbox_px: None,
        field: 1.0,
        joints: Vec::new(),
        mask: None,
    }
}

/// Everything that a sink is told, in order.
#[derive(Debug, Clone)]
pub enum Told {
    Observation(Box<Observation>),
    Event(Event),
    Statistics(Statistics),
}

/// A sink that remembers.
#[derive(Clone, Default)]
pub struct Collector {
    pub told: Arc<Mutex<Vec<Told>>>,
}

impl Collector {
    pub fn observations(&self) -> Vec<Observation> {
        let told = self.told.lock().unwrap();
        let observations = told.iter().filter_map(|told| match told {
            Told::Observation(observation) => Some(observation.as_ref().clone()),
            _ => None,
        });
        observations.collect()
    }

    pub fn events(&self) -> Vec<(Option<usize>, EventKind)> {
        let told = self.told.lock().unwrap();
        let events = told.iter().filter_map(|told| match told {
            Told::Event(event) => Some((event.camera, event.kind.clone())),
            _ => None,
        });
        events.collect()
    }

    pub fn statistics(&self) -> Vec<Statistics> {
        let told = self.told.lock().unwrap();
        let statistics = told.iter().filter_map(|told| match told {
            Told::Statistics(statistics) => Some(statistics.clone()),
            _ => None,
        });
        statistics.collect()
    }
}

impl Sink for Collector {
    fn observation(&mut self, observation: &Observation) {
        let told = Told::Observation(Box::new(observation.clone()));
        self.told.lock().unwrap().push(told);
    }

    fn event(&mut self, event: &Event) {
        self.told.lock().unwrap().push(Told::Event(event.clone()));
    }

    fn statistics(&mut self, statistics: &Statistics) {
        let told = Told::Statistics(statistics.clone());
        self.told.lock().unwrap().push(told);
    }
}
