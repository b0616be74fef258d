use super::step::{Step, StepDescriptor, Tensors, Work, activation_number};
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
    // Each row of the weight lies as an image of the input does.
    let weights: Vec<f32> = parameters
        .weight
        .chunks_exact(input.shape.len())
        .flat_map(|row| pack(row, input.shape, 1))
        .collect();
    let weights = constant_buffer(device, &format!("{label}: weight"), &weights)?;
    let bias = constant_buffer(device, &format!("{label}: bias"), &parameters.bias)?;
    // Some hundred texels a workgroup: enough to hide its reduction, and workgroups for a large GPU.
    let segments = length.div_ceil(512);
    let sums = input.batch * outputs * segments;
    let partials = storage_buffer(device, &format!("{label}: partial sums"), 4 * sums as u64)?;
    let source = include_str!("../../shaders/dense.wgsl");
    let constants = &[
        ("OUTPUTS", outputs as f64),
        ("SEGMENTS", segments as f64),
        ("ACTIVATION", activation_number(activation).into()),
    ];
    let partial = Step::trusted(
        device,
        &StepDescriptor {
            label,
            kernel: "dense",
            source,
            entry_point: "partial",
            tensors: Tensors::from(input),
            constants,
            sizes: &[],
            bindings: &[
                (3, weights.as_entire_binding()),
                (4, partials.as_entire_binding()),
            ],
            workgroups: sums,
            work: Work::new(
                Tensors::from(input),
                parameters.weight.len() + sums,
                input.batch as u64 * parameters.weight.len() as u64,
            ),
        },
    )?;
    let finish = Step::trusted(
        device,
        &StepDescriptor {
            label,
            kernel: "dense",
            source,
            entry_point: "finish",
            tensors: Tensors::to(output),
            constants,
            sizes: &[],
            bindings: &[
                (4, partials.as_entire_binding()),
                (5, bias.as_entire_binding()),
            ],
            workgroups: output.planes().div_ceil(64),
            work: Work::new(Tensors::to(output), sums + parameters.bias.len(), 0),
        },
    )?;
    Ok([partial, finish])
}
