use std::collections::VecDeque;
use std::sync::Arc;
use std::task::Poll;

use super::view::View;
use super::{Estimate, LocateError, Output};
use crate::camera::{Camera, Crop, Orientation, Texels, Unrectification};
use crate::gpu::{
    Device, GpuError, Mapped, Mapping, Outputs, Plan, Planes, Precision, Step, estimate_wgsl,
    mapped,
};
use crate::network::{Description, Model};

/// Finds the robot of one model for a program that owns the wgpu device: reads the host's textures, records
/// into the host's encoders, leaves the answers on the GPU.
///
/// Nothing is submitted, read back or waited for but by the calls that say so. The host's queue must be the
/// one that the [`Device`] was made with.
///
/// ```no_run
/// # use std::sync::Arc;
/// # use whereabot::{camera::Camera, cascade::{HostLocator, HostOptions, Source}, gpu::Device, network::Model};
/// # fn host(device: wgpu::Device, queue: wgpu::Queue, camera_texture: wgpu::TextureView, model: &Model)
/// #     -> Result<(), Box<dyn std::error::Error>> {
/// let ours = Arc::new(Device::from_host(device.clone(), queue.clone())?);
/// let mut locator = HostLocator::new(ours, model, HostOptions::default())?;
/// let camera = Camera::from_hfov(1280, 720, 69_f64.to_radians());
/// locator.set_source(0, &Source::new(camera_texture, camera))?;
///
/// let mut encoder = device.create_command_encoder(&Default::default());
/// locator.encode(&mut encoder)?;
/// // The host's own passes draw with `locator.mask(0)` and `locator.estimates()`, in the same frame.
/// locator.read_back(&mut encoder, 1)?;
/// queue.submit([encoder.finish()]);
///
/// // In some later frame:
/// if let Some(located) = locator.latest()? {
///     println!("frame {}: {:?}", located.frame, located.estimates);
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct HostLocator {
    device: Arc<Device>,
    plan: Box<Plan>,
    outputs: Outputs,
    description: Description,
    mask: MaskSize,
    views: Vec<Option<View>>,
    idle: Vec<Slot>,
    in_flight: VecDeque<Flight>,
    /// The run whose results were given last; `None` where a frame that came back later did not run.
    located: Option<u32>,
}

/// What a [`HostLocator`] is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostOptions {
    /// What activations are stored in.
    pub precision: Precision,
    /// Images a frame: cameras.
    pub batch: usize,
    /// Size of the mask textures.
    pub mask: MaskSize,
    /// Most frames whose results are on their way to the CPU at the same time.
    pub in_flight: usize,
}

impl Default for HostOptions {
    /// One image a frame in 32-bit floats, masks of the network's size, three frames in flight.
    fn default() -> Self {
        Self {
            precision: Precision::F32,
            batch: 1,
            mask: MaskSize::Network,
            in_flight: 3,
        }
    }
}

/// Size of a mask texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MaskSize {
    /// The network's image, in the canonical camera of the model.
    Network,
    /// The source's texture, or its crop: texel for texel, as it is stored.
    Source,
}

/// A camera's image in a host's textures.
#[derive(Debug, Clone, PartialEq)]
pub struct Source {
    /// The textures.
    pub planes: Planes,
    /// The part to be searched, in texels; all of it where `None`.
    pub crop: Option<Crop>,
    /// What makes that part upright and unmirrored.
    pub orientation: Orientation,
    /// The camera of the upright image. [`Camera::cropped`] and [`Camera::oriented`], in this order, make it
    /// of the sensor's.
    pub camera: Camera,
}

impl Source {
    /// All of an upright image in one texture.
    pub fn new(view: wgpu::TextureView, camera: Camera) -> Self {
        Self {
            planes: Planes::Rgba(view),
            crop: None,
            orientation: Orientation::NoTransforms,
            camera,
        }
    }
}

/// What was found in a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Located {
    /// The number that was given to [`HostLocator::read_back`].
    pub frame: u64,
    /// What was found in each image of the batch; without masks.
    pub estimates: Vec<Estimate>,
}

/// Where a frame's results come back.
#[derive(Debug)]
struct Slot {
    results: wgpu::Buffer,
    /// The cameras of that frame.
    views: Vec<View>,
}

#[derive(Debug)]
struct Flight {
    slot: Slot,
    frame: u64,
    mapping: Mapping,
}

