use super::step::{Step, StepDescriptor, Work};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// Where each heat map's cells vote for, on average (`shaders/soft_argmax2d.wgsl`). `heat` has
/// shape `[joints, height, width]`, `votes` `[3 * joints, height, width]`, `output`
/// `[3 * joints, 1, 1]`.
pub(super) fn soft_argmax2d(
    device: &Device,
    label: &str,
    (heat, votes): (&Tensor, &Tensor),
    output: &Tensor,
    origin: [f32; 2],
    step: [f32; 2],
) -> Result<Step, GpuError> {
    let joints = heat.shape.channels;
    Step::new(
        device,
        &StepDescriptor {
            label,
            kernel: "soft_argmax2d",
            source: include_str!("../../shaders/soft_argmax2d.wgsl"),
            entry_point: "main",
            constants: &[
                ("JOINTS", joints as f64),
                ("BATCH", heat.batch as f64),
                ("HEIGHT", heat.shape.height as f64),
                ("WIDTH", heat.shape.width as f64),
                ("ORIGIN_X", origin[0].into()),
                ("ORIGIN_Y", origin[1].into()),
                ("STEP_X", step[0].into()),
                ("STEP_Y", step[1].into()),
            ],
            bindings: &[
                (0, heat.buffer.as_entire_binding()),
                (1, votes.buffer.as_entire_binding()),
                (2, output.buffer.as_entire_binding()),
            ],
            workgroups: heat.batch * joints,
            work: Work::new(&[heat, votes], 0, 0, output),
        },
    )
}
