//! Each kernel against the reference, on random shapes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../common/mod.rs"]
mod common;

mod back_project;
mod concat;
mod conv2d;
mod coverage;
mod dense;
mod estimate;
mod kinematic_fit;
mod max_pool2d;
mod orientation;
mod overlay;
mod rectify;
mod sigmoid;
mod soft_argmax2d;
mod unrectify;
mod upsample2d;
mod zoom;
