use std::fmt;

use serde::Serialize;

use super::comparison::Figures;
use crate::benchmark::table::Table;
use crate::benchmark::{Adapter, Program, Weights};
use crate::gpu::{GpuError, Layout, Precision};

/// What was compared, where, and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The version of the JSON: 1.
    pub schema: u32,
    /// What compared.
    pub program: Program,
    /// What it ran on.
    pub adapter: Adapter,
    /// What ran.
    pub weights: Weights,
    /// What all of [`Report::checks`] come to.
    pub verdict: Verdict,
    /// The same in one line, with adapter, driver and version: to be sent.
    pub line: String,
    /// Every kernel in every layout that it has, then the cascade.
    pub checks: Vec<Check>,
}

/// Whether an adapter computes what the reference does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// It does, in all that it can run.
    Agrees,
    /// Something differs, failed, or could not be proven.
    Disagrees,
}

/// A kernel, or a part of the cascade's answer, held to the reference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// The kernel's name (its file in `shaders/`), or `cascade.mask`, `cascade.coverage` or `cascade.joints`.
    pub subject: String,
    /// How its tensors lay in memory.
    pub layout: Layout,
    /// What they were stored in.
    pub precision: Precision,
    /// What came of it.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// What came of a [`Check`].
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// As the reference, to rounding.
    Agrees(Figures),
    /// Otherwise than the reference.
    Disagrees(Figures),
    /// As the reference, but a wrong value was not noticed: the comparison proves nothing.
    Unproven(Figures),
    /// This adapter lacks something that the kernel needs. No fault.
    CannotRun {
        /// What it lacks.
        reason: String,
    },
    /// It could not be planned or run.
    Failed {
        /// The driver's words.
        reason: String,
    },
}

impl Report {
    pub(super) fn new(
        program: Program,
        adapter: Adapter,
        weights: Weights,
        checks: Vec<Check>,
    ) -> Self {
        let idle = |check: &&Check| matches!(check.outcome, Outcome::CannotRun { .. });
        let idle = checks.iter().filter(idle).count();
        let faults: Vec<&Check> = checks
            .iter()
            .filter(|check| check.outcome.is_fault())
            .collect();
        let compared = checks.len() - idle;
        let verdict = if faults.is_empty() {
            Verdict::Agrees
        } else {
            Verdict::Disagrees
        };
        let mut line = format!(
            "whereabot {}, {}, {verdict} on {adapter}, {}: {} of {} checks agree",
            program.version,
            program.target,
            adapter.tier,
            compared - faults.len(),
            compared,
        );
        for check in &faults {
            line += &format!("; {} {}: {}", check.subject, check.layout, check.outcome);
        }
        if idle > 0 {
            line += &format!("; {idle} cannot run");
        }
        line += &format!("; weights {} {}", weights.robot, weights.fingerprint);
        Self {
            schema: 1,
            program,
            adapter,
            weights,
            verdict,
            line,
            checks,
        }
    }
}

impl Outcome {
    pub(super) fn failed(error: &GpuError) -> Self {
        Self::Failed {
            reason: error.to_string(),
        }
    }

    /// Whether something is wrong with adapter, driver or kernel.
    fn is_fault(&self) -> bool {
        !matches!(self, Self::Agrees(_) | Self::CannotRun { .. })
    }

    /// How far apart adapter and reference are, where they were compared.
    pub fn figures(&self) -> Option<&Figures> {
        match self {
            Self::Agrees(figures) | Self::Disagrees(figures) | Self::Unproven(figures) => {
                Some(figures)
            }
            Self::CannotRun { .. } | Self::Failed { .. } => None,
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Agrees => "agrees",
            Self::Disagrees => "DISAGREES",
        })
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Agrees(_) => f.write_str("agrees"),
            Self::Disagrees(figures) => write!(
                f,
                "DISAGREES by {}, {} allowed",
                short(figures.difference),
                short(figures.allowed)
            ),
            Self::Unproven(_) => f.write_str("UNPROVEN: a wrong value was not noticed"),
            Self::CannotRun { reason } => write!(f, "cannot run: {reason}"),
            Self::Failed { reason } => write!(f, "FAILED: {reason}"),
        }
    }
}

/// With two digits.
fn short(number: f32) -> String {
    if number == 0.0 {
        "0".to_owned()
    } else {
        format!("{number:.1e}")
    }
}

/// For people: a table, and the line.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "adapter   {}", self.adapter)?;
        writeln!(f, "weights   {}", self.weights)?;
        writeln!(f, "program   {}", self.program)?;
        writeln!(
            f,
            "\nThe adapter held to plain Rust: largest absolute differences"
        )?;
        let header = [
            "kernel",
            "layout",
            "outcome",
            "cases",
            "difference",
            "allowed",
            "wrong value",
        ];
        let mut table = Table::new(3, &header);
        for check in &self.checks {
            let mut row = vec![
                check.subject.clone(),
                check.layout.to_string(),
                check.outcome.to_string(),
            ];
            if let Some(figures) = check.outcome.figures() {
                row.push(figures.cases.to_string());
                let numbers = [figures.difference, figures.allowed, figures.control];
                row.extend(numbers.map(short));
            }
            table.row(row);
        }
        write!(f, "{table}")?;
        writeln!(
            f,
            "  difference, allowed: where most of what rounding may cost is used up; wrong value: the same after one\n  \
             value of the input was made wrong (of the cascade: with the other picture's answer), where it shows least"
        )?;
        writeln!(f, "\n{}", self.line)
    }
}
