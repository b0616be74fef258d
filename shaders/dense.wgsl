// A fully connected layer as a parallel reduction in two passes: the joint network's input is long
// (some hundred thousand values) and its output short.
//
// `partial` sums one segment of the input for one output; `finish` adds up the segments, the bias,
// and applies the activation. The input is read as vec4 in the order in which it lies; the weights
// are packed to match.

// Length of the input, in vec4.
override LENGTH: u32;
override OUTPUTS: u32;
override BATCH: u32;
override SEGMENTS: u32;
// 0 none, 1 ReLU, 2 sigmoid
override ACTIVATION: u32;

override SEGMENT: u32 = (LENGTH + SEGMENTS - 1u) / SEGMENTS;
// The output is [image][channel / 4] of vec4, seen here as its scalars.
override STRIDE: u32 = (OUTPUTS + 3u) / 4u * 4u;

@group(0) @binding(0) var<storage, read> input: array<vec4<f32>>;
// [output][LENGTH]
@group(0) @binding(1) var<storage, read> weights: array<vec4<f32>>;
// [image][output][segment]
@group(0) @binding(2) var<storage, read_write> partials: array<f32>;
@group(0) @binding(3) var<storage, read> bias: array<f32>;
@group(0) @binding(4) var<storage, read_write> output: array<f32>;

const LANES = 64u;
var<workgroup> sums: array<f32, LANES>;

@compute @workgroup_size(LANES)
fn partial(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let index = group.y * groups.x + group.x;
    let segment = index % SEGMENTS;
    let row = index / SEGMENTS % OUTPUTS;
    let image = index / (SEGMENTS * OUTPUTS);

    var sum = vec4(0.0);
    if image < BATCH {
        let end = min((segment + 1u) * SEGMENT, LENGTH);
        for (var i = segment * SEGMENT + lane; i < end; i += LANES) {
            sum += weights[row * LENGTH + i] * input[image * LENGTH + i];
        }
    }
    sums[lane] = sum.x + sum.y + sum.z + sum.w;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            sums[lane] += sums[lane + half];
        }
    }
    if lane == 0u && image < BATCH {
        partials[index] = sums[0];
    }
}

@compute @workgroup_size(64)
fn finish(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= BATCH * OUTPUTS {
        return;
    }
    let row = index % OUTPUTS;
    var sum = bias[row];
    for (var segment = 0u; segment < SEGMENTS; segment++) {
        sum += partials[index * SEGMENTS + segment];
    }
    if ACTIVATION == 1u {
        sum = max(sum, 0.0);
    } else if ACTIVATION == 2u {
        sum = 1.0 / (1.0 + exp(-sum));
    }
    output[index / OUTPUTS * STRIDE + row] = sum;
}
