use super::clock::now_ms;
use crate::gpu::{Device, GpuError, Step};

/// Measures how long compute passes take.
pub(super) enum Timer {
    /// By the GPU's own clock.
    Timestamps(Timestamps),
    /// From the submission of a pass to its end, as the CPU sees it.
    Wall,
}

impl Timer {
    /// For submissions of up to `passes` passes: by timestamps if `timestamps`.
    pub fn new(device: &Device, passes: usize, timestamps: bool) -> Result<Self, GpuError> {
        Ok(if timestamps {
            Self::Timestamps(Timestamps::new(device, passes as u32)?)
        } else {
            Self::Wall
        })
    }

    /// Runs each list of steps in a pass of its own, and waits: milliseconds of each.
    pub async fn time(&self, device: &Device, passes: &[Vec<&Step>]) -> Result<Vec<f64>, GpuError> {
        let encoder = || device.wgpu().create_command_encoder(&Default::default());
        let record = |encoder: &mut wgpu::CommandEncoder, steps: &[&Step], timestamp_writes| {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes,
            });
            for step in steps {
                step.encode(&mut pass);
            }
        };
        match self {
            Self::Timestamps(timestamps) => {
                let mut encoder = encoder();
                for (index, steps) in passes.iter().enumerate() {
                    let writes = timestamps.writes(index as u32);
                    record(&mut encoder, steps, Some(writes));
                }
                timestamps.resolve(&mut encoder, passes.len() as u32);
                device.queue().submit([encoder.finish()]);
                let mut times = timestamps.read(device).await?;
                times.truncate(passes.len());
                Ok(times)
            }
            Self::Wall => {
                let mut times = Vec::new();
                for steps in passes {
                    let start = now_ms();
                    let mut encoder = encoder();
                    record(&mut encoder, steps, None);
                    device.queue().submit([encoder.finish()]);
                    device.wait_async().await?;
                    times.push(now_ms() - start);
                }
                Ok(times)
            }
        }
    }
}

/// Times at which passes begin and end, and how they come back.
pub(super) struct Timestamps {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    period_ms: f64,
}

impl Timestamps {
    fn new(device: &Device, passes: u32) -> Result<Self, GpuError> {
        let count = 2 * passes.max(1);
        device.scoped(|| {
            let buffer = |usage| {
                device.wgpu().create_buffer(&wgpu::BufferDescriptor {
                    label: Some("timestamps"),
                    size: u64::from(count) * 8,
                    usage,
                    mapped_at_creation: false,
                })
            };
            Ok(Self {
                queries: device.wgpu().create_query_set(&wgpu::QuerySetDescriptor {
                    label: Some("timestamps"),
                    ty: wgpu::QueryType::Timestamp,
                    count,
                }),
                resolved: buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC),
                staging: buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
                period_ms: f64::from(device.queue().get_timestamp_period()) * 1e-6,
            })
        })
    }

    /// For the pass of this index.
    pub fn writes(&self, pass: u32) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * pass),
            end_of_pass_write_index: Some(2 * pass + 1),
        }
    }

    /// Records that the times of the first `passes` passes are to come back.
    pub fn resolve(&self, encoder: &mut wgpu::CommandEncoder, passes: u32) {
        encoder.resolve_query_set(&self.queries, 0..2 * passes, &self.resolved, 0);
        let size = u64::from(passes) * 16;
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, size);
    }

    /// Milliseconds of each pass. Waits for what was submitted before.
    pub async fn read(&self, device: &Device) -> Result<Vec<f64>, GpuError> {
        let times = device.read_async(&self.staging, |bytes| {
            let times: Vec<[u64; 2]> = bytemuck::pod_collect_to_vec(bytes);
            let span = |[begin, end]: [u64; 2]| end.saturating_sub(begin) as f64 * self.period_ms;
            times.into_iter().map(span).collect()
        });
        times.await
    }
}
