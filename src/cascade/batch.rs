use std::collections::VecDeque;
use std::sync::Arc;

use image::RgbaImage;

use super::view::View;
use super::{Estimate, LocateError, Output};
use crate::camera::{Camera, Texels};
use crate::gpu::{Device, GpuError, Mapped, Mapping, Plan, Precision, Rectify, mapped};
use crate::network::{Description, Model};

/// Finds the robot of one model in the images of many cameras: some a submission, several submissions on their way.
///
/// The answers are those of a [`super::Locator`].
#[derive(Debug)]
pub struct BatchLocator {
    device: Arc<Device>,
    plan: Box<Plan>,
    description: Description,
    output: Output,
    cameras: Vec<Place>,
    idle: Vec<Slot>,
    in_flight: VecDeque<Flight>,
}

/// What a [`BatchLocator`] is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BatchOptions {
    /// What activations are stored in.
    pub precision: Precision,
    /// How many cameras there are.
    pub cameras: usize,
    /// Images a submission.
    pub batch: usize,
    /// Most submissions on their way at the same time.
    pub in_flight: usize,
    /// Whether estimates have masks.
    pub mask: bool,
}

/// An image of one of the cameras.
#[derive(Debug, Clone, Copy)]
pub struct BatchImage<'a> {
    /// Which camera, below [`BatchOptions::cameras`]. Each has a texture of its own.
    pub place: usize,
    /// Its image, of the camera's size; alpha is ignored.
    pub image: &'a RgbaImage,
    /// The camera.
    pub camera: &'a Camera,
}

/// A camera's texture, and what the networks see of it.
#[derive(Debug)]
struct Place {
    source: Rectify,
    view: Option<View>,
}

/// Where a submission's results come back.
#[derive(Debug)]
struct Slot {
    results: wgpu::Buffer,
    masks: Option<wgpu::Buffer>,
    /// The cameras of that submission.
    views: Vec<View>,
}

#[derive(Debug)]
struct Flight {
    slot: Slot,
    /// Of the results, and of the masks.
    mappings: Vec<Mapping>,
}

impl BatchLocator {
    /// Plans `model`: allocates, compiles and binds everything but what depends on the images' sizes.
    ///
    /// # Errors
    /// A batch, or submissions on their way, of none; a layer that exceeds the device's limits, or a driver's refusal.
    pub fn new(
        device: Arc<Device>,
        model: &Model,
        options: BatchOptions,
    ) -> Result<Self, LocateError> {
        let BatchOptions {
            precision, batch, ..
        } = options;
        if options.in_flight == 0 {
            return Err(GpuError::Zero { what: "in_flight" }.into());
        }
        let plan = Box::new(Plan::new(&device, model, batch, precision)?);
        let (cameras, idle) = device.scoped(|| {
            let places = (0..options.cameras).map(|_| Place {
                source: Rectify::new(&device),
                view: None,
            });
            let slots = (0..options.in_flight).map(|_| Slot {
                results: plan.results_buffer(&device),
                masks: options.mask.then(|| plan.masks_buffer(&device)),
                views: Vec::with_capacity(batch),
            });
            Ok((places.collect(), slots.collect()))
        })?;
        Ok(Self {
            device,
            plan,
            description: model.description.clone(),
            output: Output {
                mask: options.mask,
                mask_only: false,
            },
            cameras,
            idle,
            in_flight: VecDeque::with_capacity(options.in_flight),
        })
    }

    /// How many submissions are on their way.
    pub fn in_flight(&self) -> usize {
        self.in_flight.len()
    }

