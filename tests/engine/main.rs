//! The cascade on a GPU: its answers, a host's device, faults, and in what drivers differ.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../common/mod.rs"]
mod common;

mod cascade;
mod device;
mod drivers;
mod golden;
mod host;
