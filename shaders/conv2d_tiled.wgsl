// A convolution between buffers as a product of matrices, through workgroup memory, behind
// `conv2d_planes`: for GPUs.
//
// A workgroup makes TILE pixels of an image, as they come row after row, in BLOCKS blocks of four output
// channels. It goes by stages: of each tap it brings STEP blocks of input channels and their weights to workgroup
// memory, while the next stage's are on their way to registers. Its invocations share them: each makes PIXELS pixels, LANES apart, in a pair of blocks, and
// reads from there two texels for sixteen multiply-adds each.

const GROUP = 64u;
const LANES = GROUP / PAIRS;
const TILE = LANES * PIXELS;
const BLOCKS = 2u * PAIRS;
// Not written out, as loops to a size are: long enough as it is.
const DEPTH = STEP;

// What a stage brings.
const VALUES = STEP * TILE;
const TAPS = STEP * BLOCKS * 4u;

override STEPS: u32 = (IN_BLOCKS + STEP - 1u) / STEP;
override STAGES: u32 = KERNEL * KERNEL * STEPS;
override TILES: u32 = (HEIGHT * WIDTH + TILE - 1u) / TILE;
override BLOCK_GROUPS: u32 = (OUT_BLOCKS + BLOCKS - 1u) / BLOCKS;

// [kernel row][kernel column][in block, to full steps][out block, to full groups][in channel] of four
// outputs
@group(0) @binding(3) var<storage, read> weights: array<vec4<f32>>;

// [in block][pixel]
var<workgroup> values: array<vec4<f32>, VALUES>;
// [in block][out block][in channel] of four outputs
var<workgroup> taps: array<vec4<f32>, TAPS>;

// Of the workgroup.
var<private> image: u32;
var<private> first_block: u32;
var<private> first_pixel: u32;

// Number `index` of what a stage brings.
fn value(stage: u32, index: u32) -> vec4<f32> {
    let block = stage % STEPS * STEP + index / TILE;
    let at = seen_from(first_pixel + index % TILE, stage / STEPS);
    if index < VALUES && block < IN_BLOCKS && is_inside(at) {
        return input_at(block * BATCH + image, u32(at.y), u32(at.x));
    }
    return vec4(0.0);
}

fn weight(stage: u32, index: u32) -> vec4<f32> {
    let i = min(index, TAPS - 1u);
    let row = (stage * STEP + i / (BLOCKS * 4u)) * BLOCK_GROUPS * BLOCKS + first_block;
    return weights[row * 4u + i % (BLOCKS * 4u)];
}

fn matrix(first: u32) -> mat4x4<f32> {
    return mat4x4(taps[first], taps[first + 1u], taps[first + 2u], taps[first + 3u]);
}

@compute @workgroup_size(GROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let workgroup = group.y * groups.x + group.x;
    first_block = workgroup % BLOCK_GROUPS * BLOCKS;
    first_pixel = workgroup / BLOCK_GROUPS % TILES * TILE;
    image = workgroup / (BLOCK_GROUPS * TILES) % BATCH;
    let lane = local % LANES;
    let pair = local / LANES;
    let low_block = first_block + 2u * pair;
    let high_block = low_block + 1u;

    var low: array<vec4<f32>, PIXELS>;
    var high: array<vec4<f32>, PIXELS>;
    for (var i = 0u; i < PIXELS; i++) {
        low[i] = bias[low_block];
        high[i] = bias[high_block];
    }

    var next_values: array<vec4<f32>, VALUES_EACH>;
    var next_taps: array<vec4<f32>, TAPS_EACH>;
    for (var n = 0u; n < VALUES_EACH; n++) {
        next_values[n] = value(0u, n * GROUP + local);
    }
    for (var n = 0u; n < TAPS_EACH; n++) {
        next_taps[n] = weight(0u, n * GROUP + local);
    }
    for (var stage = 0u; stage < STAGES; stage++) {
        workgroupBarrier();
        for (var n = 0u; n < VALUES_EACH; n++) {
            if n * GROUP + local < VALUES {
                values[n * GROUP + local] = next_values[n];
            }
        }
        for (var n = 0u; n < TAPS_EACH; n++) {
            if n * GROUP + local < TAPS {
                taps[n * GROUP + local] = next_taps[n];
            }
        }
        workgroupBarrier();
        if stage + 1u < STAGES {
            for (var n = 0u; n < VALUES_EACH; n++) {
                next_values[n] = value(stage + 1u, n * GROUP + local);
            }
            for (var n = 0u; n < TAPS_EACH; n++) {
                next_taps[n] = weight(stage + 1u, n * GROUP + local);
            }
        }
        for (var block = 0u; block < DEPTH; block++) {
            let weight_low = matrix((block * BLOCKS + 2u * pair) * 4u);
            let weight_high = matrix((block * BLOCKS + 2u * pair + 1u) * 4u);
            for (var i = 0u; i < PIXELS; i++) {
                let texel = values[block * TILE + i * LANES + lane];
                low[i] += weight_low * texel;
                high[i] += weight_high * texel;
            }
        }
    }

    for (var i = 0u; i < PIXELS; i++) {
        let pixel = first_pixel + i * LANES + lane;
        if pixel < HEIGHT * WIDTH {
            if low_block < OUT_BLOCKS {
                output_set(low_block * BATCH + image, pixel / WIDTH, pixel % WIDTH, activate(low[i]));
            }
            if high_block < OUT_BLOCKS {
                output_set(high_block * BATCH + image, pixel / WIDTH, pixel % WIDTH, activate(high[i]));
            }
        }
    }
}
