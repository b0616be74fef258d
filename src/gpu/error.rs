use std::sync::Arc;
use std::time::Duration;

use crate::network::NetworkError;

/// What can go wrong on a GPU.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No adapter can run compute shaders here.
    #[error("no adapter found that runs compute shaders (backends searched: {backends})")]
    NoAdapter {
        /// The backends that were searched.
        backends: String,
    },
    /// The adapter asked for does not exist.
    #[error(
        "unknown adapter `{wanted}` ({origin}); there are: {}",
        list(available)
    )]
    UnknownAdapter {
        /// What was asked for.
        wanted: String,
        /// Who asked: the flag or the environment variable.
        origin: &'static str,
        /// What there is, as `index: name (backend)`.
        available: Vec<String>,
    },
    /// The backend asked for does not exist.
    #[error("unknown backend `{wanted}` ({origin}); there are: vulkan, metal, dx12, gl")]
    UnknownBackend {
        /// What was asked for.
        wanted: String,
        /// Who asked: the flag or the environment variable.
        origin: &'static str,
    },
    /// The adapter gave no device.
    #[error("adapter `{adapter}` gave no device: {reason}")]
    Request {
        /// The adapter's name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
    /// The adapter is too small for the work.
    #[error("{what}: needs {needed}, but adapter `{adapter}` allows {allowed}")]
    Limit {
        /// The layer or image, and the quantity.
        what: String,
        /// How much is needed.
        needed: u64,
        /// How much there is.
        allowed: u64,
        /// The adapter's name.
        adapter: String,
    },
    /// The adapter's kernels cannot read and write 16-bit floats.
    #[error("adapter `{adapter}` cannot store activations in f16; there is f32")]
    Precision {
        /// The adapter's name.
        adapter: String,
    },
    /// A network that cannot be planned.
    #[error("{0}")]
    Network(Arc<NetworkError>),
    /// A kernel that was asked for does not serve a layer, or not on this adapter.
    #[error("{layer}: `{wanted}` does not serve this layer here")]
    Kernel {
        /// Network and layer.
        layer: String,
        /// The kernel's name.
        wanted: String,
    },
    /// The data does not have the size that the plan was made for.
    #[error("{what}: expected {expected} values, found {found}")]
    Size {
        /// Which data.
        what: &'static str,
        /// What the plan was made for.
        expected: usize,
        /// What was given.
        found: usize,
    },
    /// A plan for none.
    #[error("{what}: expected at least 1, found 0")]
    Zero {
        /// Of which there are none.
        what: &'static str,
    },
    /// A host's texture that cannot be read.
    #[error("{what}: expected {expected}, found {found}")]
    Source {
        /// Which texture, and what about it.
        what: &'static str,
        /// What can be read.
        expected: String,
        /// What was given.
        found: String,
    },
    /// The adapter has too little memory.
    #[error("out of GPU memory: {0}")]
    OutOfMemory(String),
    /// The driver refused a call: a defect of this library or of the driver, or a host's view of several layers.
    #[error("GPU validation failed: {0}")]
    Validation(String),
    /// The driver failed, as where it does not compile a kernel.
    #[error("the GPU's driver failed: {0}")]
    Driver(String),
    /// The device is gone; open another one and build anew.
    #[error("the GPU device was lost: {0}")]
    Lost(String),
    /// The device did not answer.
    #[error("the GPU did not finish within {0:?}")]
    Timeout(Duration),
}

impl From<NetworkError> for GpuError {
    fn from(error: NetworkError) -> Self {
        Self::Network(Arc::new(error))
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none".into()
    } else {
        names.join(", ")
    }
}
