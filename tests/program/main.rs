//! The command line.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[path = "../common/mod.rs"]
mod common;
#[path = "../known/mod.rs"]
mod known;

mod bench;
mod calibrate;
mod cli;
mod evaluation;
mod examples;
mod verification;
