use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::adapter::{self, AdapterRequest, Choice};
use super::loss::Loss;
use super::mapping::Mapping;
use super::pipelines::{Checks, Pipelines};
#[cfg(not(target_arch = "wasm32"))]
use super::tuner::Tuner;
use super::{GpuError, Layout, Precision, Tier};

/// A wgpu device and queue, whose errors come back as values.
///
/// One of our own ([`Device::open`]) has our handlers for errors that no scope catches and for the loss
/// of the device: both are kept and given to the next caller of [`Device::check`]. A host's
/// ([`Device::from_host`]) keeps the host's handlers; its loss is found out by asking.
pub struct Device {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    tier: Tier,
    halves: bool,
    #[cfg(not(target_arch = "wasm32"))]
    tuner: Tuner,
    choice: Option<Choice>,
    fault: Arc<Mutex<Option<GpuError>>>,
    /// For a host's device.
    loss: Option<Loss>,
    pipelines: Pipelines,
}

impl fmt::Debug for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Device")
            .field("adapter", &self.info.name)
            .field("backend", &self.info.backend)
            .field("tier", &self.tier)
            .finish_non_exhaustive()
    }
}

impl Device {
    /// The longest that any call waits for the GPU. The first frame on a CPU rasteriser compiles
    /// every kernel, which takes seconds.
    pub const TIMEOUT: Duration = Duration::from_secs(60);

    /// What commands spend on [`Device::tuned`].
    pub const TUNING: Duration = Duration::from_secs(5);

    /// What is asked for where the adapter has it.
    const FEATURES: wgpu::Features = wgpu::Features::SUBGROUP
        .union(wgpu::Features::TIMESTAMP_QUERY)
        .union(wgpu::Features::PIPELINE_CACHE)
        .union(wgpu::Features::SHADER_F16);

