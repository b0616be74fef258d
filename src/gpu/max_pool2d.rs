use super::step::{Step, StepDescriptor};
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// Maximum over windows of `size` x `size`, side by side (`shaders/max_pool2d.wgsl`).
pub(super) fn max_pool2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    size: usize,
) -> Result<Step, GpuError> {
    Step::new(
        device,
        &StepDescriptor {
            label,
            source: include_str!("../../shaders/max_pool2d.wgsl"),
            entry_point: "main",
            constants: &[
                (
                    "PLANES",
                    (input.batch * blocks(input.shape.channels)) as f64,
                ),
                ("IN_HEIGHT", input.shape.height as f64),
                ("IN_WIDTH", input.shape.width as f64),
                ("SIZE", size as f64),
            ],
            bindings: &[
                (0, input.buffer.as_entire_binding()),
                (1, output.buffer.as_entire_binding()),
            ],
            workgroups: output.texels().div_ceil(64),
        },
    )
}
