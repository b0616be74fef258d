use std::collections::{BTreeMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::choice::{Conv2dKernel, by};
use super::conv2d::Conv2d;
use super::step::Step;
use super::{Device, GpuError, Layout};

/// Times the kernels that serve a layer on the adapter, and remembers the fastest. A kernel that fails, or
/// does not answer as `conv2d_buffer` does, is never chosen.
#[derive(Debug, Default)]
pub(super) struct Tuner {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    left: Duration,
    winners: BTreeMap<String, String>,
    changed: bool,
    /// Those that failed or answered wrongly for some layer.
    refused: HashSet<Conv2dKernel>,
}

/// What is remembered from one process to the next.
#[derive(Serialize, Deserialize)]
struct Memory {
    /// The adapter, its driver and the kernels that were compared.
    of: String,
    /// By layer.
    winners: BTreeMap<String, String>,
}

impl Tuner {
    /// With `limit` to spend. `memory` is what [`Tuner::memory`] gave; another adapter's, another
    /// version's or no such thing at all is passed over.
    pub fn new(limit: Duration, info: &wgpu::AdapterInfo, memory: &[u8]) -> Self {
        let memory = serde_json::from_slice::<Memory>(memory).ok();
        let ours = memory.filter(|memory| memory.of == identity(info));
        let state = State {
            left: limit,
            winners: ours.map(|memory| memory.winners).unwrap_or_default(),
            changed: false,
            refused: HashSet::new(),
        };
        Self {
            state: Mutex::new(state),
        }
    }

    /// What to remember, if there is anything new.
    pub fn memory(&self, info: &wgpu::AdapterInfo) -> Option<Vec<u8>> {
        let mut state = self.state();
        if !std::mem::take(&mut state.changed) {
            return None;
        }
        let memory = Memory {
            of: identity(info),
            winners: state.winners.clone(),
        };
        serde_json::to_vec_pretty(&memory).ok()
    }

    /// The fastest of `candidates`, or of those for which the time sufficed, which is not remembered; `None` where
    /// there is no choice, or no time at all.
    /// Overwrites what the layer reads and makes.
    pub fn choose(
        &self,
        device: &Device,
        conv: &Conv2d<'_>,
        candidates: &[Conv2dKernel],
    ) -> Result<Option<Conv2dKernel>, GpuError> {
        // Between textures the order is known, and compiling each candidate would take a second.
        if candidates.len() < 2 || conv.input.layout() == Layout::Texture {
            return Ok(None);
        }
        let layer = describe(conv);
        let mut state = self.state();
        let known = state.winners.get(&layer);
        let known = known.and_then(|name| candidates.iter().find(|k| k.to_string() == *name));
        if let Some(known) = known {
            return Ok(Some(*known));
        }
        if state.left.is_zero() {
            return Ok(None);
        }
        let start = Instant::now();
        let found = fastest(device, conv, candidates, start + state.left)?;
        // What the others are held to is none of them.
        let refused = found.refused.into_iter();
        state
            .refused
            .extend(refused.filter(|&kernel| kernel != Conv2dKernel::Buffer));
        state.left = state.left.saturating_sub(start.elapsed());
        if let Found {
            kernel: Some(fastest),
            of_all: true,
            ..
        } = found
        {
            state.winners.insert(layer, fastest.to_string());
            state.changed = true;
        }
        Ok(found.kernel)
    }

    /// Whether `kernel` answers rightly on the adapter: so it does if it was the fastest for some layer, and was not refused for
    /// another. `None` where nothing was found out.
    pub fn is_right(&self, kernel: Conv2dKernel) -> Option<bool> {
        let (state, name) = (self.state(), kernel.to_string());
        if state.refused.contains(&kernel) {
            return Some(false);
        }
        let won = state.winners.values().any(|winner| *winner == name);
        won.then_some(true)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Of an adapter, its driver, this library's version, the kernels, and what packs their weights.
fn identity(info: &wgpu::AdapterInfo) -> String {
    let mut kernels = DefaultHasher::new();
    [
        include_str!("../../shaders/conv2d_planes.wgsl"),
        include_str!("../../shaders/conv2d_buffer.wgsl"),
        include_str!("../../shaders/conv2d_tiled.wgsl"),
        include_str!("../../shaders/conv2d_one.wgsl"),
        include_str!("../../shaders/conv2d_matrix.wgsl"),
        include_str!("../../shaders/conv2d_cooperative.wgsl"),
        include_str!("conv2d/mod.rs"),
        include_str!("conv2d/buffer.rs"),
        include_str!("conv2d/tiled.rs"),
        include_str!("conv2d/one.rs"),
        include_str!("conv2d/cooperative.rs"),
        env!("CARGO_PKG_VERSION"),
        include_str!("../../shaders/layout/geometry.wgsl"),
        include_str!("../../shaders/layout/buffer.wgsl"),
        include_str!("../../shaders/layout/half_buffer.wgsl"),
    ]
    .hash(&mut kernels);
    format!(
        "{} ({:04x}:{:04x}, {}), {} {}, kernels {:016x}",
        info.name,
        info.vendor,
        info.device,
        info.backend,
        info.driver,
        info.driver_info,
        kernels.finish()
    )
}

/// What a layer's time depends on.
fn describe(conv: &Conv2d<'_>) -> String {
    let (input, output) = (conv.input.shape, conv.output.shape);
    format!(
        "{input} to {} channels, kernel {}, dilation {}, batch {}, {:?}",
        output.channels,
        conv.kernel,
        conv.dilation,
        conv.output.batch,
        conv.input.layout()
    )
}

/// The fastest of those that were timed.
struct Found {
    kernel: Option<Conv2dKernel>,
    /// Not so where the time was over first.
    of_all: bool,
    /// Those that failed or answered wrongly.
    refused: Vec<Conv2dKernel>,
}

/// The fastest of those of `candidates`, in their order, that are compiled by the `deadline`.
///
/// They are timed in rounds, one after the other without a pause: while the CPU compiles, a GPU lowers its clock (an H200 to a
/// quarter), and whichever came first would win.
fn fastest(
    device: &Device,
    conv: &Conv2d<'_>,
    candidates: &[Conv2dKernel],
    deadline: Instant,
) -> Result<Found, GpuError> {
    conv.input.fill(device);
    let plainest = device.scoped(|| by(Conv2dKernel::Buffer, device, conv))?;
    let expected = answer(device, conv, &plainest)?;
    let (mut contestants, mut refused) = (Vec::new(), Vec::new());
    let mut of_all = true;
    for &kernel in candidates {
        if Instant::now() > deadline {
            of_all = false;
            break;
        }
        match contestant(device, conv, kernel, &expected) {
            Ok(Some(contestant)) => contestants.push(contestant),
            Ok(None) => {
                refused.push(kernel);
                log::warn!(
                    "{}: `{kernel}` is not used: its answer is wrong here",
                    conv.label
                );
            }
            Err(error) => {
                device.check()?;
                refused.push(kernel);
                log::warn!("{}: `{kernel}` is not used: {error}", conv.label);
            }
        }
    }
    // The first round wakes the GPU up, and says who is far behind.
    for round in 0..4 {
        let times = contestants.iter().map(|contestant| contestant.time);
        let least = times.min().unwrap_or(Duration::MAX);
        for contestant in &mut contestants {
            if contestant.time > least.saturating_mul(4) {
                continue;
            }
            let repeats = (2000 / least.as_micros().max(1)).clamp(1, 50) as u32;
            let time = run(device, &contestant.step, repeats)? / repeats;
            contestant.time = if round == 0 {
                time
            } else {
                contestant.time.min(time)
            };
        }
    }
    for Contestant { kernel, time, .. } in &contestants {
        log::debug!("{}: {}, `{kernel}`: {time:?}", conv.label, describe(conv));
    }
    let best = contestants.iter().min_by_key(|contestant| contestant.time);
    Ok(Found {
        kernel: best.map(|best| best.kernel),
        of_all,
        refused,
    })
}

/// What `step` makes of what the layer reads. What it does not write is no number, whatever was there before.
fn answer(device: &Device, conv: &Conv2d<'_>, step: &Step) -> Result<Vec<f32>, GpuError> {
    conv.output.spoil(device);
    run(device, step, 1)?;
    conv.output.sample(device)
}

/// Whether `step` answers as expected.
fn is_right(
    device: &Device,
    conv: &Conv2d<'_>,
    step: &Step,
    expected: &[f32],
) -> Result<bool, GpuError> {
    let found = answer(device, conv, step)?;
    let greatest = expected.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    // Products of halves are off by a thousandth; what is put together wrongly, by far more.
    let right = |(found, expected): (&f32, &f32)| (found - expected).abs() <= 0.02 * greatest;
    Ok(found.iter().zip(expected).all(right))
}

/// A kernel that answers rightly.
struct Contestant {
    kernel: Conv2dKernel,
    step: Step,
    /// The shortest time so far.
    time: Duration,
}

/// `kernel` compiled and run; `None` if its answer is not the expected one.
fn contestant(
    device: &Device,
    conv: &Conv2d<'_>,
    kernel: Conv2dKernel,
    expected: &[f32],
) -> Result<Option<Contestant>, GpuError> {
    let step = device.scoped(|| by(kernel, device, conv))?;
    if !is_right(device, conv, &step, expected)? {
        return Ok(None);
    }
    // The first run may have compiled.
    let time = run(device, &step, 1)?;
    Ok(Some(Contestant { kernel, step, time }))
}

/// How long so many runs take, submission included.
fn run(device: &Device, step: &Step, repeats: u32) -> Result<Duration, GpuError> {
    let mut encoder = device.wgpu().create_command_encoder(&Default::default());
    let mut pass = encoder.begin_compute_pass(&Default::default());
    for _ in 0..repeats {
        step.encode(&mut pass);
    }
    drop(pass);
    let start = Instant::now();
    device.queue().submit([encoder.finish()]);
    device.wait()?;
    Ok(start.elapsed())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gpu::{AdapterRequest, Tensor};
    use crate::network::{Activation, Parameters, Shape};

    /// What `ask` says of a small layer between buffers in `layout`.
    fn with_layer<T>(device: &Device, layout: Layout, ask: impl FnOnce(&Conv2d<'_>) -> T) -> T {
        let shape = Shape::new(8, 5, 6);
        let tensor = |what| Tensor::in_layout(device, layout, what, shape, 1, 0).unwrap();
        let parameters = Parameters {
            weight: (0..64).map(|i| (i as f32).sin()).collect(),
            bias: vec![0.5; 8],
        };
        let conv = Conv2d {
            label: "layer",
            input: &tensor("input"),
            output: &tensor("output"),
            parameters: &parameters,
            kernel: 1,
            dilation: 1,
            activation: Activation::None,
            pool: None,
        };
        ask(&conv)
    }

    /// What a tuner chooses among `candidates` for it.
    fn choose(device: &Device, tuner: &Tuner, candidates: &[Conv2dKernel]) -> Option<Conv2dKernel> {
        with_layer(device, Layout::Buffer, |conv| {
            tuner.choose(device, conv, candidates).unwrap()
        })
    }

    #[test]
    fn a_kernel_that_writes_nothing_is_not_right() {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        for layout in [Layout::Buffer, Layout::HalfBuffer] {
            with_layer(&device, layout, |conv| {
                let by = |conv: &Conv2d<'_>| by(Conv2dKernel::Tiled(2), &device, conv).unwrap();
                let step = by(conv);
                let expected = answer(&device, conv, &step).unwrap();
                assert!(expected.iter().all(|v| v.is_finite()));
                // It writes, but elsewhere.
                let shape = conv.output.shape;
                let elsewhere = Tensor::in_layout(&device, layout, "elsewhere", shape, 1, 0);
                let idle = by(&Conv2d {
                    output: &elsewhere.unwrap(),
                    ..*conv
                });
                assert!(!is_right(&device, conv, &idle, &expected).unwrap());
                // Negative control: one that writes.
                assert!(is_right(&device, conv, &step, &expected).unwrap());
            });
        }
    }

    #[test]
    fn the_winner_is_remembered_and_what_is_foreign_is_not() {
        use Conv2dKernel::{Buffer, Tiled};
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let info = device.info();
        let both = [Tiled(2), Buffer];
        let tuner = Tuner::new(Duration::from_secs(60), info, b"not JSON");
        let winner = choose(&device, &tuner, &both).unwrap();
        let memory = tuner.memory(info).unwrap();
        assert!(tuner.memory(info).is_none(), "nothing new");

        // Without any time, only what is remembered can be known.
        let no_time = |memory: &[u8]| {
            let tuner = Tuner::new(Duration::ZERO, info, memory);
            let chosen = choose(&device, &tuner, &both);
            assert!(tuner.memory(info).is_none());
            chosen
        };
        assert_eq!(no_time(&memory), Some(winner));
        let text = String::from_utf8(memory).unwrap();
        let other = if winner == Buffer { Tiled(2) } else { Buffer };
        let swapped = text.replace(&winner.to_string(), &other.to_string());
        assert_eq!(no_time(swapped.as_bytes()), Some(other));
        let nobody = text.replace(&winner.to_string(), "conv2d_quantum");
        assert_eq!(no_time(nobody.as_bytes()), None);
        let foreign = text.replace("kernels", "kernels of a friend,");
        assert_eq!(no_time(foreign.as_bytes()), None);
        assert_eq!(no_time(b""), None);
    }

    #[test]
    fn a_kernel_that_cannot_run_here_is_passed_over() {
        use Conv2dKernel::{Buffer, Subgroup};
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let tuner = Tuner::new(Duration::from_secs(60), device.info(), b"");
        // It binds textures, and gets buffers.
        assert_eq!(choose(&device, &tuner, &[Subgroup, Buffer]), Some(Buffer));
        // For later layers too, when there is no time left to look.
        assert_eq!(tuner.is_right(Subgroup), Some(false));
        assert_eq!(tuner.is_right(Buffer), Some(true));
    }
}
