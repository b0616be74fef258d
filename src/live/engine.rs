use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use image::RgbaImage;

use super::Frame;
use crate::camera::Camera;
use crate::cascade::{
    BatchImage, BatchLocator, BatchOptions, Estimate, LocateError, Locator, Output,
};
use crate::gpu::{Device, GpuError, Precision, device_type};
use crate::network::Model;

/// What searches frames, some a submission.
pub trait Engine: Send {
    /// The longest side of a frame that it takes, in pixels.
    fn max_side(&self) -> u32;

    /// How many of `ready` frames (at least one) of robot `robot` go into one submission.
    fn batch(&self, robot: usize, ready: usize) -> usize;

    /// Submits frames of cameras that look at robot `robot`, as many as [`Engine::batch`] said; not more than
    /// [`IN_FLIGHT`] submissions are ever on their way. Does not wait for the answers.
    ///
    /// # Errors
    /// [`GpuError::Lost`], [`GpuError::Timeout`] and [`GpuError::Driver`]: nothing on its way will be answered. Any other is of
    /// these frames alone: they are not submitted, and what is on its way is answered.
    fn submit(&mut self, robot: usize, frames: &[Frame]) -> Result<(), LocateError>;

    /// What was found in the frames of the oldest submission, in their order; `None` while it is on its way.
    /// Never waits.
    ///
    /// # Errors
    /// A device that was lost or has another fault, also while nothing is on its way: nothing will be answered.
    fn finished(&mut self) -> Result<Option<Vec<Estimate>>, LocateError>;

    /// Forgets everything that is on its way, and opens the device again.
    ///
    /// # Errors
    /// What keeps it from being opened now; it may be tried again.
    fn reopen(&mut self) -> Result<(), LocateError>;
}

/// Most submissions on their way at the same time: while one runs, the next one is made ready.
pub const IN_FLIGHT: usize = 2;

/// What opens a device, and opens it again after it was lost.
pub type OpenDevice = Box<dyn FnMut() -> Result<Arc<Device>, GpuError> + Send>;

/// The cascades of one or several robots on one GPU.
pub struct GpuEngine {
    open: OpenDevice,
    models: Vec<Model>,
    options: GpuOptions,
    max_side: u32,
    /// Of each robot, the locators by their batch's size, the largest first.
    robots: Vec<Vec<(usize, BatchLocator)>>,
    /// Robot and place of those that run a submission, the oldest first.
    under_way: VecDeque<(usize, usize)>,
}

/// What a [`GpuEngine`] is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GpuOptions {
    /// What activations are stored in.
    pub precision: Precision,
    /// How many cameras there are.
    pub cameras: usize,
    /// Whether estimates have masks.
    pub mask: bool,
}

/// Batch sizes on a GPU: as many images as fill one are submitted at once. A CPU rasteriser takes as long for two
/// images as for one after the other, and answers the first one sooner so.
const BATCHES: [usize; 4] = [8, 4, 2, 1];

impl GpuEngine {
    /// Opens a device, plans `models` on it, and runs each kernel once, so that no frame waits for a compiler.
    ///
    /// # Errors
    /// No device, a layer that exceeds its limits, a driver's refusal.
    pub fn new(
        open: OpenDevice,
        models: Vec<Model>,
        options: GpuOptions,
    ) -> Result<Self, LocateError> {
        let mut engine = Self {
            open,
            models,
            options,
            max_side: 0,
            robots: Vec::new(),
            under_way: VecDeque::with_capacity(IN_FLIGHT),
        };
        engine.reopen()?;
        Ok(engine)
    }
}

impl Engine for GpuEngine {
    fn max_side(&self) -> u32 {
        self.max_side
    }

    fn batch(&self, robot: usize, ready: usize) -> usize {
        let sizes = self.robots.get(robot).into_iter().flatten();
        let mut sizes = sizes.map(|&(size, _)| size);
        sizes.find(|&size| size <= ready).unwrap_or(1)
    }

    fn submit(&mut self, robot: usize, frames: &[Frame]) -> Result<(), LocateError> {
        let sizes = self.robots.get_mut(robot).into_iter().flatten();
        let found = sizes
            .enumerate()
            .find(|(_, (size, _))| *size == frames.len());
        let Some((place, (_, locator))) = found else {
            return Err(LocateError::Shape("batch"));
        };
        let images: Vec<BatchImage<'_>> = frames
            .iter()
            .map(|frame| BatchImage {
                place: frame.camera,
                image: &frame.image,
                camera: &frame.view,
            })
            .collect();
        if !locator.submit(&images)? {
            return Err(LocateError::Shape("submissions on their way"));
        }
        self.under_way.push_back((robot, place));
        Ok(())
    }

    fn finished(&mut self) -> Result<Option<Vec<Estimate>>, LocateError> {
        // Where nothing is on its way, any of them knows whether the device has a fault.
        let (robot, place) = self.under_way.front().copied().unwrap_or_default();
        let locator = self.robots.get_mut(robot).and_then(|r| r.get_mut(place));
        let finished = match locator {
            Some((_, locator)) => locator.finished()?,
            None => None,
        };
        if finished.is_some() {
            self.under_way.pop_front();
        }
        Ok(finished)
    }