    /// Opens the adapter that `request` leads to.
    ///
    /// # Errors
    /// No adapter, an unknown one, or one that gives no device.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn open(request: &AdapterRequest) -> Result<Self, GpuError> {
        pollster::block_on(Self::open_async(request))
    }

    /// Opens the adapter that `request` leads to; in a browser, the one that it offers.
    ///
    /// # Errors
    /// No adapter, an unknown one, or one that gives no device.
    pub async fn open_async(request: &AdapterRequest) -> Result<Self, GpuError> {
        let (adapter, choice) = adapter::open(request).await?;
        let info = adapter.get_info();
        let tier = Tier::of(&adapter);
        let mut features = adapter.features() & Self::FEATURES;
        let mut experimental = wgpu::ExperimentalFeatures::disabled();
        if tier == Tier::CooperativeMatrix {
            features |= wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX;
            // SAFETY: this says that wgpu may have bugs in what is experimental. A kernel that uses it is
            // chosen only where its answers were found to be right.
            #[allow(unsafe_code)]
            {
                experimental = unsafe { wgpu::ExperimentalFeatures::enabled() };
            }
        }
        let (device, queue) = adapter
            .request_device(&wgpu::DeviceDescriptor {
                label: Some("whereabot"),
                required_features: features,
                experimental_features: experimental,
                required_limits: adapter.limits(),
                ..Default::default()
            })
            .await
            .map_err(|e| GpuError::Request {
                adapter: info.name.clone(),
                reason: e.to_string(),
            })?;
        let fault = Arc::new(Mutex::new(None));
        let keep = |fault: &Arc<Mutex<Option<GpuError>>>| {
            let fault = Arc::clone(fault);
            // The first fault is the cause; later ones are its consequences.
            move |error: GpuError| {
                fault
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .get_or_insert(error);
            }
        };
        let uncaptured = keep(&fault);
        device.on_uncaptured_error(Arc::new(move |error| uncaptured(convert(error))));
        let lost = keep(&fault);
        device.set_device_lost_callback(move |reason, message| {
            lost(GpuError::Lost(format!("{reason:?}: {message}")));
        });
        let pipelines = Pipelines::new(&device);
        Ok(Self {
            tier,
            halves: adapter
                .get_downlevel_capabilities()
                .flags
                .contains(wgpu::DownlevelFlags::SHADER_F16_IN_F32),
            #[cfg(not(target_arch = "wasm32"))]
            tuner: Tuner::default(),
            device,
            queue,
            info,
            choice: Some(choice),
            fault,
            loss: None,
            pipelines,
        })
    }

    /// Uses a host's device and queue, with whatever features and limits the host enabled; WebGPU's
    /// defaults are enough. The host's error handlers, and error scopes that it has open, see nothing of
    /// it; nothing is submitted but by calls that say so. In a browser errors come later, and to the host's handlers
    /// alone: after one, what was computed is no result.
    ///
    /// # Errors
    /// [`GpuError::Limit`] where the device has less than WebGPU's defaults of what every kernel needs, and
    /// [`GpuError::Lost`].
    pub fn from_host(device: wgpu::Device, queue: wgpu::Queue) -> Result<Self, GpuError> {
        let host = Self {
            tier: Tier::with(device.features()),
            halves: true,
            #[cfg(not(target_arch = "wasm32"))]
            tuner: Tuner::default(),
            info: device.adapter_info(),
            choice: None,
            fault: Arc::default(),
            loss: Some(Loss::new(&device)),
            pipelines: Pipelines::new(&device),
            device,
            queue,
        };
        #[cfg(not(target_arch = "wasm32"))]
        {
            // A device that was lost before made a buffer that is not valid: of that the host's handler would
            // hear.
            let scope = host.device.push_error_scope(wgpu::ErrorFilter::Validation);
            let checked = host.check();
            let refused = pollster::block_on(scope.pop());
            checked?;
            if let Some(error) = refused {
                return Err(convert(error));
            }
        }
        let limits = host.device.limits();
        for (what, needed, allowed) in adapter::needs(&limits) {
            host.require(what, needed.into(), allowed.into())?;
        }
        Ok(host)
    }

    /// The device itself.
    pub fn wgpu(&self) -> &wgpu::Device {
        &self.device
    }

    /// Its queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// The adapter's name, backend and driver.
    pub fn info(&self) -> &wgpu::AdapterInfo {
        &self.info
    }

    /// What its kernels can use.
    pub fn tier(&self) -> Tier {
        self.tier
    }

    /// How tensors of `precision` lie in its memory.
    ///
    /// # Errors
    /// [`GpuError::Precision`] where it cannot store 16-bit floats.
    pub fn layout(&self, precision: Precision) -> Result<Layout, GpuError> {
        match precision {
            Precision::F16 if !self.halves => Err(GpuError::Precision {
                adapter: self.info.name.clone(),
            }),
            Precision::F16 => Ok(Layout::HalfBuffer),
            Precision::F32 => Ok(Layout::of(&self.info)),
        }
    }

    /// Invocations in its smallest subgroups; `None` where kernels cannot use subgroups.
    pub fn subgroup_size(&self) -> Option<u32> {
        let usable = self.device.features().contains(wgpu::Features::SUBGROUP);
        usable.then_some(self.info.subgroup_min_size)
    }

    /// Why this adapter was chosen; `None` where a host did.
    pub fn choice(&self) -> Option<&Choice> {
        self.choice.as_ref()
    }

    /// Lets plans find the fastest kernels for their layers by timing them, which takes `limit`, all plans
    /// together, and for the last layer one kernel's compilation and a few rounds of timing more. `memory` is what
    /// [`Device::tuning`] gave in an earlier process; what is of another adapter, driver or version of this library, or no
    /// such thing at all, is passed over.
    #[cfg(not(target_arch = "wasm32"))]
    #[must_use]
    pub fn tuned(mut self, limit: Duration, memory: &[u8]) -> Self {
        self.tuner = Tuner::new(limit, &self.info, memory);
        self
    }

    /// What was found to be the fastest, to be remembered for [`Device::tuned`]; `None` where nothing new
    /// was found since the last call.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn tuning(&self) -> Option<Vec<u8>> {
        self.tuner.memory(&self.info)
    }

    /// Lets the driver take compiled kernels from `memory`, what [`Device::pipeline_cache`] gave in an earlier
    /// process; what is of another adapter, driver or version, damaged, or no such thing at all, is passed
    /// over. Without effect where the backend has no such cache, or a host did not enable
    /// `PIPELINE_CACHE`.
    ///
    /// # Safety
    /// `memory` comes from where nobody puts what was made to look like a cache: the checksum tells damage, not intent,
    /// and a driver may run what it finds.
    #[must_use]
    #[allow(unsafe_code)]
    pub unsafe fn with_pipeline_cache(mut self, memory: &[u8]) -> Self {
        // SAFETY: the caller answers for `memory`.
        self.pipelines = unsafe { Pipelines::with(&self.device, memory) };
        self
    }

    /// What the driver compiled, to be remembered for [`Device::with_pipeline_cache`]; `None` where the
    /// backend has no such cache.
    pub fn pipeline_cache(&self) -> Option<Vec<u8>> {
        self.pipelines.memory()
    }

    #[cfg(not(target_arch = "wasm32"))]
    pub(super) fn tuner(&self) -> &Tuner {
        &self.tuner
    }

    /// The pipeline of a kernel.
    ///
    /// # Errors
    /// A kernel that the driver does not compile, or too little memory.
    pub(super) fn pipeline(
        &self,
        label: &str,
        text: String,
        entry_point: &str,
        constants: &[(&str, f64)],
        checks: Checks,
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        self.pipelines
            .get(self, label, text, entry_point, constants, checks)
    }

    /// Gives the first fault that happened since the device was opened.
    ///
    /// # Errors
    /// That fault. A device that had one answers it for ever: what it computed since is no result.
    pub fn check(&self) -> Result<(), GpuError> {
        let mut fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        if fault.is_none() && self.loss.as_ref().is_some_and(Loss::happened) {
            *fault = Some(GpuError::Lost(
                "the host's device is no longer valid".into(),
            ));
        }
        match &*fault {
            Some(error) => Err(error.clone()),
            None => Ok(()),
        }
    }

    /// Runs `make`, which creates resources, and gives what the driver said about it.
    ///
    /// # Errors
    /// What `make` answers, too little memory, a kernel that the driver does not compile, and validation failures.
    pub fn scoped<T>(&self, make: impl FnOnce() -> Result<T, GpuError>) -> Result<T, GpuError> {
        self.check()?;
        // A browser says what it thinks of calls later: of our own device to its handler.
        #[cfg(target_arch = "wasm32")]
        let made = make();
        #[cfg(not(target_arch = "wasm32"))]
        let made = {
            let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
            let internal = self.device.push_error_scope(wgpu::ErrorFilter::Internal);
            let validation = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
            let made = make();
            let [validation, internal, memory] =
                [validation.pop(), internal.pop(), memory.pop()].map(pollster::block_on);
            // What could not be made is not valid either: that is the consequence.
            if let Some(error) = memory.or(internal).or(validation) {
                return Err(convert(error));
            }
            made
        };
        self.check()?;
        made
    }

    /// Checks a size against what the adapter allows.
    ///
    /// # Errors
    /// [`GpuError::Limit`], naming `what`.
    pub fn require(&self, what: &str, needed: u64, allowed: u64) -> Result<(), GpuError> {
        if needed <= allowed {
            return Ok(());
        }
        Err(GpuError::Limit {
            what: what.into(),
            needed,
            allowed,
            adapter: self.info.name.clone(),
        })
    }

    /// Waits until everything submitted so far is done.
    ///
    /// # Errors
    /// [`GpuError::Timeout`] after [`Device::TIMEOUT`], and any fault of the device.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn wait(&self) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::Wait {
            submission_index: None,
            timeout: Some(Self::TIMEOUT),
        })
    }

    /// Polls the device, or waits for it. A callback of somebody's that panics goes on panicking.
    ///
    /// # Errors
    /// As [`Device::wait`].
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn poll(&self, poll: wgpu::PollType) -> Result<(), GpuError> {
        self.survive(|| self.device.poll(poll))
    }

    /// wgpu panics where the driver says to whoever polls that the device is lost.
    #[cfg(not(target_arch = "wasm32"))]
    fn survive(
        &self,
        poll: impl FnOnce() -> Result<wgpu::PollStatus, wgpu::PollError>,
    ) -> Result<(), GpuError> {
        self.check()?;
        let polled = std::panic::catch_unwind(std::panic::AssertUnwindSafe(poll));
        self.check()?;
        match polled {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(wgpu::PollError::Timeout)) => Err(GpuError::Timeout(Self::TIMEOUT)),
            Ok(Err(other)) => Err(GpuError::Lost(other.to_string())),
            Err(panic) if is_fatal(&*panic) => Err(GpuError::Lost("polling it panicked".into())),
            // The device is sound: a callback panicked, that of a host perhaps.
            Err(panic) => std::panic::resume_unwind(panic),
        }
    }

    /// As [`Device::wait`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// Those.
    pub async fn wait_async(&self) -> Result<(), GpuError> {
        #[cfg(not(target_arch = "wasm32"))]
        return self.wait();
        #[cfg(target_arch = "wasm32")]
        {
            let (mapping, callback) = Mapping::new();
            self.queue.on_submitted_work_done(move || callback(Ok(())));
            mapping.finish(self).await?;
            self.check()
        }
    }

    /// Maps `buffer`, gives its bytes to `read`, and unmaps it. Waits for what was submitted before.
    ///
    /// # Errors
    /// As [`Device::wait`], and whatever keeps the buffer from being mapped.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn read<T>(
        &self,
        buffer: &wgpu::Buffer,
        read: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, GpuError> {
        pollster::block_on(self.read_async(buffer, read))
    }

    /// As [`Device::read`]: in a browser without blocking, elsewhere blocking all the same. May be dropped before it is done.
    ///
    /// # Errors
    /// Those.
    pub async fn read_async<T>(
        &self,
        buffer: &wgpu::Buffer,
        read: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, GpuError> {
        let (mapping, callback) = Mapping::new();
        buffer.map_async(wgpu::MapMode::Read, .., callback);
        let pending = Pending(buffer);
        let done = async {
            #[cfg(not(target_arch = "wasm32"))]
            self.wait()?;
            mapping.finish(self).await?;
            // A browser tells by now what it refused before: what then was mapped is no result.
            self.check()
        };
        let done = done.await;
        if !matches!(done, Err(GpuError::Timeout(_))) {
            std::mem::forget(pending);
        }
        done?;
        mapped(buffer, read)
    }
}

