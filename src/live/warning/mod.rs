//! Warnings: whether the robot is too close to a person or a place, and what is done about it.
//!
//! **Not a safety-rated function.** Nothing here meets ISO 13849 or IEC 61508: it comes on top of what keeps people
//! safe, never in its place.

mod report;

pub use report::{ActionReport, State, Warning, Why};