impl HostLocator {
    /// Plans `model`: allocates, compiles and binds everything but what depends on the sources. May be called
    /// from a thread of its own. Drivers that compile when a kernel first runs do so in the first frame, or
    /// in [`HostLocator::warm_up`].
    ///
    /// # Errors
    /// A batch of none, a layer that exceeds the device's limits, or a driver's refusal.
    pub fn new(
        device: Arc<Device>,
        model: &Model,
        options: HostOptions,
    ) -> Result<Self, LocateError> {
        Self::with_progress(device, model, options, &mut |_, _| {})
    }

    /// As [`HostLocator::new`], telling `progress` how many layers of how many are planned.
    ///
    /// # Errors
    /// Those.
    pub fn with_progress(
        device: Arc<Device>,
        model: &Model,
        options: HostOptions,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, LocateError> {
        let HostOptions {
            precision, batch, ..
        } = options;
        let description = model.description.clone();
        let input = description.input;
        let min_sure = description
            .presence
            .min_sure_pixels(input.width * input.height);
        let plan = Box::new(Plan::with_progress(
            &device, model, batch, precision, progress,
        )?);
        let outputs = Outputs::new(&device, &plan, min_sure)?;
        let idle = device.scoped(|| {
            let slot = |_| Slot {
                results: plan.results_buffer(&device),
                views: Vec::with_capacity(batch),
            };
            Ok((0..options.in_flight).map(slot).collect())
        })?;
        Ok(Self {
            device,
            plan,
            outputs,
            description,
            mask: options.mask,
            views: vec![None; batch],
            idle,
            in_flight: VecDeque::with_capacity(options.in_flight),
            located: None,
        })
    }

    /// The model's description.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Searches `source` as image `index` of the frames from the next one on. A camera that changed holds
    /// from the queue's next submission on: between two submissions, encode once.
    ///
    /// With the textures and the camera of the last time this costs next to nothing; other views of the same
    /// kind are bound anew, another camera is worked out anew.
    ///
    /// # Errors
    /// An index beyond the batch; a texture of another format, size or usage than what can be read; a camera
    /// of another size than the image, or that [`Camera::check`] refuses; a crop beyond it; too little memory for a mask
    /// texture of the new size. The former source stays then.
    pub fn set_source(&mut self, index: usize, source: &Source) -> Result<(), LocateError> {
        self.device.check()?;
        let [width, height] = source.planes.size();
        let crop = source.crop.unwrap_or(Crop::whole(width, height));
        let ends = |from: u32, size: u32, side: u32| {
            size > 0 && from.checked_add(size).is_some_and(|end| end <= side)
        };
        if !(ends(crop.x, crop.width, width) && ends(crop.y, crop.height, height)) {
            return Err(LocateError::Crop {
                width,
                height,
                crop,
            });
        }
        let camera = &source.camera;
        let texels = Texels::new(crop, source.orientation);
        let last = self.views.get(index).copied().flatten();
        let size = crop.turned(source.orientation);
        let view = View::of(last, camera, size, texels, &self.description)?;
        // What may fail comes first: then nothing is changed.
        let mask = if last != Some(view) && self.mask == MaskSize::Source {
            let canonical = &self.description.camera;
            let params = Unrectification::new(camera, canonical, crop, source.orientation);
            let (device, plan) = (&self.device, &self.plan);
            let resized = self.outputs.resized_mask(device, plan, index, &params)?;
            Some((params, resized))
        } else {
            None
        };
        self.plan
            .bind(&self.device, index, &source.planes, &view.rectification)?;
        if let Some(place) = self.views.get_mut(index) {
            *place = Some(view);
        }
        if last != Some(view) {
            let max_radius = view.rectification.max_radius;
            self.outputs.set_max_radius(&self.device, index, max_radius);
        }
        if let Some((params, resized)) = mask {
            self.outputs.set_mask(&self.device, index, &params, resized);
        }
        Ok(())
    }

    /// Records a frame: both networks on every image of the batch, the mask textures and the estimates.
    ///
    /// # Errors
    /// An image without a source, and a device that was lost.
    pub fn encode(&self, encoder: &mut wgpu::CommandEncoder) -> Result<(), LocateError> {
        self.device.check()?;
        if let Some(index) = self.views.iter().position(Option::is_none) {
            return Err(LocateError::NoSource { index });
        }
        let steps = self.plan.steps(true).chain(self.outputs.steps());
        self.plan.dispatch(encoder, steps, None);
        self.outputs.copy(encoder);
        Ok(())
    }

    /// The mask of image `index`, a texture of `r8unorm` with the usages `TEXTURE_BINDING` and `COPY_SRC`;
    /// `None` beyond the batch. Another one after [`HostLocator::set_source`] gave it another size, and only then.
    pub fn mask(&self, index: usize) -> Option<&wgpu::TextureView> {
        self.outputs.masks().get(index).map(|mask| mask.view())
    }

    /// The probabilities behind the newest results that [`HostLocator::latest`] or those that wait gave, in full
    /// precision: `[image][row][column]`, of the network's size in the canonical camera of the model. `None` where there
    /// are no results yet, where a frame that was read back after them did not run, and where one ran that was not. Submits
    /// a copy and waits for it: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// As [`Device::wait`].
    pub async fn probabilities_async(&self) -> Result<Option<Vec<f32>>, LocateError> {
        let Some(run) = self.located else {
            return Ok(None);
        };
        Ok(self.plan.masks_of_async(&self.device, run).await?)
    }

    /// What was found, for the host's shaders: `array<Estimate>`, one an image of the batch, in a storage
    /// buffer with the usages `STORAGE` and `COPY_SRC`. [`HostLocator::wgsl`] is its declaration.
    pub fn estimates(&self) -> &wgpu::Buffer {
        self.outputs.estimates()
    }

    /// The WGSL of `struct Estimate` and of the values of its status, to stand in front of a shader that
    /// reads [`HostLocator::estimates`]. An `Estimate` is 16 bytes of status (0 no robot, 1 found, 2
    /// invalid), pixels and sure pixels (`u32`), and for each joint 16 bytes of `x, y, z` in the camera
    /// optical frame, in metres, and 1 where they count.
    pub fn wgsl(&self) -> String {
        estimate_wgsl(self.description.joints.len())
    }

    /// Records that the results of the frame recorded before in `encoder` come back to the CPU, as frame
    /// `frame`. False where as many as [`HostOptions::in_flight`] are on their way already: then this
    /// one's do not.
    ///
    /// # Errors
    /// As [`HostLocator::encode`].
    pub fn read_back(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        frame: u64,
    ) -> Result<bool, LocateError> {
        self.device.check()?;
        if let Some(index) = self.views.iter().position(Option::is_none) {
            return Err(LocateError::NoSource { index });
        }
        let Some(mut slot) = self.idle.pop() else {
            return Ok(false);
        };
        slot.views.clear();
        slot.views.extend(self.views.iter().copied().flatten());
        self.plan.copy_results(encoder, &slot.results);
        let (mapping, callback) = Mapping::new();
        encoder.map_buffer_on_submit(&slot.results, wgpu::MapMode::Read, .., callback);
        self.in_flight.push_back(Flight {
            slot,
            frame,
            mapping,
        });
        Ok(true)
    }

    /// Runs every kernel once, so that the first frame does not wait for a driver that compiles late, and
    /// tells `progress` how many of how many ran. Submits, and waits; the sources should be set.
    ///
    /// # Errors
    /// As [`Device::wait`].
    #[cfg(not(target_arch = "wasm32"))]
    pub fn warm_up(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<(), LocateError> {
        pollster::block_on(self.warm_up_async(progress))
    }

    /// As [`HostLocator::warm_up`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// Those.
    pub async fn warm_up_async(
        &self,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<(), LocateError> {
        self.device.check()?;
        let steps: Vec<&Step> = self.plan.steps(true).chain(self.outputs.steps()).collect();
        for (done, step) in steps.iter().enumerate() {
            progress(done, steps.len());
            let mut encoder = self
                .device
                .wgpu()
                .create_command_encoder(&Default::default());
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            self.device.queue().submit([encoder.finish()]);
            self.device.wait_async().await?;
        }
        progress(steps.len(), steps.len());
        Ok(())
    }

    /// The newest results that arrived since the last call, if any did. A frame that did not run, as its encoder was dropped or
    /// the submission refused, has none. Never waits; polls the device.
    ///
    /// # Errors
    /// A device that was lost: no frame on its way will arrive.
    pub fn latest(&mut self) -> Result<Option<Located>, LocateError> {
        #[cfg(not(target_arch = "wasm32"))]
        self.device.poll(wgpu::PollType::Poll)?;
        #[cfg(target_arch = "wasm32")]
        self.device.check()?;
        let (mut newest, mut failure) = (None, None);
        for _ in 0..self.in_flight.len() {
            let Some(mut flight) = self.in_flight.pop_front() else {
                break;
            };
            let state = flight.mapping.state();
            if state == Mapped::Pending {
                self.in_flight.push_back(flight);
                continue;
            }
            let Flight { slot, frame, .. } = flight;
            let frames = match state {
                Mapped::Ready => mapped(&slot.results, |bytes| self.plan.frames_in(bytes)),
                Mapped::Failed => {
                    let lost = "a frame's results will not arrive".to_owned();
                    Err(GpuError::Lost(lost))
                }
                // Its encoder was dropped.
                Mapped::Never | Mapped::Pending => Ok(None),
            };
            match frames {
                Ok(Some(frames)) => {
                    self.located = Some(self.plan.last_run());
                    let estimates = frames.into_iter().zip(&slot.views);
                    let estimates = estimates.map(|(frame, view)| {
                        Estimate::new(&self.description, frame, view, Output::default())
                    });
                    newest = Some(Located {
                        frame,
                        estimates: estimates.collect(),
                    });
                }
                Ok(None) if state == Mapped::Ready => self.located = None,
                Ok(None) => {}
                Err(error) => failure = Some(error),
            }
            self.idle.push(slot);
        }
        if let Some(failure) = failure {
            return Err(failure.into());
        }
        Ok(newest)
    }

    /// Waits until results arrive, at most for `timeout`: the newest. `None` where none are on their way.
    ///
    /// # Errors
    /// As [`HostLocator::latest`], and [`GpuError::Timeout`].
    #[cfg(not(target_arch = "wasm32"))]
    pub fn wait(&mut self, timeout: std::time::Duration) -> Result<Option<Located>, LocateError> {
        let start = std::time::Instant::now();
        loop {
            let newest = self.latest()?;
            if newest.is_some() || self.in_flight.is_empty() {
                return Ok(newest);
            }
            if start.elapsed() > timeout {
                return Err(GpuError::Timeout(timeout).into());
            }
            std::thread::sleep(std::time::Duration::from_micros(100));
        }
    }

    /// Results as soon as they arrive, for any executor: the newest. `None` where none are on their way. Not
    /// in a browser, a thread polls the device while this is pending.
    ///
    /// # Errors
    /// As [`HostLocator::latest`]; not in a browser, [`GpuError::Timeout`] after [`Device::TIMEOUT`].
    pub async fn next(&mut self) -> Result<Option<Located>, LocateError> {
        loop {
            let newest = self.latest()?;
            if newest.is_some() || self.in_flight.is_empty() {
                return Ok(newest);
            }
            let in_flight = &mut self.in_flight;
            #[cfg(not(target_arch = "wasm32"))]
            let mut poller = poller::Poller::new(&self.device);
            let arrival: Result<(), GpuError> = std::future::poll_fn(|context| {
                // Hosts submit in any order, or not at all; each must know whom to wake.
                let mut arrived = Poll::Pending;
                for flight in in_flight.iter_mut() {
                    if flight.mapping.poll_arrival(context).is_ready() {
                        arrived = Poll::Ready(Ok(()));
                    }
                }
                #[cfg(not(target_arch = "wasm32"))]
                if arrived.is_pending() {
                    return poller.poll_failure(context).map(Err);
                }
                arrived
            })
            .await;
            arrival?;
        }
    }
}

/// Polls a device in a thread: who awaits its work has nobody else to do it.
#[cfg(not(target_arch = "wasm32"))]
mod poller {
    use std::pin::Pin;
    use std::sync::Arc;
    use std::task::{Context, Poll};
    use std::time::{Duration, Instant};

    use futures_channel::oneshot;

    use crate::gpu::{Device, GpuError};

    /// The thread ends with it.
    pub struct Poller {
        device: Arc<Device>,
        failure: oneshot::Receiver<GpuError>,
    }

    impl Poller {
        pub fn new(device: &Arc<Device>) -> Self {
            let (sender, failure) = oneshot::channel();
            let poller = Self {
                device: Arc::clone(device),
                failure,
            };
            let device = Arc::clone(device);
            std::thread::spawn(move || {
                let start = Instant::now();
                while !sender.is_canceled() {
                    let late = start.elapsed() > Device::TIMEOUT;
                    let failure = device.poll(wgpu::PollType::Poll).err();
                    let failure = failure.or(late.then_some(GpuError::Timeout(Device::TIMEOUT)));
                    if let Some(failure) = failure {
                        // Nobody may be waiting any more.
                        let _ = sender.send(failure);
                        return;
                    }
                    std::thread::sleep(Duration::from_micros(200));
                }
            });
            poller
        }

        /// Ready when the device is lost, or time is up.
        pub fn poll_failure(&mut self, context: &mut Context<'_>) -> Poll<GpuError> {
            let ended = || GpuError::Lost("the thread that polls it ended".into());
            Pin::new(&mut self.failure).poll(context).map(|failure| {
                failure.unwrap_or_else(|_| self.device.check().err().unwrap_or_else(ended))
            })
        }
    }
}
