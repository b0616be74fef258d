use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use super::adapter::{self, AdapterRequest, Choice};
use super::{GpuError, Tier};

/// A wgpu device and queue of our own, whose errors come back as values.
///
/// It installs its own handler for errors that no scope catches, and for the loss of the device:
/// both are kept and given to the next caller of [`Device::check`].
pub struct Device {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    tier: Tier,
    choice: Choice,
    fault: Arc<Mutex<Option<GpuError>>>,
    _instance: wgpu::Instance,
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

    /// What is asked for where the adapter has it.
    const FEATURES: wgpu::Features = wgpu::Features::TIMESTAMP_QUERY;

    /// Opens the adapter that `request` leads to.
    ///
    /// # Errors
    /// No adapter, an unknown one, or one that gives no device.
    pub fn open(request: &AdapterRequest) -> Result<Self, GpuError> {
        let (instance, adapter, choice) = adapter::open(request)?;
        let info = adapter.get_info();
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("whereabot"),
            required_features: adapter.features() & Self::FEATURES,
            required_limits: adapter.limits(),
            ..Default::default()
        }))
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
        Ok(Self {
            tier: Tier::of(adapter.features()),
            device,
            queue,
            info,
            choice,
            fault,
            _instance: instance,
        })
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

    /// Why this adapter was chosen.
    pub fn choice(&self) -> &Choice {
        &self.choice
    }

    /// Gives the first fault that happened since the device was opened.
    ///
    /// # Errors
    /// That fault. A device that had one answers it for ever: what it computed since is no result.
    pub fn check(&self) -> Result<(), GpuError> {
        match &*self.fault.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error.clone()),
            None => Ok(()),
        }
    }

    /// Runs `make`, which creates resources, and gives what the driver said about it.
    ///
    /// # Errors
    /// What `make` answers, validation failures, and too little memory.
    pub fn scoped<T>(&self, make: impl FnOnce() -> Result<T, GpuError>) -> Result<T, GpuError> {
        self.check()?;
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let validation = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let made = make();
        let errors = [validation.pop(), memory.pop()].map(pollster::block_on);
        if let Some(error) = errors.into_iter().flatten().next() {
            return Err(convert(error));
        }
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
    pub fn wait(&self) -> Result<(), GpuError> {
        let polled = self.device.poll(wgpu::PollType::Wait {
            submission_index: None,
            timeout: Some(Self::TIMEOUT),
        });
        self.check()?;
        match polled {
            Ok(_) => Ok(()),
            Err(wgpu::PollError::Timeout) => Err(GpuError::Timeout(Self::TIMEOUT)),
            Err(other) => Err(GpuError::Lost(other.to_string())),
        }
    }

    /// Maps `buffer`, gives its bytes to `read`, and unmaps it. Waits for what was submitted before.
    ///
    /// # Errors
    /// As [`Device::wait`], and whatever keeps the buffer from being mapped.
    pub fn read<T>(
        &self,
        buffer: &wgpu::Buffer,
        read: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, GpuError> {
        let (sender, receiver) = mpsc::channel();
        buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            // The receiver is gone only where the wait failed, and then nobody listens.
            let _ = sender.send(result);
        });
        self.wait()?;
        // Where threads share the device, another one's wait may be the one that runs the callback.
        match receiver.recv_timeout(Self::TIMEOUT) {
            Ok(Ok(())) => {}
            Ok(Err(e)) => return Err(GpuError::Lost(e.to_string())),
            Err(_) => return Err(GpuError::Timeout(Self::TIMEOUT)),
        }
        let view = buffer
            .get_mapped_range(..)
            .map_err(|e| GpuError::Validation(e.to_string()))?;
        let value = read(&view);
        drop(view);
        buffer.unmap();
        Ok(value)
    }
}

fn convert(error: wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(source.to_string()),
        wgpu::Error::Validation { description, .. } => GpuError::Validation(description),
        wgpu::Error::Internal { description, .. } => GpuError::Lost(description),
    }
}
