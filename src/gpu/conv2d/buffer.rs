use super::Conv2d;
use crate::gpu::step::{Step, StepDescriptor, Tensors, activation_number};
use crate::gpu::tensor::{blocks, constant_buffer};
use crate::gpu::{Device, GpuError};

/// Pixels an invocation makes, as in the kernel.
const COLUMNS: usize = 4;

/// `shaders/conv2d_buffer.wgsl`: every convolution between buffers, on every adapter.
pub fn buffer(device: &Device, conv: &Conv2d<'_>) -> Result<Step, GpuError> {
    let Conv2d { label, output, .. } = *conv;
    let taps = conv.kernel * conv.kernel;
    let (in_blocks, out_blocks) = (
        blocks(conv.input.shape.channels),
        blocks(output.shape.channels),
    );
    // [out block][row][column][in block] of 4 x 4 matrices, a column of four outputs for each input.
    let weights = conv.packed(out_blocks * taps * in_blocks * 16, |[o, i, row, column]| {
        let matrix = (o / 4 * taps + row * conv.kernel + column) * in_blocks + i / 4;
        matrix * 16 + i % 4 * 4 + o % 4
    });
    let weights = constant_buffer(device, &format!("{label}: weight"), &weights)?;
    let bias = constant_buffer(
        device,
        &format!("{label}: bias"),
        &conv.padded_bias(out_blocks),
    )?;
    let tiles = output.shape.width.div_ceil(COLUMNS);
    let invocations = output.batch * out_blocks.div_ceil(2) * output.shape.height * tiles;
    Step::new(
        device,
        &StepDescriptor {
            label,
            kernel: "conv2d_buffer",
            source: include_str!("../../../shaders/conv2d_buffer.wgsl"),
            entry_point: "main",
            tensors: Tensors::from_to(conv.input, output),
            constants: &[
                ("KERNEL", conv.kernel as f64),
                ("DILATION", conv.dilation as f64),
                ("ACTIVATION", activation_number(conv.activation).into()),
            ],
            sizes: &[],
            bindings: &[
                (3, weights.as_entire_binding()),
                (4, bias.as_entire_binding()),
            ],
            workgroups: invocations.div_ceil(64),
            work: conv.work(),
        },
    )
}
