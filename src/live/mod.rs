//! Many cameras at once: sources, one GPU, results in time, warnings.
//!
//! A frame's way: a reader thread takes it from its source and puts it into its camera's mailbox, where a newer one
//! replaces it; the scheduler takes what is fresh from all mailboxes into one submission; what was found
//! goes to every [`Sink`] as an [`Observation`].

mod fusion;
mod observation;

pub use fusion::{Fused, Fusion};
pub use observation::{Event, EventKind, Observation, Rates, Sink, Statistics};
