//! The layers of a network as compute kernels on wgpu.

mod adapter;
mod device;
mod error;

pub use adapter::{AdapterReport, AdapterRequest, Choice, Wanted, list_adapters};
pub use device::{Device, Tier};
pub use error::GpuError;