    fn reopen(&mut self) -> Result<(), LocateError> {
        self.under_way.clear();
        self.robots.clear();
        let device = (self.open)()?;
        self.max_side = device.wgpu().limits().max_texture_dimension_2d;
        let largest = if device.info().device_type == wgpu::DeviceType::Cpu {
            1
        } else {
            self.options.cameras
        };
        log::info!(
            "{} ({}), batches of up to {largest}",
            device.info().name,
            device_type(device.info())
        );
        let GpuOptions {
            precision,
            cameras,
            mask,
        } = self.options;
        for model in &self.models {
            let sizes = planned(largest, |batch| {
                let options = BatchOptions {
                    precision,
                    cameras,
                    batch,
                    in_flight: IN_FLIGHT,
                    mask,
                };
                let mut locator = BatchLocator::new(Arc::clone(&device), model, options)?;
                warm_up(&mut locator, batch)?;
                Ok(locator)
            })?;
            self.robots.push(sizes);
        }
        Ok(())
    }
}

/// What `plan` makes of each batch size up to `largest`, the largest first. Sizes that the device has no room for are left
/// out: smaller ones do their work. One image must have room.
fn planned<T>(
    largest: usize,
    mut plan: impl FnMut(usize) -> Result<T, LocateError>,
) -> Result<Vec<(usize, T)>, LocateError> {
    let mut sizes = Vec::new();
    for batch in BATCHES
        .into_iter()
        .filter(|&size| size == 1 || size <= largest)
    {
        match plan(batch) {
            Err(LocateError::Gpu(error @ (GpuError::OutOfMemory(_) | GpuError::Limit { .. })))
                if batch > 1 =>
            {
                log::warn!("no batches of {batch}: {error}")
            }
            made => sizes.push((batch, made?)),
        }
    }
    Ok(sizes)
}

/// Runs everything once, on blank images.
fn warm_up(locator: &mut BatchLocator, batch: usize) -> Result<(), LocateError> {
    let image = RgbaImage::new(8, 8);
    let camera = Camera::assumed(8, 8);
    let images: Vec<BatchImage<'_>> = (0..batch)
        .map(|place| BatchImage {
            place,
            image: &image,
            camera: &camera,
        })
        .collect();
    locator.submit(&images)?;
    let start = Instant::now();
    while locator.finished()?.is_none() {
        if start.elapsed() > Device::TIMEOUT {
            return Err(GpuError::Timeout(Device::TIMEOUT).into());
        }
        std::thread::sleep(Duration::from_micros(200));
    }
    Ok(())
}

impl fmt::Debug for GpuEngine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("GpuEngine")
            .field("options", &self.options)
            .field("under_way", &self.under_way)
            .finish_non_exhaustive()
    }
}

/// The cascades in plain Rust: a frame a submission, which it waits for.
#[derive(Debug)]
pub struct CpuEngine {
    locators: Vec<Locator>,
    output: Output,
    answers: VecDeque<Vec<Estimate>>,
}

impl CpuEngine {
    /// Of `models`, with or without masks.
    pub fn new(models: &[Model], mask: bool) -> Self {
        Self {
            locators: models.iter().map(Locator::on_cpu).collect(),
            output: Output {
                mask,
                mask_only: false,
            },
            answers: VecDeque::new(),
        }
    }
}

impl Engine for CpuEngine {
    fn max_side(&self) -> u32 {
        u32::MAX
    }

    fn batch(&self, _robot: usize, _ready: usize) -> usize {
        1
    }

    fn submit(&mut self, robot: usize, frames: &[Frame]) -> Result<(), LocateError> {
        let locator = self.locators.get_mut(robot);
        let locator = locator.ok_or(LocateError::Shape("robot"))?;
        let estimates = frames
            .iter()
            .map(|frame| locator.locate(&frame.image, &frame.view, self.output))
            .collect::<Result<_, _>>()?;
        self.answers.push_back(estimates);
        Ok(())
    }

    fn finished(&mut self) -> Result<Option<Vec<Estimate>>, LocateError> {
        Ok(self.answers.pop_front())
    }

    fn reopen(&mut self) -> Result<(), LocateError> {
        self.answers.clear();
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn no_room() -> LocateError {
        GpuError::OutOfMemory("none".into()).into()
    }

    fn too_large() -> LocateError {
        GpuError::Limit {
            what: "bytes".into(),
            needed: 2,
            allowed: 1,
            adapter: "small".into(),
        }
        .into()
    }

    fn lost() -> LocateError {
        GpuError::Lost("gone".into()).into()
    }

    /// The sizes that are left where those over `most` are refused.
    fn left(most: usize, refusal: fn() -> LocateError) -> Result<Vec<usize>, LocateError> {
        let plan = |batch| if batch > most { Err(refusal()) } else { Ok(()) };
        let planned = planned(8, plan)?;
        Ok(planned.into_iter().map(|(size, ())| size).collect())
    }

    #[test]
    fn batches_without_room_are_left_out() {
        for refusal in [no_room, too_large] {
            assert_eq!(left(8, refusal).unwrap(), [8, 4, 2, 1]);
            assert_eq!(left(2, refusal).unwrap(), [2, 1]);
            assert_eq!(left(1, refusal).unwrap(), [1]);
            left(0, refusal).unwrap_err();
        }
        // Negative control: another fault is no question of room.
        left(2, lost).unwrap_err();
    }
}
