//! The layers of a network as compute kernels on wgpu.

mod adapter;
mod back_project;
mod choice;
mod concat;
mod conv2d;
mod coverage;
mod dense;
mod device;
mod error;
mod estimate;
mod kernel_text;
mod layout;
mod loss;
mod mapping;
mod max_pool2d;
mod network;
mod outputs;
mod overlay;
mod pipelines;
mod plan;
mod probe;
mod rectify;
mod sigmoid;
mod soft_argmax2d;
mod source;
mod step;
mod tensor;
mod tier;
#[cfg(not(target_arch = "wasm32"))]
mod tuner;
mod unrectify;
mod upsample2d;

#[cfg(not(target_arch = "wasm32"))]
pub use adapter::list_adapters;
pub use adapter::{AdapterReport, AdapterRequest, Choice, Wanted, device_type, driver};
pub use choice::Conv2dKernel;
pub use coverage::{Totals, coverage};
pub use device::Device;
pub(crate) use device::mapped;
pub use error::GpuError;
pub use estimate::{estimate, estimate_size, estimate_wgsl};
pub use kernel_text::kernel_text;
pub use layout::{Layout, Precision};
pub(crate) use mapping::{Mapped, Mapping};
pub use network::NetworkPlan;
pub use outputs::Outputs;
pub use overlay::overlay;
pub use plan::{Frame, Plan};
pub use probe::{ArithmeticProbe, copy_probe};
pub use rectify::Rectify;
pub use source::{Planes, Yuv};
pub use step::{Step, Work};
pub use tensor::Tensor;
pub use tier::Tier;
pub use unrectify::Unrectify;
