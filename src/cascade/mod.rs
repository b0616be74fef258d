//! A frame in, an estimate out: the API that other programs embed.

#[cfg(not(target_arch = "wasm32"))]
mod batch;
mod estimate;
mod host;
#[cfg(feature = "live")]
mod line;
mod locator;
mod view;

#[cfg(not(target_arch = "wasm32"))]
pub use batch::{BatchImage, BatchLocator, BatchOptions};
pub use estimate::{Estimate, Joint, Mask, Status};
pub use host::{HostLocator, HostOptions, Located, MaskSize, Source};
#[cfg(feature = "live")]
pub(crate) use line::EstimateLine;
#[cfg(feature = "cli")]
pub(crate) use line::rounded;
pub use locator::{LocateError, Locator, Output};