/// Whether it is what wgpu says of a poll that failed.
#[cfg(not(target_arch = "wasm32"))]
fn is_fatal(panic: &(dyn std::any::Any + Send)) -> bool {
    let message = panic.downcast_ref::<String>();
    message.is_some_and(|message| message.starts_with("Error in Device::poll"))
}

/// A buffer that is to be mapped, for somebody who may stop waiting: it would be mapped later, and what is written to it
/// then be refused.
struct Pending<'a>(&'a wgpu::Buffer);

impl Drop for Pending<'_> {
    fn drop(&mut self) {
        self.0.unmap();
    }
}

/// Gives the bytes of a mapped `buffer` to `read`, and unmaps it.
pub(crate) fn mapped<T>(
    buffer: &wgpu::Buffer,
    read: impl FnOnce(&[u8]) -> T,
) -> Result<T, GpuError> {
    let view = buffer
        .get_mapped_range(..)
        .map_err(|e| GpuError::Validation(e.to_string()))?;
    let value = read(&view);
    drop(view);
    buffer.unmap();
    Ok(value)
}

fn convert(error: wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(source.to_string()),
        wgpu::Error::Validation { description, .. } => GpuError::Validation(description),
        wgpu::Error::Internal { description, .. } => GpuError::Driver(description),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_that_makes_wgpu_panic_is_an_error() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let is_lost = |result| matches!(result, Err(GpuError::Lost(_)));
        // Negative control: a sound device is polled.
        device
            .survive(|| device.device.poll(wgpu::PollType::Poll))
            .unwrap();
        // As wgpu does it: it tells the loss, then it panics.
        let operation = "Device::poll".to_owned();
        let panic = || panic!("Error in {operation}: Parent device is lost");
        let fatal = || {
            device.device.destroy();
            let _ = device.device.poll(wgpu::PollType::Poll);
            panic()
        };
        assert!(is_lost(device.survive(fatal)));
        // A device that is known to be lost is not polled again.
        let mut polled = false;
        let again = device.survive(|| {
            polled = true;
            device.device.poll(wgpu::PollType::Poll)
        });
        assert!(is_lost(again) && !polled);
        // Where the loss was not told, the panic tells.
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        assert!(is_lost(device.survive(panic)));
    }

    #[test]
    fn a_callback_that_panics_is_no_loss() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        // Submitting calls back, too.
        device.queue.submit([]);
        device.queue.on_submitted_work_done(|| panic!("a host's"));
        let wait = std::panic::AssertUnwindSafe(|| device.wait());
        let panic = std::panic::catch_unwind(wait).unwrap_err();
        assert_eq!(panic.downcast_ref(), Some(&"a host's"));
        // The device goes on.
        device.wait().unwrap();
    }

    #[test]
    fn a_buffer_that_nobody_waits_for_is_written_again() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let buffer = super::super::tensor::staging_buffer(&device, 1 << 16);
        let submit = || {
            let mut encoder = device.device.create_command_encoder(&Default::default());
            encoder.clear_buffer(&buffer, 0, None);
            device.queue.submit([encoder.finish()]);
        };
        let map = || buffer.map_async(wgpu::MapMode::Read, .., |_| ());
        for done in [false, true] {
            submit();
            map();
            let pending = Pending(&buffer);
            if done {
                device.wait().unwrap();
            }
            drop(pending);
        }
        submit();
        device.read(&buffer, |_| ()).unwrap();
        // Negative control: one that is still to be mapped.
        map();
        submit();
        assert!(matches!(device.check(), Err(GpuError::Validation(_))));
    }
}
