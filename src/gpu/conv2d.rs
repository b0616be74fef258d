use super::step::{Step, StepDescriptor, Work, activation_constant};
use super::tensor::{Tensor, blocks, constant_buffer};
use super::{Device, GpuError};
use crate::network::{Activation, Parameters};

/// Convolution with stride 1, dilation and zero padding 'same' (`shaders/conv2d.wgsl`): from `input`
/// to `output`, of the same height and width. `parameters` are in PyTorch's order.
pub(super) fn conv2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    parameters: &Parameters,
    (kernel, dilation, activation): (usize, usize, Activation),
) -> Result<Step, GpuError> {
    let in_channels = input.shape.channels;
    let weights = pack_weights(parameters, in_channels, kernel);
    let weights = constant_buffer(device, &format!("{label}: weight"), &weights)?;
    let bias = constant_buffer(device, &format!("{label}: bias"), &pad(&parameters.bias))?;
    let (height, width) = (output.shape.height, output.shape.width);
    let out_blocks = blocks(output.shape.channels);
    let tiles = width.div_ceil(COLUMNS);
    let invocations = output.batch * out_blocks.div_ceil(2) * height * tiles;
    Step::new(
        device,
        &StepDescriptor {
            label,
            kernel: "conv2d",
            source: include_str!("../../shaders/conv2d.wgsl"),
            entry_point: "main",
            constants: &[
                ("IN_BLOCKS", blocks(in_channels) as f64),
                ("OUT_BLOCKS", out_blocks as f64),
                ("HEIGHT", height as f64),
                ("WIDTH", width as f64),
                ("BATCH", output.batch as f64),
                ("KERNEL", kernel as f64),
                ("DILATION", dilation as f64),
                ("ACTIVATION", activation_constant(activation)),
            ],
            bindings: &[
                (0, input.buffer.as_entire_binding()),
                (1, weights.as_entire_binding()),
                (2, bias.as_entire_binding()),
                (3, output.buffer.as_entire_binding()),
            ],
            workgroups: invocations.div_ceil(64),
            work: Work::new(
                &[input],
                parameters.weight.len() + parameters.bias.len(),
                height * width * parameters.weight.len(),
                output,
            ),
        },
    )
}

/// Pixels an invocation makes, as in the kernel.
const COLUMNS: usize = 4;

/// From `[out][in][row][column]` to `[out block][row][column][in block]` of 4 x 4 matrices, a column
/// of four outputs for each input; zeros where a block is not full.
fn pack_weights(parameters: &Parameters, in_channels: usize, kernel: usize) -> Vec<f32> {
    let taps = kernel * kernel;
    let in_blocks = blocks(in_channels);
    let mut packed = vec![0.0; blocks(parameters.bias.len()) * taps * in_blocks * 16];
    for (index, weight) in parameters.weight.iter().enumerate() {
        let (tap, row) = (index % taps, index / taps);
        let (i, o) = (row % in_channels, row / in_channels);
        let matrix = (o / 4 * taps + tap) * in_blocks + i / 4;
        packed[matrix * 16 + i % 4 * 4 + o % 4] = *weight;
    }
    packed
}

/// Fills up the last block of four with zeros.
fn pad(bias: &[f32]) -> Vec<f32> {
    let mut padded = bias.to_vec();
    padded.resize(blocks(bias.len()) * 4, 0.0);
    padded
}
