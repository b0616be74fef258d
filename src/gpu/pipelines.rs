use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Mutex, PoisonError};

use super::{Device, GpuError};

/// The pipelines of a device, made once for each text and set of constants: compiling is dear, and many
/// layers differ by what they bind only.
#[derive(Default)]
pub(super) struct Pipelines {
    made: Mutex<HashMap<Key, wgpu::ComputePipeline>>,
    /// The driver's own, where the backend has one.
    cache: Option<wgpu::PipelineCache>,
}

/// A kernel's text, its entry point, the bits of its constants, and whether it is checked.
type Key = (String, String, Vec<(String, u64)>, Checks);

/// What wgpu adds to a kernel so that none reaches beyond its memory, reads workgroup memory that nobody wrote,
/// divides by zero or runs for ever. In the inner loops of a GPU it costs much.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Checks {
    /// Kept: where a kernel leans on them, or gains nothing.
    Kept,
    /// Left out: the kernel does nothing of the kind.
    Left,
}

impl Pipelines {
    /// Without what was remembered.
    pub fn new(device: &wgpu::Device) -> Self {
        // SAFETY: nobody made that.
        #[allow(unsafe_code)]
        unsafe {
            Self::with(device, &[])
        }
    }

    /// With what [`Self::memory`] gave in an earlier process; what is foreign or damaged is passed over.
    ///
    /// # Safety
    /// That of [`Device::with_pipeline_cache`].
    #[allow(unsafe_code)]
    pub unsafe fn with(device: &wgpu::Device, memory: &[u8]) -> Self {
        if !device.features().contains(wgpu::Features::PIPELINE_CACHE) {
            return Self::default();
        }
        let data = memory
            .split_first_chunk()
            .and_then(|(sum, data)| (u64::from_le_bytes(*sum) == checksum(data)).then_some(data));
        // SAFETY: the data is what wgpu gave: nobody made it up, by our own contract, a checksum says that it is whole, and
        // wgpu itself passes over what is of another adapter, driver or version.
        let cache = unsafe {
            device.create_pipeline_cache(&wgpu::PipelineCacheDescriptor {
                label: Some("whereabot"),
                data,
                fallback: true,
            })
        };
        Self {
            made: Mutex::default(),
            cache: Some(cache),
        }
    }

    /// What to remember.
    pub fn memory(&self) -> Option<Vec<u8>> {
        let data = self.cache.as_ref()?.get_data()?;
        let mut memory = checksum(&data).to_le_bytes().to_vec();
        memory.extend(data);
        Some(memory)
    }

    /// The pipeline of a kernel.
    ///
    /// # Errors
    /// A kernel that the driver does not compile, or too little memory: it is not kept then.
    pub fn get(
        &self,
        device: &Device,
        label: &str,
        text: String,
        entry_point: &str,
        constants: &[(&str, f64)],
        checks: Checks,
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        let bits = constants
            .iter()
            .map(|(name, value)| ((*name).to_owned(), value.to_bits()))
            .collect();
        let key = (text, entry_point.to_owned(), bits, checks);
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(pipeline) = made.get(&key) {
            return Ok(pipeline.clone());
        }
        let pipeline = device.scoped(|| {
            let (text, entry_point, _, checks) = &key;
            Ok(self.make(device.wgpu(), label, text, entry_point, constants, *checks))
        })?;
        made.insert(key, pipeline.clone());
        Ok(pipeline)
    }

    fn make(
        &self,
        device: &wgpu::Device,
        label: &str,
        text: &str,
        entry_point: &str,
        constants: &[(&str, f64)],
        checks: Checks,
    ) -> wgpu::ComputePipeline {
        let source = wgpu::ShaderModuleDescriptor {
            label: Some(label),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        };
        let module = match checks {
            Checks::Kept => device.create_shader_module(source),
            // SAFETY: only this library's own kernels come here, by `Step::trusted`, whose callers answer for what
            // the checks are for; where they lie in buffers, Vulkan and Direct3D keep them there all the same.
            #[allow(unsafe_code)]
            Checks::Left => unsafe {
                let unchecked = wgpu::ShaderRuntimeChecks::unchecked();
                device.create_shader_module_trusted(source, unchecked)
            },
        };
        device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module: &module,
            entry_point: Some(entry_point),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                zero_initialize_workgroup_memory: checks == Checks::Kept,
            },
            cache: self.cache.as_ref(),
        })
    }
}

/// Of what may have been damaged on a disk.
fn checksum(data: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    data.hash(&mut hasher);
    hasher.finish()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gpu::AdapterRequest;

    #[test]
    fn what_was_not_compiled_is_not_kept() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let pipelines = Pipelines::default();
        let get = |text: &str| {
            let made = pipelines.get(&device, "kernel", text.into(), "main", &[], Checks::Kept);
            made.map_err(|error| error.to_string())
        };
        let wrong = "@compute @workgroup_size(1) fn main() { nothing(); }";
        let first = get(wrong).unwrap_err();
        assert!(first.contains("nothing"), "{first}");
        // The next one who asks is told the same.
        assert_eq!(get(wrong).unwrap_err(), first);
        // Negative control: what was compiled is kept.
        let right = "@compute @workgroup_size(1) fn main() {}";
        assert_eq!(get(right).unwrap(), get(right).unwrap());
    }
}
