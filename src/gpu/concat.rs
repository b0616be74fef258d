use super::step::{Step, StepDescriptor};
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// The channels of `inputs` one after the other (`shaders/concat.wgsl`): a step for each.
pub(super) fn concat(
    device: &Device,
    label: &str,
    inputs: &[&Tensor],
    output: &Tensor,
) -> Result<Vec<Step>, GpuError> {
    let mut first = 0;
    inputs
        .iter()
        .map(|input| {
            let channels = input.shape.channels;
            let plane = input.shape.height * input.shape.width;
            let step = Step::new(
                device,
                &StepDescriptor {
                    label,
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
                    workgroups: (input.batch * channels * plane).div_ceil(64),
                },
            );
            first += channels;
            step
        })
        .collect()
}
