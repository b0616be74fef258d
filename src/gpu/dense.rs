use super::step::{Step, StepDescriptor, Work, activation_constant};
use super::tensor::{Tensor, constant_buffer, pack, storage_buffer};
use super::{Device, GpuError};
use crate::network::{Activation, Parameters};

/// A fully connected layer (`shaders/dense.wgsl`) as two steps: the sums of segments of the input,
/// then the sums of those. `parameters` are in PyTorch's order; `output` has shape `[out, 1, 1]`.
pub(super) fn dense(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    parameters: &Parameters,
    activation: Activation,
) -> Result<[Step; 2], GpuError> {
    let outputs = output.shape.channels;
    let length = input.texels() / input.batch;
    // Each row of the weight lies as the input does.
    let weights = pack(&parameters.weight, input.shape);
    let weights = constant_buffer(device, &format!("{label}: weight"), &weights)?;
    let bias = constant_buffer(device, &format!("{label}: bias"), &parameters.bias)?;
    // Some thousand texels a workgroup: enough to hide its reduction, and enough workgroups.
    let segments = length.div_ceil(2048);
    let sums = input.batch * outputs * segments;
    let partials = storage_buffer(device, &format!("{label}: partial sums"), 4 * sums as u64)?;
    let source = include_str!("../../shaders/dense.wgsl");
    let constants = &[
        ("LENGTH", length as f64),
        ("OUTPUTS", outputs as f64),
        ("BATCH", input.batch as f64),
        ("SEGMENTS", segments as f64),
        ("ACTIVATION", activation_constant(activation)),
    ];
    let partial = Step::new(
        device,
        &StepDescriptor {
            label,
            kernel: "dense",
            source,
            entry_point: "partial",
            constants,
            bindings: &[
                (0, input.buffer.as_entire_binding()),
                (1, weights.as_entire_binding()),
                (2, partials.as_entire_binding()),
            ],
            workgroups: sums,
            work: Work {
                operations: 2 * (input.batch * parameters.weight.len()) as u64,
                bytes: input.bytes() + 4 * (parameters.weight.len() + sums) as u64,
            },
        },
    )?;
    let finish = Step::new(
        device,
        &StepDescriptor {
            label,
            kernel: "dense",
            source,
            entry_point: "finish",
            constants,
            bindings: &[
                (2, partials.as_entire_binding()),
                (3, bias.as_entire_binding()),
                (4, output.buffer.as_entire_binding()),
            ],
            workgroups: (input.batch * outputs).div_ceil(64),
            work: Work {
                operations: 0,
                bytes: output.bytes() + 4 * (sums + parameters.bias.len()) as u64,
            },
        },
    )?;
    Ok([partial, finish])
}
