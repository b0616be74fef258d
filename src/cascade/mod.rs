//! A frame in, an estimate out: the API that other programs embed.

mod estimate;

pub use estimate::{Estimate, Joint, Mask, Status};
