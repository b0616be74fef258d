use super::step::Step;
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
            let step = Step::from_to(
                device,
                label,
                include_str!("../../shaders/concat.wgsl"),
                &[
                    ("PLANE", plane as f64),
                    ("BATCH", input.batch as f64),
                    ("CHANNELS", channels as f64),
                    ("FIRST", first as f64),
                    ("OUT_BLOCKS", blocks(output.shape.channels) as f64),
                ],
                (input, output),
                input.batch * (first % 4 + channels).div_ceil(4) * plane,
            );
            first += channels;
            step
        })
        .collect()
}
