use super::step::{Step, StepDescriptor};
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// Bilinear enlargement by `scale` (`shaders/upsample2d.wgsl`).
pub(super) fn upsample2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    scale: usize,
) -> Result<Step, GpuError> {
    Step::new(
        device,
        &StepDescriptor {
            label,
            source: include_str!("../../shaders/upsample2d.wgsl"),
            entry_point: "main",
            constants: &[
                (
                    "PLANES",
                    (input.batch * blocks(input.shape.channels)) as f64,
                ),
                ("IN_HEIGHT", input.shape.height as f64),
                ("IN_WIDTH", input.shape.width as f64),
                ("SCALE", scale as f64),
            ],
            bindings: &[
                (0, input.buffer.as_entire_binding()),
                (1, output.buffer.as_entire_binding()),
            ],
            workgroups: output.texels().div_ceil(64),
        },
    )
}
