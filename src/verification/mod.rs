//! Whether an adapter computes what the plain Rust layers compute: every kernel on random layers, and the
//! whole cascade on two pictures. No file, no process and no clock: the same code serves a program and a
//! page in a browser.

mod cascade;
mod comparison;
mod kernel;
mod kinematic_fit;
mod random;
mod report;
mod stages;
mod zoom;

use crate::benchmark::{Adapter, Program, Weights};
use crate::gpu::{Device, GpuError, Layout, Precision};
use crate::network::Model;
pub use comparison::Figures;
pub use report::{Check, Outcome, Report, Verdict};

use comparison::{Comparison, judge};
use kernel::Kernel;

/// Random inputs for each kernel in each layout.
const CASES: usize = 3;

/// What may be reported while an adapter is verified: how many checks are done, how many there are, and what
/// the next one is of.
pub type Progress<'a> = &'a mut dyn FnMut(usize, usize, &str);

/// Holds `device` to the reference, with what it stores in `precisions`, and runs `model`. The report names
/// `adapter`, the device's, and the `weights`. Whatever goes wrong is in the report.
///
/// In a browser the checks await it; elsewhere they block.
pub async fn verify(
    device: &Device,
    adapter: Adapter,
    model: &Model,
    weights: Weights,
    precisions: &[Precision],
    progress: Progress<'_>,
) -> Report {
    let subjects: Vec<(Kernel, Layout)> = Kernel::all()
        .flat_map(|kernel| kernel.layouts().iter().map(move |&layout| (kernel, layout)))
        .filter(|(_, layout)| precisions.contains(&layout.precision()))
        .collect();
    let count = subjects.len() + precisions.len();
    let mut checks = Vec::with_capacity(subjects.len() + cascade::PARTS.len() * precisions.len());
    for (done, &(kernel, layout)) in subjects.iter().enumerate() {
        progress(done, count, &format!("{kernel}, {layout}"));
        let outcome = match kernel.lacks(device, layout) {
            Some(reason) => Outcome::CannotRun { reason },
            None => match compare(device, kernel, layout).await {
                Ok(comparisons) => judge(&comparisons),
                Err(error) => Outcome::failed(&error),
            },
        };
        checks.push(Check {
            subject: kernel.to_string(),
            layout,
            precision: layout.precision(),
            outcome,
        });
    }
    for (done, &precision) in precisions.iter().enumerate() {
        progress(
            subjects.len() + done,
            count,
            &format!("cascade, {precision}"),
        );
        checks.extend(cascade(device, model, precision).await);
    }
    Report::new(Program::this(), adapter, weights, checks)
}

async fn compare(
    device: &Device,
    kernel: Kernel,
    layout: Layout,
) -> Result<Vec<Comparison>, GpuError> {
    let mut comparisons = Vec::new();
    for number in 0..CASES {
        comparisons.push(kernel.compare(device, layout, number).await?);
    }
    Ok(comparisons)
}

async fn cascade(device: &Device, model: &Model, precision: Precision) -> Vec<Check> {
    let all = |outcome: Outcome| [(); 3].map(|()| outcome.clone());
    let layout = device.layout(precision);
    let outcomes = match &layout {
        Ok(_) => match cascade::compare(device, model, precision).await {
            Ok(parts) => parts.map(|comparisons| judge(&comparisons)),
            Err(error) => all(Outcome::failed(&error)),
        },
        Err(error) => all(Outcome::CannotRun {
            reason: error.to_string(),
        }),
    };
    let checks = cascade::PARTS.into_iter().zip(outcomes);
    checks
        .map(|(part, outcome)| Check {
            subject: part.to_owned(),
            // Only halves are not for every device.
            layout: *layout.as_ref().unwrap_or(&Layout::HalfBuffer),
            precision,
            outcome,
        })
        .collect()
}
