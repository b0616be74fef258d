use super::{Conv2d, planes};
use crate::gpu::step::Step;
use crate::gpu::tensor::{blocks, constant_halves};
use crate::gpu::{Device, GpuError};

/// Blocks of four output channels that a subgroup makes, of 32 pixels.
const BLOCKS: usize = 8;

/// `shaders/conv2d_cooperative.wgsl`: convolutions between buffers of halves on matrix units, `pixels` (32, 64
/// or 128) a workgroup. It serves every one, but multiplies full tiles: of 16 input and 32 output channels.
pub fn cooperative(device: &Device, conv: &Conv2d<'_>, pixels: usize) -> Result<Step, GpuError> {
    let units = include_str!("../../../shaders/conv2d_cooperative.wgsl");
    matrix(device, conv, pixels, units)
}

/// Workgroups that this takes.
pub fn workgroups(device: &Device, conv: &Conv2d<'_>, pixels: usize) -> usize {
    Cut::new(device, conv, pixels).workgroups(conv)
}

/// How `shaders/conv2d_matrix.wgsl` cuts a layer: its sizes, named as there.
struct Cut {
    wide: usize,
    rows: usize,
    step: usize,
    split: usize,
    ways: usize,
    span: usize,
    segment: usize,
}

impl Cut {
    fn new(device: &Device, conv: &Conv2d<'_>, pixels: usize) -> Self {
        let memory = device.wgpu().limits().max_compute_workgroup_storage_size as usize;
        let in_blocks = blocks(conv.input.shape.channels);
        let out_blocks = blocks(conv.output.shape.channels);
        let few = pixels == 32;
        let most = if few { 16 } else { 8 };
        let step = in_blocks.next_power_of_two().clamp(4, most);
        let wide = conv.output.shape.width.next_power_of_two();
        let wide = wide.clamp(16, pixels);
        let one_tap = Self {
            wide,
            rows: pixels / wide,
            step,
            // Few pixels are for layers with too few workgroups: more subgroups share a sum.
            split: if few { step / 4 } else { 1 },
            // Many are for those with enough: what a workgroup brings serves more channels.
            ways: if pixels == 128 && out_blocks > BLOCKS {
                2
            } else {
                1
            },
            span: 1,
            segment: wide,
        };
        let row = Self {
            span: conv.kernel,
            segment: wide + (conv.kernel - 1) * conv.dilation,
            ..one_tap
        };
        // Taps farther apart than a segment is long share no pixels.
        if row.segment <= wide * conv.kernel && row.memory() <= memory {
            row
        } else {
            one_tap
        }
    }

    /// Output channels of a workgroup.
    fn channels(&self) -> usize {
        4 * BLOCKS * self.ways
    }

    /// How many workgroups make the channels of a pixel.
    fn groups(&self, conv: &Conv2d<'_>) -> usize {
        conv.output.shape.channels.div_ceil(self.channels())
    }

    fn workgroups(&self, conv: &Conv2d<'_>) -> usize {
        let shape = conv.output.shape;
        let tiles = shape.width.div_ceil(self.wide) * shape.height.div_ceil(self.rows);
        conv.output.batch * tiles * self.groups(conv)
    }

    /// Invocations of a workgroup.
    fn group(&self) -> usize {
        self.rows * self.wide * self.ways * self.split
    }

    /// Pairs of blocks of values, and fours of weights, that a stage brings.
    fn stage(&self) -> [usize; 2] {
        [
            self.step / 2 * self.rows * self.segment,
            self.span * self.step * 4 * BLOCKS * self.ways,
        ]
    }

    /// Bytes of workgroup memory.
    fn memory(&self) -> usize {
        let values = 8 * self.rows * self.segment * (self.step + 2);
        let taps = 8 * self.span * self.step * 4 * (BLOCKS * self.ways + 2);
        let sums = 16 * self.group() / 32 * 16 * 5;
        values + taps + sums
    }
}

