//! Many cameras at once: sources, one GPU, results in time, warnings.
//!
//! A frame's way: a reader thread takes it from its source and puts it into its camera's mailbox, where a newer one
//! replaces it; the scheduler takes what is fresh from all mailboxes into one submission; what was found
//! goes to every [`Sink`] as an [`Observation`].

mod config;
mod engine;
mod frame;
mod fusion;
mod guard;
mod input;
mod lines;
mod mailbox;
pub mod mcap;
mod message;
mod observation;
pub mod page;
mod pulse;
mod reader;
pub(crate) mod ros;
mod scheduler;
mod service;
mod source;
mod stop;
pub mod warning;
mod watch;

pub use config::{CameraConfig, Config, ConfigError, KnownModel, RigConfig};
pub use engine::{CpuEngine, Engine, GpuEngine, GpuOptions, IN_FLIGHT, OpenDevice};
pub use frame::Frame;
pub use fusion::{Fused, Fusion};
pub use input::{Calibration, Input};
pub use lines::{Lines, Named, NamedRig};
pub use observation::{Event, EventKind, Observation, Rates, Sink, SinkError, Statistics, Word};
pub use source::{Location, Shot, Source, SourceError, Stream};
pub use stop::Stop;
pub use watch::watch;
