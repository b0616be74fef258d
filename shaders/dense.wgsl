// A fully connected layer as a parallel reduction in two passes: the joint network's input is long
// (some hundred thousand values) and its output short.
//
// `partial` sums one segment of the input for one output; `finish` adds up the segments, the bias,
// and applies the activation. The input is read as vec4, block by block; the weights are packed to
// match.

override OUTPUTS: u32;
override SEGMENTS: u32;
// 0 none, 1 ReLU, 2 sigmoid
override ACTIVATION: u32;

// Length of an image's input, in vec4.
override PIXELS: u32 = INPUT_HEIGHT * INPUT_WIDTH;
override LENGTH: u32 = INPUT_PLANES / BATCH * PIXELS;
override SEGMENT: u32 = (LENGTH + SEGMENTS - 1u) / SEGMENTS;

// [output][LENGTH]
@group(0) @binding(3) var<storage, read> weights: array<vec4<f32>>;
// [image][output][segment]
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;
@group(0) @binding(5) var<storage, read> bias: array<f32>;

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
            let plane = i / PIXELS * BATCH + image;
            let pixel = i % PIXELS;
            let value = input_at(plane, pixel / INPUT_WIDTH, pixel % INPUT_WIDTH);
            sum += weights[row * LENGTH + i] * value;
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
    let plane = (group.y * groups.x + group.x) * 64u + local;
    if plane >= OUTPUT_PLANES {
        return;
    }
    let image = plane % BATCH;
    var texel = vec4(0.0);
    for (var lane = 0u; lane < 4u; lane++) {
        let row = plane / BATCH * 4u + lane;
        if row < OUTPUTS {
            var sum = bias[row];
            for (var segment = 0u; segment < SEGMENTS; segment++) {
                sum += partials[(image * OUTPUTS + row) * SEGMENTS + segment];
            }
            texel[lane] = sum;
        }
    }
    if ACTIVATION == 1u {
        texel = max(texel, vec4(0.0));
    } else if ACTIVATION == 2u {
        texel = 1.0 / (1.0 + exp(-texel));
    }
    output_set(plane, 0u, 0u, texel);
}
