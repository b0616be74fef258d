use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::clock::now_ms;
use super::statistics::rounded;
use super::timer::Timer;
use crate::gpu::{ArithmeticProbe, Device, GpuError, Step, Work, copy_probe};

/// What an adapter was measured to reach with two tiny kernels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Roofline {
    /// Billions of operations a second, of multiply-adds in registers (each is two).
    pub gflop_per_s: f64,
    /// Billions of bytes a second, of a copy through memory (read and written).
    pub gb_per_s: f64,
}

/// A probe that runs as long as this tells the adapter from the start of a dispatch.
const LONG_ENOUGH_MS: f64 = 5.0;
/// By the wall. A GPU that has a run of seconds is reset by its driver, and until then draws nothing else.
const TOO_LONG_MS: f64 = 50.0;
const RUNS: usize = 5;

impl Roofline {
    /// `None` where the adapter's clock stands still.
    pub(super) async fn measure(device: &Device, timer: &Timer) -> Result<Option<Self>, GpuError> {
        let best_of = async |steps: Vec<&Step>| -> Result<f64, GpuError> {
            let passes = [steps];
            let mut best = f64::INFINITY;
            for _ in 0..RUNS {
                let times = timer.time(device, &passes).await?;
                best = best.min(times.iter().sum());
            }
            Ok(best)
        };

        let both = async |steps: Vec<&Step>| -> Result<[f64; 2], GpuError> {
            let start = now_ms();
            let times = timer.time(device, &[steps]).await?;
            Ok([times.iter().sum(), now_ms() - start])
        };

        let probe = ArithmeticProbe::new(device)?;
        let run = async |rounds| both(vec![probe.step(device, rounds).0]).await;
        // The first run compiles.
        run(16).await?;
        let Some(rounds) = long_enough(16..1 << 20, run).await? else {
            return Ok(None);
        };
        let (step, work) = probe.step(device, rounds);
        let gflop_per_s = work.operations as f64 * 1e-6 / best_of(vec![step]).await?;

        let step = copy_probe(device)?;
        let run = async |copies| both(vec![&step; copies as usize]).await;
        run(1).await?;
        let Some(copies) = long_enough(1..256, run).await? else {
            return Ok(None);
        };
        let bytes = step.work().bytes as f64 * f64::from(copies);
        let gb_per_s = bytes * 1e-6 / best_of(vec![&step; copies as usize]).await?;

        let usable = gflop_per_s.is_finite() && gb_per_s.is_finite();
        Ok(usable.then_some(Self {
            gflop_per_s: rounded(gflop_per_s),
            gb_per_s: rounded(gb_per_s),
        }))
    }

    /// The share of what this adapter can reach that doing `work` in `ms` is: 1 where arithmetic or
    /// memory, whichever binds, is as fast as in the probe. More is possible where data stays in caches.
    pub fn share(&self, work: Work, ms: f64) -> Option<f64> {
        let arithmetic = work.operations as f64 * 1e-6 / self.gflop_per_s;
        let memory = work.bytes as f64 * 1e-6 / self.gb_per_s;
        (ms > 0.0).then(|| arithmetic.max(memory) / ms)
    }
}

/// The first of `counts`, each twice the last, of which a run is long enough; or the last. `run` gives a run's time by the
/// adapter's clock and by the wall; `None` where the former stands still.
async fn long_enough(
    counts: Range<u32>,
    run: impl AsyncFn(u32) -> Result<[f64; 2], GpuError>,
) -> Result<Option<u32>, GpuError> {
    let mut count = counts.start;
    while count < counts.end {
        let [ms, wall_ms] = run(count).await?;
        if wall_ms > TOO_LONG_MS && ms == 0.0 {
            return Ok(None);
        }
        if ms >= LONG_ENOUGH_MS || wall_ms > TOO_LONG_MS {
            break;
        }
        count *= 2;
    }
    Ok(Some(count))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// What is found where a run of one takes 0.1 ms, which the adapter's clock says `factor` times; and the longest run
    /// by the wall.
    fn with_clock(factor: f64) -> (Option<u32>, f64) {
        let longest = std::cell::Cell::new(0.0_f64);
        let run = async |count: u32| {
            let ms = 0.1 * f64::from(count);
            longest.set(longest.get().max(ms));
            Ok([ms * factor, ms])
        };
        let found = pollster::block_on(long_enough(1..1 << 20, run)).unwrap();
        (found, longest.get())
    }

    #[test]
    fn no_run_is_long_whatever_the_adapter_s_clock_says() {
        assert_eq!(with_clock(1.0), (Some(64), 6.4));
        assert_eq!(with_clock(0.0).0, None);
        assert_eq!(with_clock(1e-6).0, Some(512));
        for factor in [0.0, 1e-6] {
            assert!(with_clock(factor).1 < 2.0 * TOO_LONG_MS);
        }
    }
}
