use super::clock::now_ms;
use super::report::{Adapter, Program};
use super::roofline::Roofline;
use super::statistics::{Sample, rounded};
use super::timer::Timer;
use super::{
    BenchmarkError, CascadeFigures, IMAGE, LayerFigures, LayerWork, Options, Progress, Report,
    Timing, Weights, rectification, source,
};
use crate::camera::Rectification;
use crate::gpu::{Device, GpuError, Plan, Precision, Step, Work};
use crate::network::Model;

pub(super) async fn measure(
    device: &Device,
    model: &Model,
    weights: Weights,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Report, BenchmarkError> {
    progress("what the adapter can reach");
    let features = device.wgpu().features();
    let mut timestamps = options.timestamps && features.contains(wgpu::Features::TIMESTAMP_QUERY);
    let probe = async |timestamps| {
        let timer = Timer::new(device, 1, timestamps)?;
        Roofline::measure(device, &timer).await
    };
    let mut roofline = probe(timestamps).await.map_err(BenchmarkError::Probe)?;
    if roofline.is_none() {
        timestamps = false;
        roofline = probe(timestamps).await.map_err(BenchmarkError::Probe)?;
    }
    let mut report = Report {
        schema: Report::SCHEMA,
        program: Program::this(),
        adapter: Adapter::of(device),
        weights,
        image: [IMAGE.0, IMAGE.1],
        timing: if timestamps {
            Timing::Timestamps
        } else {
            Timing::Wall
        },
        roofline,
        layers: Vec::new(),
        cascade: Vec::new(),
        start: None,
    };
    for &precision in &options.precisions {
        for &batch in &options.batches {
            let mut measure = async || {
                let mut planned = Batch::plan(device, model, batch, precision, timestamps)?;
                progress(&format!("batch {batch}, {precision}: cascade"));
                let cascade = planned.cascade(device, precision, options).await?;
                progress(&format!("batch {batch}, {precision}: layers"));
                let layers = planned.layers(device, precision, options, roofline.as_ref());
                Ok((cascade, layers.await?))
            };
            let measured = measure().await;
            let (cascade, layers) =
                measured.map_err(|cause| BenchmarkError::Batch { batch, cause })?;
            report.cascade.push(cascade);
            report.layers.extend(layers);
        }
    }
    Ok(report)
}

/// A plan for a batch, and what it takes to run it.
struct Batch {
    plan: Plan,
    batch: usize,
    timestamps: bool,
    image: image::RgbaImage,
    rectification: Rectification,
    /// Before planning; `None` where the driver does not tell.
    allocated_before: Option<u64>,
    plan_ms: f64,
}

/// The times of one run, in milliseconds.
struct Run {
    upload: f64,
    submit: f64,
    wait: f64,
    readback: f64,
    gpu: Option<f64>,
}

impl Batch {
    fn plan(
        device: &Device,
        model: &Model,
        batch: usize,
        precision: Precision,
        timestamps: bool,
    ) -> Result<Self, GpuError> {
        let allocated_before = allocated(device);
        let start = now_ms();
        let plan = Plan::new(device, model, batch, precision)?;
        Ok(Self {
            plan_ms: now_ms() - start,
            plan,
            batch,
            timestamps,
            image: source(),
            rectification: rectification(model),
            allocated_before,
        })
    }

    async fn cascade(
        &mut self,
        device: &Device,
        precision: Precision,
        options: &Options,
    ) -> Result<CascadeFigures, GpuError> {
        let timer = Timer::new(device, 1, self.timestamps)?;
        let start = now_ms();
        self.run(device, &timer).await?;
        let first_ms = now_ms() - start;

        let mut samples: [Sample; 6] = Default::default();
        let start = now_ms();
        let mut runs = 0;
        while !options.enough(runs, now_ms() - start) {
            let run = self.run(device, &timer).await?;
            let compute = run.submit + run.wait;
            let all = run.upload + compute + run.readback;
            // Some drivers do the GPU's work while they take the submission.
            let besides_gpu = run.gpu.map_or(f64::INFINITY, |gpu| all - run.upload - gpu);
            let cpu = (run.submit + run.readback).min(besides_gpu.max(0.0));
            let values = [all, run.upload, compute, run.readback, 1e3 * cpu];
            for (sample, value) in samples.iter_mut().zip(values.into_iter().chain(run.gpu)) {
                sample.push(value);
            }
            runs += 1;
        }
        let [wall, upload, compute, readback, cpu_us, gpu] =
            samples.map(|sample| [0.5, 0.0, 0.95, 0.99].map(|share| sample.percentile(share)));
        let [p50, min, p95, p99] = wall.map(Option::unwrap_or_default);
        let operations: u64 = self.plan.steps(true).map(|s| s.work().operations).sum();
        let memory = allocated(device).zip(self.allocated_before);
        Ok(CascadeFigures {
            batch: self.batch,
            precision,
            runs,
            gflop: operations as f64 / 1e9,
            gpu_ms_p50: gpu[0].map(rounded),
            gpu_ms_min: gpu[1].map(rounded),
            wall_ms_p50: rounded(p50),
            wall_ms_min: rounded(min),
            wall_ms_p95: rounded(p95),
            wall_ms_p99: rounded(p99),
            upload_ms_p50: upload[0].map(rounded),
            compute_ms_p50: compute[0].map(rounded),
            readback_ms_p50: readback[0].map(rounded),
            cpu_us_p50: cpu_us[0].map(rounded),
            frames_per_s: rounded(self.batch as f64 * 1e3 / p50),
            memory_mb: memory
                .map(|(after, before)| rounded(after.saturating_sub(before) as f64 * 1e-6)),
            plan_ms: Some(rounded(self.plan_ms)),
            first_ms: rounded(first_ms),
        })
    }

    /// As [`Plan::run_async`], with a look at the clock between its parts.
    async fn run(&mut self, device: &Device, timer: &Timer) -> Result<Run, GpuError> {
        let start = now_ms();
        for index in 0..self.batch {
            self.plan
                .write(device, index, &self.image, &self.rectification)?;
        }
        let written = now_ms();
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        match timer {
            Timer::Timestamps(timestamps) => {
                let writes = timestamps.writes(0);
                self.plan.encode(&mut encoder, true, false, Some(writes));
                timestamps.resolve(&mut encoder, 1);
            }
            Timer::Wall => self.plan.encode(&mut encoder, true, false, None),
        }
        device.queue().submit([encoder.finish()]);
        let submitted = now_ms();
        device.wait_async().await?;
        let done = now_ms();
        self.plan.read_async(device, true, false).await?;
        let read = now_ms();
        let gpu = match timer {
            Timer::Timestamps(timestamps) => timestamps.read(device).await?.first().copied(),
            Timer::Wall => None,
        };
        Ok(Run {
            upload: written - start,
            submit: submitted - written,
            wait: done - submitted,
            readback: read - done,
            gpu,
        })
    }

    async fn layers(
        &self,
        device: &Device,
        precision: Precision,
        options: &Options,
        roofline: Option<&Roofline>,
    ) -> Result<Vec<LayerFigures>, GpuError> {
        let mut passes: Vec<Vec<&Step>> = Vec::new();
        for step in self.plan.steps(true) {
            match passes.last_mut() {
                Some(pass) if pass.iter().any(|s| s.label() == step.label()) => pass.push(step),
                _ => passes.push(vec![step]),
            }
        }
        let timer = Timer::new(device, passes.len(), self.timestamps)?;
        timer.time(device, &passes).await?;
        let mut samples = vec![Sample::default(); passes.len()];
        let start = now_ms();
        let mut runs = 0;
        while !options.enough(runs, now_ms() - start) {
            for (sample, ms) in samples.iter_mut().zip(timer.time(device, &passes).await?) {
                sample.push(ms);
            }
            runs += 1;
        }
        let figures = passes
            .iter()
            .zip(&samples)
            .map(|(steps, sample)| layer(steps).figures(self.batch, precision, sample, roofline));
        Ok(figures.collect())
    }
}

/// What a layer's steps have to do together.
fn layer(steps: &[&Step]) -> LayerWork {
    let mut kernels: Vec<&str> = steps.iter().map(|step| step.kernel()).collect();
    kernels.dedup();
    let sum = |of: fn(Work) -> u64| steps.iter().map(|step| of(step.work())).sum();
    LayerWork {
        layer: steps.first().map_or("", |step| step.label()).to_owned(),
        kernel: kernels.join(" + "),
        work: Work {
            operations: sum(|work| work.operations),
            bytes: sum(|work| work.bytes),
        },
    }
}

/// Bytes of GPU memory in use.
fn allocated(device: &Device) -> Option<u64> {
    let report = device.wgpu().generate_allocator_report()?;
    Some(report.total_allocated_bytes)
}
