use super::{Conv2d, planes};
use crate::gpu::step::Step;
use crate::gpu::tensor::blocks;
use crate::gpu::{Device, GpuError};

/// Pixels that a workgroup makes, and blocks of output channels, as in the kernel.
const TILE: usize = 128;
const BLOCKS: usize = 8;

/// `shaders/conv2d_cooperative.wgsl`: convolutions between buffers of halves on matrix units. It serves
/// every one, but multiplies full tiles: of 16 input and 32 output channels.
pub fn cooperative(device: &Device, conv: &Conv2d<'_>) -> Result<Step, GpuError> {
    matrix(
        device,
        conv,
        include_str!("../../../shaders/conv2d_cooperative.wgsl"),
    )
}

/// A step of `shaders/conv2d_matrix.wgsl` with `units` in front, which multiply its tiles.
fn matrix(device: &Device, conv: &Conv2d<'_>, units: &str) -> Result<Step, GpuError> {
    let output = conv.output;
    let step = if conv.input.shape.channels > 16 { 8 } else { 4 };
    let padded_in = blocks(conv.input.shape.channels).next_multiple_of(step);
    let padded_out = blocks(output.shape.channels).next_multiple_of(BLOCKS);
    let tiles = (output.shape.height * output.shape.width).div_ceil(TILE);
    let shared = concat!(
        include_str!("../../../shaders/conv2d_planes.wgsl"),
        include_str!("../../../shaders/conv2d_matrix.wgsl")
    );
    planes(
        device,
        conv,
        ("conv2d_cooperative", &format!("{units}{shared}")),
        &[("STEP", step)],
        &conv.packed_matrices(padded_in, padded_out),
        padded_out,
        output.batch * tiles * (padded_out / BLOCKS),
    )
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gpu::{AdapterRequest, Layout, Tensor};
    use crate::network::{Activation, Parameters, Shape};

    /// What multiplies tiles where there are no matrix units: each of 32 invocations has half a row.
    const BY_HAND: &str = "
        alias Half = f32;
        alias Sums = array<f32, 8>;
        fn values_at(first: u32) -> u32 { return first; }
        fn taps_at(first: u32) -> u32 { return first; }
        fn place() -> vec2<u32> { return vec2(local % 32u / 2u, local % 2u * 8u); }
        fn sums_at(first: u32) -> Sums {
            var c: Sums;
            for (var i = 0u; i < 8u; i++) { c[i] = sums[first + place().x * SUMS_STRIDE + place().y + i]; }
            return c;
        }
        fn multiply_add(a: u32, b: u32, sums: Sums) -> Sums {
            var c = sums;
            for (var i = 0u; i < 8u; i++) {
                for (var k = 0u; k < MIDDLE; k++) {
                    c[i] += values[a + place().x * VALUES_STRIDE + k] * taps[b + k * TAPS_STRIDE + place().y + i];
                }
            }
            return c;
        }
        fn keep(c: Sums, first: u32) {
            var tile = c;
            for (var i = 0u; i < 8u; i++) { sums[first + place().x * SUMS_STRIDE + place().y + i] = tile[i]; }
        }
        const MIDDLE = 16u;
    ";

    /// The greatest difference between the kernel and `buffer` on random numbers.
    fn difference(channels: usize, out_channels: usize, kernel: usize, units: &str) -> f32 {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let shape = Shape::new(channels, 11, 13);
        let out = Shape::new(out_channels, 11, 13);
        let tensor = |what, shape| {
            Tensor::in_layout(&device, Layout::HalfBuffer, what, shape, 2, 0).unwrap()
        };
        let (input, output) = (tensor("input", shape), tensor("output", out));
        // Numbers that halves can hold.
        let number = |i: usize| ((i * 7919 + i / 3) % 129) as f32 / 64.0 - 1.0;
        let values: Vec<f32> = (0..2 * shape.len()).map(number).collect();
        input.write(&device, &values).unwrap();
        let parameters = Parameters {
            weight: (0..out_channels * channels * kernel * kernel)
                .map(number)
                .collect(),
            bias: (0..out_channels).map(number).collect(),
        };
        let conv = Conv2d {
            label: "layer",
            input: &input,
            output: &output,
            parameters: &parameters,
            kernel,
            dilation: 2,
            activation: Activation::Relu,
        };
        let run = |step: Step| {
            let mut encoder = device.wgpu().create_command_encoder(&Default::default());
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            device.queue().submit([encoder.finish()]);
            output.read(&device).unwrap()
        };
        let found = run(device.scoped(|| matrix(&device, &conv, units)).unwrap());
        let expected = run(device
            .scoped(|| super::super::buffer(&device, &conv))
            .unwrap());
        let differences = found.iter().zip(&expected).map(|(a, b)| (a - b).abs());
        differences.fold(0.0, f32::max)
    }

    #[test]
    fn tiles_are_put_together_right() {
        for (channels, out_channels, kernel) in [(3, 32, 3), (16, 5, 1), (33, 40, 3), (20, 33, 5)] {
            let found = difference(channels, out_channels, kernel, BY_HAND);
            assert!(
                found <= 0.05,
                "{channels} to {out_channels}, {kernel}: {found}"
            );
        }
        // Negative control: one element of a product is left out.
        let wrong = BY_HAND.replace("MIDDLE = 16u", "MIDDLE = 15u");
        assert!(difference(33, 40, 3, &wrong) > 0.5);
    }
}
