//! Many cameras, live: scheduling, sources, faults, warnings, recordings, the page, the command.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../chromium/mod.rs"]
mod chromium;
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
mod fusion;
mod lines;
mod mcap;
mod page;
mod page_browser;
mod program;
mod rtsp;
mod schedule;
mod simulated;
mod sources;
mod warning;
