use super::step::{Step, StepDescriptor, Work};
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// The channels of `inputs` one after the other (`shaders/concat.wgsl`): a step for each.
pub(super) fn concat(
    device: &Device,
    label: &str,
    inputs: &[&Tensor],
    output: &Tensor,
) -> Result<Vec<Step>, GpuError> {
    let plane = output.shape.height * output.shape.width;
    let mut first = 0;
    inputs
        .iter()
        .map(|&input| {
            let channels = input.shape.channels;
            let invocations = input.batch * (first % 4 + channels).div_ceil(4) * plane;
            let step = Step::new(
                device,
                &StepDescriptor {
                    label,
                    kernel: "concat",
                    source: include_str!("../../shaders/concat.wgsl"),
                    entry_point: "main",
                    constants: &[
                        ("PLANE", plane as f64),
                        ("BATCH", input.batch as f64),
                        ("CHANNELS", channels as f64),
                        ("FIRST", first as f64),
                        ("OUT_BLOCKS", blocks(output.shape.channels) as f64),
                    ],
                    bindings: &[
                        (0, input.buffer.as_entire_binding()),
                        (1, output.buffer.as_entire_binding()),
                    ],
                    workgroups: invocations.div_ceil(64),
                    work: Work {
                        operations: 0,
                        bytes: 2 * input.bytes(),
                    },
                },
            );
            first += channels;
            step
        })
        .collect()
}
