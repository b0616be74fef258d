use super::step::{Step, StepDescriptor, Work};
use super::tensor::storage_buffer;
use super::{Device, GpuError};

/// Multiply-adds in registers (`shaders/probe_arithmetic.wgsl`): what an adapter's arithmetic can reach.
#[derive(Debug)]
pub struct ArithmeticProbe {
    params: wgpu::Buffer,
    step: Step,
}

impl ArithmeticProbe {
    /// Enough invocations to fill the largest GPUs.
    const WORKGROUPS: usize = 4096;
    /// In a round of an invocation, as in the kernel.
    const MULTIPLY_ADDS: u64 = 64;

    /// Compiles the kernel.
    ///
    /// # Errors
    /// A driver's refusal.
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        let what = "arithmetic probe";
        device.scoped(|| {
            let params = storage_buffer(device, what, 12)?;
            let output = storage_buffer(device, what, 64 * 16 * Self::WORKGROUPS as u64)?;
            let step = Step::new(
                device,
                &StepDescriptor {
                    label: what,
                    kernel: "probe_arithmetic",
                    source: include_str!("../../shaders/probe_arithmetic.wgsl"),
                    entry_point: "main",
                    constants: &[],
                    bindings: &[
                        (0, params.as_entire_binding()),
                        (1, output.as_entire_binding()),
                    ],
                    workgroups: Self::WORKGROUPS,
                    work: Work::default(),
                },
            )?;
            Ok(Self { params, step })
        })
    }

    /// The dispatch, of so many rounds from the next submission on, and what it has to do.
    pub fn step(&self, device: &Device, rounds: u32) -> (&Step, Work) {
        // Values that neither grow nor vanish.
        let params = [0.5_f32.to_bits(), 1_f32.to_bits(), rounds];
        let bytes = bytemuck::cast_slice(&params);
        device.queue().write_buffer(&self.params, 0, bytes);
        let invocations = 64 * Self::WORKGROUPS as u64;
        let work = Work {
            operations: 2 * Self::MULTIPLY_ADDS * u64::from(rounds) * invocations,
            bytes: 16 * invocations,
        };
        (&self.step, work)
    }
}

/// A copy from buffer to buffer (`shaders/probe_copy.wgsl`), larger than caches: what an adapter's
/// memory can reach.
///
/// # Errors
/// A driver's refusal, or too little memory.
pub fn copy_probe(device: &Device) -> Result<Step, GpuError> {
    const SIZE: u64 = 64 << 20;
    let limits = device.wgpu().limits();
    let size = SIZE
        .min(limits.max_storage_buffer_binding_size)
        .min(limits.max_buffer_size);
    let length = size / 16;
    let what = "copy probe";
    device.scoped(|| {
        let input = storage_buffer(device, what, 16 * length)?;
        let output = storage_buffer(device, what, 16 * length)?;
        Step::new(
            device,
            &StepDescriptor {
                label: what,
                kernel: "probe_copy",
                source: include_str!("../../shaders/probe_copy.wgsl"),
                entry_point: "main",
                constants: &[("LENGTH", length as f64)],
                bindings: &[
                    (0, input.as_entire_binding()),
                    (1, output.as_entire_binding()),
                ],
                workgroups: (length as usize).div_ceil(64),
                work: Work {
                    operations: 0,
                    bytes: 32 * length,
                },
            },
        )
    })
}
