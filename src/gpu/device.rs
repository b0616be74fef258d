use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use super::adapter::{self, AdapterRequest, Choice};
use super::tuner::Tuner;
use super::{GpuError, Layout, Precision, Tier};

/// A wgpu device and queue of our own, whose errors come back as values.
///
/// It installs its own handler for errors that no scope catches, and for the loss of the device:
/// both are kept and given to the next caller of [`Device::check`].
pub struct Device {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    tier: Tier,
    halves: bool,
    tuner: Tuner,
    choice: Choice,
    fault: Arc<Mutex<Option<GpuError>>>,
    pipelines: Mutex<HashMap<PipelineKey, wgpu::ComputePipeline>>,
    _instance: wgpu::Instance,
}

/// A kernel's text, its entry point, and the bits of its constants.
type PipelineKey = (String, String, Vec<(String, u64)>);

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
    pub const TUNING: Duration = Duration::from_secs(2);

    /// What is asked for where the adapter has it.
    const FEATURES: wgpu::Features = wgpu::Features::SUBGROUP
        .union(wgpu::Features::TIMESTAMP_QUERY)
        .union(wgpu::Features::SHADER_F16);

    /// Opens the adapter that `request` leads to.
    ///
    /// # Errors
    /// No adapter, an unknown one, or one that gives no device.
    pub fn open(request: &AdapterRequest) -> Result<Self, GpuError> {
        let (instance, adapter, choice) = adapter::open(request)?;
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
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("whereabot"),
            required_features: features,
            experimental_features: experimental,
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
            tier,
            halves: adapter
                .get_downlevel_capabilities()
                .flags
                .contains(wgpu::DownlevelFlags::SHADER_F16_IN_F32),
            tuner: Tuner::default(),
            device,
            queue,
            info,
            choice,
            fault,
            pipelines: Mutex::default(),
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

    /// Why this adapter was chosen.
    pub fn choice(&self) -> &Choice {
        &self.choice
    }

    /// Lets plans find the fastest kernels for their layers by timing them, which takes `limit`, all plans
    /// together, and at most one kernel's compilation and timing more. `memory` is what [`Device::tuning`] gave in an earlier process; what is of
    /// another adapter, driver or version of this library, or no such thing at all, is passed over.
    #[must_use]
    pub fn tuned(mut self, limit: Duration, memory: &[u8]) -> Self {
        self.tuner = Tuner::new(limit, &self.info, memory);
        self
    }

    /// What was found to be the fastest, to be remembered for [`Device::tuned`]; `None` where nothing new
    /// was found since the last call.
    pub fn tuning(&self) -> Option<Vec<u8>> {
        self.tuner.memory(&self.info)
    }

    pub(super) fn tuner(&self) -> &Tuner {
        &self.tuner
    }

    /// The pipeline of a kernel, made once for each text and set of constants: compiling is dear, and
    /// many layers differ by what they bind only. Driver errors reach the caller's
    /// [`Device::scoped`].
    pub(super) fn pipeline(
        &self,
        label: &str,
        text: String,
        entry_point: &str,
        constants: &[(&str, f64)],
    ) -> wgpu::ComputePipeline {
        let bits = constants
            .iter()
            .map(|(name, value)| ((*name).to_owned(), value.to_bits()))
            .collect();
        let key = (text, entry_point.to_owned(), bits);
        let mut pipelines = self
            .pipelines
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if let Some(pipeline) = pipelines.get(&key) {
            return pipeline.clone();
        }
        let module = self
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(label),
                source: wgpu::ShaderSource::Wgsl(key.0.as_str().into()),
            });
        let pipeline = self
            .device
            .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(label),
                layout: None,
                module: &module,
                entry_point: Some(entry_point),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants,
                    ..Default::default()
                },
                cache: None,
            });
        pipelines.insert(key, pipeline.clone());
        pipeline
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