/// A step of `shaders/conv2d_matrix.wgsl` with `units` in front, which multiply its tiles.
fn matrix(
    device: &Device,
    conv: &Conv2d<'_>,
    pixels: usize,
    units: &str,
) -> Result<Step, GpuError> {
    let cut = Cut::new(device, conv, pixels);
    let [values, weights] = cut.stage();
    let channels = cut.channels();
    let groups = cut.groups(conv);
    let steps = blocks(conv.input.shape.channels).div_ceil(cut.step);
    let spans = conv.kernel / cut.span;
    let stages = conv.kernel * spans * steps;
    // [group of output channels][kernel row][span][step][tap of the span][in channel][out channel]
    let packed = conv.packed(groups * stages * 4 * weights, |[o, i, row, column]| {
        let stage = (row * spans + column / cut.span) * steps + i / (4 * cut.step);
        let of_stage = column % cut.span * 4 * cut.step + i % (4 * cut.step);
        (o / channels * stages + stage) * 4 * weights + of_stage * channels + o % channels
    });
    let packed = constant_halves(device, &format!("{}: weight", conv.label), &packed)?;
    let shared = concat!(
        include_str!("../../../shaders/conv2d_planes.wgsl"),
        include_str!("../../../shaders/conv2d_matrix.wgsl")
    );
    planes(
        device,
        conv,
        ("conv2d_cooperative", &format!("{units}{shared}")),
        &[
            ("WIDE", cut.wide),
            ("ROWS", cut.rows),
            ("STEP", cut.step),
            ("SPLIT", cut.split),
            ("SHARE", cut.step / 4 / cut.split),
            ("WAYS", cut.ways),
            ("SPAN", cut.span),
            ("SEGMENT", cut.segment),
            ("VALUES_EACH", values.div_ceil(cut.group())),
            ("WEIGHTS_EACH", weights.div_ceil(cut.group())),
        ],
        &[(3, packed.as_entire_binding()), (5, conv.input.resource())],
        groups * BLOCKS * cut.ways,
        cut.workgroups(conv),
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
        struct Sums { low: vec4<f32>, high: vec4<f32> }
        @group(0) @binding(3) var<storage, read> weights: array<vec2<u32>>;
        @group(0) @binding(5) var<storage, read> texels: array<vec2<u32>>;
        fn weight_at(index: u32) -> vec4<f32> { return from_halves(weights[index]); }
        fn texel_at(index: u32) -> vec4<f32> { return from_halves(texels[index]); }
        fn values_at(first: u32) -> u32 { return first; }
        fn taps_at(first: u32) -> u32 { return first; }
        fn row() -> u32 { return local % 32u / 2u; }
        fn half() -> u32 { return local % 2u * 2u; }
        fn sums_at(first: u32) -> Sums {
            let at = first + row() * SUMS_STRIDE + half();
            return Sums(sums[at], sums[at + 1u]);
        }
        fn multiply_add(a: u32, b: u32, c: Sums) -> Sums {
            var sum = c;
            for (var k = 0u; k < MIDDLE; k++) {
                let value = values[a + row() * VALUES_STRIDE + k / 4u][k % 4u];
                let at = b + k * TAPS_STRIDE + half();
                sum = Sums(sum.low + value * taps[at], sum.high + value * taps[at + 1u]);
            }
            return sum;
        }
        fn keep(tile: Sums, first: u32) {
            let at = first + row() * SUMS_STRIDE + half();
            sums[at] = tile.low;
            sums[at + 1u] = tile.high;
        }
        const MIDDLE = 16u;
    ";

    /// A layer of `channels` to `out_channels` of such a size.
    #[derive(Debug, Clone, Copy)]
    struct Case {
        channels: usize,
        out_channels: usize,
        size: [usize; 2],
        kernel: usize,
        dilation: usize,
    }

    /// The greatest difference between the kernel and `buffer` on random numbers.
    fn difference(case: Case, pixels: usize, units: &str) -> f32 {
        let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
        let [height, width] = case.size;
        let shape = Shape::new(case.channels, height, width);
        let out = Shape::new(case.out_channels, height, width);
        let tensor = |what, shape| {
            Tensor::in_layout(&device, Layout::HalfBuffer, what, shape, 2, 0).unwrap()
        };
        let (input, output) = (tensor("input", shape), tensor("output", out));
        // Numbers that halves can hold.
        let number = |i: usize| ((i * 7919 + i / 3) % 129) as f32 / 64.0 - 1.0;
        let values: Vec<f32> = (0..2 * shape.len()).map(number).collect();
        input.write(&device, &values).unwrap();
        let weights = case.out_channels * case.channels * case.kernel * case.kernel;
        let parameters = Parameters {
            weight: (0..weights).map(number).collect(),
            bias: (0..case.out_channels).map(number).collect(),
        };
        let conv = Conv2d {
            label: "layer",
            input: &input,
            output: &output,
            parameters: &parameters,
            kernel: case.kernel,
            dilation: case.dilation,
            activation: Activation::Relu,
            pool: None,
        };
        let run = |step: Step| {
            let mut encoder = device.wgpu().create_command_encoder(&Default::default());
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            device.queue().submit([encoder.finish()]);
            output.read(&device).unwrap()
        };
        let made = device.scoped(|| matrix(&device, &conv, pixels, units));
        let found = run(made.unwrap());
        let expected = run(device
            .scoped(|| super::super::buffer(&device, &conv))
            .unwrap());
        let differences = found.iter().zip(&expected).map(|(a, b)| (a - b).abs());
        differences.fold(0.0, f32::max)
    }

    fn case(
        channels: usize,
        out_channels: usize,
        size: [usize; 2],
        kernel: usize,
        dilation: usize,
    ) -> Case {
        Case {
            channels,
            out_channels,
            size,
            kernel,
            dilation,
        }
    }

    #[test]
    fn tiles_are_put_together_right() {
        let cases = [
            (case(3, 32, [11, 13], 3, 1), 128),
            (case(16, 5, [11, 13], 1, 1), 32),
            // Several steps and groups of channels.
            (case(33, 40, [11, 13], 3, 2), 64),
            (case(33, 40, [11, 13], 3, 2), 128),
            (case(70, 33, [9, 40], 3, 4), 32),
            // Taps too far apart to share a segment.
            (case(20, 33, [11, 13], 3, 30), 32),
            // Several tiles in a row.
            (case(8, 8, [3, 150], 3, 7), 64),
            // Full tensors.
            (case(8, 8, [1, 1], 3, 1), 64),
        ];
        for (case, pixels) in cases {
            let found = difference(case, pixels, BY_HAND);
            assert!(found <= 0.05, "{case:?}, {pixels}: {found}");
        }
        // Negative control: one element of a product is left out.
        let wrong = BY_HAND.replace("MIDDLE = 16u", "MIDDLE = 15u");
        assert!(difference(case(33, 40, [11, 13], 3, 2), 64, &wrong) > 0.5);
    }
}
