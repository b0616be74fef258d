use bytemuck::{Pod, Zeroable};

use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::Tensor;
use super::{Device, GpuError};
use crate::network::Coverage;

/// One image's totals, as `shaders/coverage.wgsl` leaves them in a buffer cleared before.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Totals {
    pixels: u32,
    sure: u32,
    not_finite: u32,
    from_right: u32,
    from_bottom: u32,
    from_left: u32,
    from_top: u32,
}

impl Totals {
    /// What the totals of a mask of `width` x `height` say.
    pub fn coverage(&self, width: u32, height: u32) -> Coverage {
        Coverage {
            pixels: self.pixels,
            sure: self.sure,
            not_finite: self.not_finite,
            bbox: (self.pixels > 0).then(|| {
                [
                    width.saturating_sub(self.from_right),
                    height.saturating_sub(self.from_bottom),
                    self.from_left.saturating_sub(1),
                    self.from_top.saturating_sub(1),
                ]
            }),
        }
    }
}

/// Counts and bounds the pixels of each `mask` `[1, height, width]` that reach the thresholds
/// `(threshold, sure_threshold)`, into `totals`: one [`Totals`] an image, cleared before each run. Adds 1 to `runs`, a
/// `u32`.
///
/// # Errors
/// More pixels than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
pub fn coverage(
    device: &Device,
    mask: &Tensor,
    totals: &wgpu::Buffer,
    runs: &wgpu::Buffer,
    (threshold, sure_threshold): (f32, f32),
) -> Result<Step, GpuError> {
    Step::new(
        device,
        &StepDescriptor {
            label: "coverage",
            kernel: "coverage",
            source: include_str!("../../shaders/coverage.wgsl"),
            entry_point: "main",
            tensors: Tensors::from(mask),
            constants: &[
                ("THRESHOLD", f64::from(threshold)),
                ("SURE_THRESHOLD", f64::from(sure_threshold)),
            ],
            sizes: &[],
            bindings: &[
                (3, totals.as_entire_binding()),
                (4, runs.as_entire_binding()),
            ],
            workgroups: mask.batch * (mask.shape.height * mask.shape.width).div_ceil(256),
            work: Work {
                operations: 0,
                bytes: mask.bytes() + totals.size(),
            },
        },
    )
}
