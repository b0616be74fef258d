use serde::{Deserialize, Serialize};

/// What a rule says about the distance between the robot and what it protects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Farther than `warn_m`.
    Clear,
    /// Within `warn_m`.
    Warn,
    /// Within `stop_m`.
    Stop,
    /// Nobody knows. This is never clear.
    Unknown,
}

/// Why a rule is [`State::Unknown`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Why {
    /// Too few answers since the start.
    Starting,
    /// No robot was found in the frames.
    NotFound,
    /// What was found cannot be a robot, or has no joints.
    Invalid,
    /// Answers come later than `max_age_s` after their frames.
    Late,
    /// No robot was found for `max_age_s`.
    NoAnswer,
    /// The camera gives no frames.
    Stale,
    /// The camera's source failed.
    Failed,
    /// The camera's source came to its end.
    Ended,
    /// The GPU is lost.
    DeviceLost,
}

/// A rule's state changed, or is told for the first time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Warning {
    /// The rule's name.
    pub rule: String,
    /// What it says now.
    pub state: State,
    /// What it said before; `None` at the start.
    pub before: Option<State>,
    /// What `state` counts as: itself, and for unknown what the rule's `unknown` says; `Unknown` where that is `ignore`.
    pub acts_as: State,
    /// What `before` counted as.
    pub acted_as: Option<State>,
    /// The shortest distance measured, in metres; `None` where it is unknown.
    pub distance_m: Option<f64>,
    /// What was taken off `distance_m` before it was judged, in metres.
    pub uncertainty_m: Option<f64>,
    /// Why it is unknown.
    pub why: Option<Why>,
    /// The number of the camera's frame that made the change; `None` where no frame did, or another camera's.
    pub frame_number: Option<u64>,
    /// From that frame's acquisition to the change, in milliseconds.
    pub latency_ms: Option<f64>,
}

/// What became of an action: a line each attempt.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ActionReport {
    /// The action's name.
    pub action: String,
    /// The rule that it was done for.
    pub rule: String,
    /// The state that it was done for.
    pub state: State,
    /// Whether it is done, and confirmed where it can be.
    pub done: bool,
    /// What was answered, or what went wrong.
    pub message: String,
    /// Which attempt this was, from 1.
    pub attempt: u32,
    /// How many there are at most; the last one that fails is not tried again.
    pub attempts: u32,
    /// From the rule's change to the end of this attempt, in milliseconds.
    pub elapsed_ms: f64,
}
