use serde::{Deserialize, Serialize};

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

        let probe = ArithmeticProbe::new(device)?;
        let mut rounds = 16;
        // The first run compiles.
        let (step, _) = probe.step(device, rounds);
        timer.time(device, &[vec![step]]).await?;
        while rounds < 1 << 20 {
            let (step, _) = probe.step(device, rounds);
            let times = timer.time(device, &[vec![step]]).await?;
            if times.iter().sum::<f64>() >= LONG_ENOUGH_MS {
                break;
            }
            rounds *= 2;
        }
        let (step, work) = probe.step(device, rounds);
        let gflop_per_s = work.operations as f64 * 1e-6 / best_of(vec![step]).await?;

        let step = copy_probe(device)?;
        let mut copies = 1;
        timer.time(device, &[vec![&step]]).await?;
        while copies < 256 {
            let times = timer.time(device, &[vec![&step; copies]]).await?;
            if times.iter().sum::<f64>() >= LONG_ENOUGH_MS {
                break;
            }
            copies *= 2;
        }
        let bytes = step.work().bytes as f64 * copies as f64;
        let gb_per_s = bytes * 1e-6 / best_of(vec![&step; copies]).await?;

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
