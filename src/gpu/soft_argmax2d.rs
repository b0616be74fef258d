use super::step::{Step, StepDescriptor, Tensors, Work};
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
    let tensors = Tensors::both_to(heat, votes, output);
    Step::trusted(
        device,
        &StepDescriptor {
            label,
            kernel: "soft_argmax2d",
            source: include_str!("../../shaders/soft_argmax2d.wgsl"),
            entry_point: "main",
            tensors,
            constants: &[
                ("JOINTS", heat.shape.channels as f64),
                ("ORIGIN_X", origin[0].into()),
                ("ORIGIN_Y", origin[1].into()),
                ("STEP_X", step[0].into()),
                ("STEP_Y", step[1].into()),
            ],
            sizes: &[],
            bindings: &[],
            workgroups: output.planes(),
            work: Work::new(tensors, 0, 0),
        },
    )
}