    /// Submits `images`, as many as the batch has, each of another camera. False where as many submissions as
    /// [`BatchOptions::in_flight`] are on their way already: nothing is submitted then. Nothing is waited for.
    ///
    /// # Errors
    /// Another number of images, a camera that there is not, two images of one camera, an image of another size than its camera's or beyond
    /// the adapter's limits, a camera that [`Camera::check`] refuses; a device that was lost.
    pub fn submit(&mut self, images: &[BatchImage<'_>]) -> Result<bool, LocateError> {
        self.device.check()?;
        let batch = self.plan.batch();
        if images.len() != batch {
            return Err(GpuError::Size {
                what: "images of a submission",
                expected: batch,
                found: images.len(),
            }
            .into());
        }
        for (index, BatchImage { place, .. }) in images.iter().enumerate() {
            if images.iter().take(index).any(|other| other.place == *place) {
                return Err(LocateError::SameCamera { place: *place });
            }
        }
        let Some(mut slot) = self.idle.pop() else {
            return Ok(false);
        };
        slot.views.clear();
        let mut written = Ok(());
        for (index, image) in images.iter().enumerate() {
            match self.write(index, image) {
                Ok(view) => slot.views.push(view),
                Err(error) => written = Err(error),
            }
        }
        if let Err(error) = written {
            self.idle.push(slot);
            return Err(error);
        }
        let places = images
            .iter()
            .filter_map(|image| self.cameras.get(image.place));
        let sources = places.map(|place| &place.source);
        let mut encoder = self
            .device
            .wgpu()
            .create_command_encoder(&Default::default());
        self.plan
            .dispatch(&mut encoder, self.plan.steps_of(sources, true), None);
        self.plan.copy_results(&mut encoder, &slot.results);
        if let Some(masks) = &slot.masks {
            self.plan.copy_masks(&mut encoder, masks);
        }
        let buffers = [Some(&slot.results), slot.masks.as_ref()];
        let mappings = buffers.into_iter().flatten().map(|buffer| {
            let (mapping, callback) = Mapping::new();
            encoder.map_buffer_on_submit(buffer, wgpu::MapMode::Read, .., callback);
            mapping
        });
        let mappings = mappings.collect();
        self.device.queue().submit([encoder.finish()]);
        self.in_flight.push_back(Flight { slot, mappings });
        Ok(true)
    }

    /// What was found in the images of the oldest submission, in their order; `None` while it is on its way, or
    /// none is. Never waits; polls the device.
    ///
    /// # Errors
    /// A device that was lost: no submission on its way will be answered.
    pub fn finished(&mut self) -> Result<Option<Vec<Estimate>>, LocateError> {
        self.device.poll(wgpu::PollType::Poll)?;
        let Some(mut flight) = self.in_flight.pop_front() else {
            return Ok(None);
        };
        let states: Vec<Mapped> = flight.mappings.iter_mut().map(Mapping::state).collect();
        if states.contains(&Mapped::Pending) {
            self.in_flight.push_front(flight);
            return Ok(None);
        }
        if states.iter().any(|&state| state != Mapped::Ready) {
            let lost = "a submission's results will not arrive".to_owned();
            return Err(GpuError::Lost(lost).into());
        }
        let slot = flight.slot;
        let mut frames =
            mapped(&slot.results, |bytes| self.plan.frames_in(bytes))?.ok_or_else(Plan::not_run)?;
        if let Some(masks) = &slot.masks {
            mapped(masks, |bytes| self.plan.put_masks(&mut frames, bytes))?;
        }
        let estimates = frames
            .into_iter()
            .zip(&slot.views)
            .map(|(frame, view)| Estimate::new(&self.description, frame, view, self.output))
            .collect();
        self.idle.push(slot);
        Ok(Some(estimates))
    }

    /// Writes image `index` of the next submission.
    fn write(&mut self, index: usize, image: &BatchImage<'_>) -> Result<View, LocateError> {
        let BatchImage {
            place,
            image,
            camera,
        } = *image;
        let places = self.cameras.len();
        let place = self.cameras.get_mut(place).ok_or(GpuError::Size {
            what: "camera",
            expected: places,
            found: place,
        })?;
        let size = image.dimensions().into();
        let view = View::of(place.view, camera, size, Texels::PLAIN, &self.description)?;
        place.view = Some(view);
        self.plan.write_source(
            &self.device,
            &mut place.source,
            index,
            image,
            &view.rectification,
        )?;
        Ok(view)
    }
}
