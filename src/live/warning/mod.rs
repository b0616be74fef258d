//! Warnings: whether the robot is too close to a person or a place, and what is done about it.
//!
//! **Not a safety-rated function.** Nothing here meets ISO 13849 or IEC 61508: it comes on top of what keeps people
//! safe, never in its place.
//!
//! [`Config`] is what the user wants; a [`Monitor`] judges, and knows neither clock nor network; [`Warnings`] is the
//! [`Sink`](crate::live::Sink) that gives it both.

mod action;
mod config;
mod dashboard;
mod geometry;
mod judge;
mod monitor;
mod report;
mod sink;

pub use config::{
    Action, Config, ConfigError, Dashboard, DashboardCommand, Expect, Itself, Observer, Places,
    Policy, Protect, Rule, uncertainty_m,
};
pub use geometry::{Pose, Zone, distance};
pub use judge::{Judge, Level, Limits};
pub use monitor::{Monitor, Told};
pub use report::{ActionReport, State, Warning, Why};
pub use sink::{Warnings, WarningsError};
