//! Many cameras, live: scheduling, sources, faults, the command.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../common/mod.rs"]
mod common;
// Its command is for programs that end by themselves.
#[allow(dead_code)]
#[path = "../known/mod.rs"]
mod known;

mod command;
mod config;
mod device;
mod faults;
mod lines;
mod program;
mod rtsp;
mod schedule;
mod simulated;
mod sources;
