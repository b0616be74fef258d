//! Finds a robot arm in one colour image from a freely moving camera: which pixels are the robot,
//! and where its joints are, in metres, in the camera's optical frame (REP 103).

pub mod benchmark;
pub mod calibration;
pub mod camera;
pub mod cascade;
#[cfg(feature = "cli")]
pub mod cli;
pub mod draw;
#[cfg(feature = "recording")]
pub mod evaluation;
pub mod gpu;
#[cfg(feature = "recording")]
mod image_file;
#[cfg(feature = "live")]
pub mod live;
pub mod network;
#[cfg(feature = "recorder")]
pub mod recorder;
#[cfg(feature = "recording")]
pub mod recording;
pub mod reference;
#[cfg(feature = "recorder")]
pub mod robot;
pub mod verification;

/// Crates whose types are in the API here, in the versions that it has them from.
pub use {glam, image, wgpu};

/// The examples in the documents are compiled with the tests.
#[cfg(all(doctest, feature = "cli"))]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/calibration.md")]
#[doc = include_str!("../docs/embedding.md")]
struct Documents;
