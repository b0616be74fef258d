//! What the library does beside running networks, and the files that it ships: cameras, models, recordings, shaders, weights.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../common/mod.rs"]
mod common;

mod calibration;
mod camera;
mod draw;
mod model;
mod reader;
mod recorder;
mod shaders;
mod weights;
