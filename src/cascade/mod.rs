//! A frame in, an estimate out: the API that other programs embed.

mod estimate;
mod host;
mod locator;
mod view;

pub use estimate::{Estimate, Joint, Mask, Status};
pub use host::{HostLocator, HostOptions, Located, MaskSize, Source};
pub use locator::{LocateError, Locator, Output};
