// A convolution between buffers of halves as a product of matrices in tiles of 16 x 16, behind
// `conv2d_planes` and what multiplies tiles, in subgroups of 32. Factors are halves, sums f32.
//
// A workgroup makes a tile of ROWS x WIDE pixels of an image in WAYS times 32 output channels. It goes by
// stages: STEP blocks of input channels, one row of the kernel, SPAN of the row's taps. Of a stage it brings
// the pixels that any of the taps sees, each once, and the weights to workgroup memory; meanwhile the next
// stage's are on their way to registers. A subgroup makes 32 of the pixels in 32 channels, as four tiles of
// sums, from a SPLITth of the stage's input channels.

const GROUP = ROWS * WIDE * WAYS * SPLIT;
// Blocks of output channels.
const BLOCKS = 8u * WAYS;
// Rows in workgroup memory are a little longer than full, so that they do not begin in the same bank.
const VALUES_STRIDE = STEP + 2u;
const TAPS_STRIDE = BLOCKS + 2u;
const SUMS_STRIDE = 5u;
const SUMS_TILE = 16u * SUMS_STRIDE;
// What a stage brings, in pairs of blocks and in fours.
const VALUES = STEP / 2u * ROWS * SEGMENT;
const WEIGHTS = SPAN * STEP * 4u * BLOCKS;

override STEPS: u32 = (IN_BLOCKS + STEP - 1u) / STEP;
override SPANS: u32 = KERNEL / SPAN;
override STAGES: u32 = KERNEL * SPANS * STEPS;
override TILES_ACROSS: u32 = (WIDTH + WIDE - 1u) / WIDE;
override TILES: u32 = TILES_ACROSS * ((HEIGHT + ROWS - 1u) / ROWS);
override BLOCK_GROUPS: u32 = (OUT_BLOCKS + BLOCKS - 1u) / BLOCKS;

// [row][column of the segment][in channel]
var<workgroup> values: array<vec4<Half>, ROWS * SEGMENT * VALUES_STRIDE>;
// [tap][in channel][out channel]
var<workgroup> taps: array<vec4<Half>, SPAN * STEP * 4u * TAPS_STRIDE>;
// [subgroup][pixel][out channel]
var<workgroup> sums: array<vec4<f32>, GROUP / 32u * SUMS_TILE>;

var<private> local: u32;
// Which SPLITth of the input channels the subgroup has.
var<private> part: u32;
// Of the workgroup.
var<private> image: u32;
var<private> block_group: u32;
var<private> corner: vec2<u32>;

// Eight channels of a pixel, from two blocks.
struct Value {
    low: vec4<Half>,
    high: vec4<Half>,
}

// A pixel of a stage; `index` is [pair of in blocks][row][column of the segment].
fn value(stage: u32, index: u32) -> Value {
    let block = stage % STEPS * STEP + index / (ROWS * SEGMENT) * 2u;
    let tap = vec2(stage / STEPS % SPANS * SPAN, stage / (STEPS * SPANS));
    let pixel = corner + vec2(index % SEGMENT, index / SEGMENT % ROWS) + tap * DILATION;
    let at = vec2<i32>(pixel) - i32(KERNEL / 2u * DILATION);
    var found = Value();
    if index < VALUES && is_inside(at) {
        if block < IN_BLOCKS {
            found.low = seen(block * BATCH + image, vec2<u32>(at));
        }
        if block + 1u < IN_BLOCKS {
            found.high = seen((block + 1u) * BATCH + image, vec2<u32>(at));
        }
    }
    return found;
}

fn seen(plane: u32, at: vec2<u32>) -> vec4<Half> {
    if INPUT_FULL {
        return vec4<Half>(input_at(plane, at.y, at.x));
    }
    return texel_at((plane * INPUT_HEIGHT + at.y) * INPUT_WIDTH + at.x);
}

// Writes a tile of sums: of 16 pixels from `first` of the workgroup's on, in four blocks from `block` on.
// The subgroups that have parts of it share the work.
fn finish(first: u32, block: u32) {
    let subgroup = local / 32u - part;
    for (var texel = part * 32u + local % 32u; texel < 64u; texel += 32u * SPLIT) {
        let out_block = block_group * BLOCKS + block + texel / 16u;
        var sum = bias[out_block];
        for (var other = 0u; other < SPLIT; other++) {
            sum += sums[(subgroup + other) * SUMS_TILE + texel % 16u * SUMS_STRIDE + texel / 16u];
        }
        let pixel = first + texel % 16u;
        let at = corner + vec2(pixel % WIDE, pixel / WIDE);
        if all(at < vec2(WIDTH, HEIGHT)) && out_block < OUT_BLOCKS {
            output_set(out_block * BATCH + image, at.y, at.x, activate(sum));
        }
    }
}

@compute @workgroup_size(GROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    local = index;
    let workgroup = group.y * groups.x + group.x;
    block_group = workgroup % BLOCK_GROUPS;
    let tile = workgroup / BLOCK_GROUPS % TILES;
    corner = vec2(tile % TILES_ACROSS * WIDE, tile / TILES_ACROSS * ROWS);
    image = workgroup / (BLOCK_GROUPS * TILES) % BATCH;

    let subgroup = local / 32u;
    part = subgroup % SPLIT;
    let way = subgroup / SPLIT % WAYS;
    let upper = subgroup / (SPLIT * WAYS) * 32u;
    let lower = upper + 16u;

    var next_values: array<Value, VALUES_EACH>;
    var next_taps: array<vec4<Half>, WEIGHTS_EACH>;
    let first_weight = block_group * STAGES * WEIGHTS;
    for (var n = 0u; n < VALUES_EACH; n++) {
        next_values[n] = value(0u, n * GROUP + local);
    }
    for (var n = 0u; n < WEIGHTS_EACH; n++) {
        next_taps[n] = weight_at(first_weight + min(n * GROUP + local, WEIGHTS - 1u));
    }

    for (var i = local; i < SUMS_TILE; i += GROUP) {
        sums[i] = vec4(0.0);
    }
    workgroupBarrier();
    var upper_left = sums_at(0u);
    var upper_right = sums_at(0u);
    var lower_left = sums_at(0u);
    var lower_right = sums_at(0u);

    let first_above = (upper / WIDE * SEGMENT + upper % WIDE) * VALUES_STRIDE;
    let first_below = (lower / WIDE * SEGMENT + lower % WIDE) * VALUES_STRIDE;
    for (var stage = 0u; stage < STAGES; stage++) {
        workgroupBarrier();
        for (var n = 0u; n < VALUES_EACH; n++) {
            let i = n * GROUP + local;
            if i < VALUES {
                let to = i % (ROWS * SEGMENT) * VALUES_STRIDE + i / (ROWS * SEGMENT) * 2u;
                values[to] = next_values[n].low;
                values[to + 1u] = next_values[n].high;
            }
        }
        for (var n = 0u; n < WEIGHTS_EACH; n++) {
            let i = n * GROUP + local;
            if i < WEIGHTS {
                taps[i / BLOCKS * TAPS_STRIDE + i % BLOCKS] = next_taps[n];
            }
        }
        workgroupBarrier();
        if stage + 1u < STAGES {
            for (var n = 0u; n < VALUES_EACH; n++) {
                next_values[n] = value(stage + 1u, n * GROUP + local);
            }
            let first = first_weight + (stage + 1u) * WEIGHTS;
            for (var n = 0u; n < WEIGHTS_EACH; n++) {
                next_taps[n] = weight_at(first + min(n * GROUP + local, WEIGHTS - 1u));
            }
        }
        for (var tap = 0u; tap < SPAN; tap++) {
            for (var k = 0u; k < SHARE; k++) {
                let depth = part * SHARE + k;
                let shift = tap * DILATION * VALUES_STRIDE + 4u * depth;
                let weight = (tap * STEP * 4u + 16u * depth) * TAPS_STRIDE + 8u * way;
                let above = values_at(first_above + shift);
                let below = values_at(first_below + shift);
                let left = taps_at(weight);
                let right = taps_at(weight + 4u);
                upper_left = multiply_add(above, left, upper_left);
                upper_right = multiply_add(above, right, upper_right);
                lower_left = multiply_add(below, left, lower_left);
                lower_right = multiply_add(below, right, lower_right);
            }
        }
    }

    let own = subgroup * SUMS_TILE;
    keep(upper_left, own);
    workgroupBarrier();
    finish(upper, 8u * way);
    workgroupBarrier();
    keep(upper_right, own);
    workgroupBarrier();
    finish(upper, 8u * way + 4u);
    workgroupBarrier();
    keep(lower_left, own);
    workgroupBarrier();
    finish(lower, 8u * way);
    workgroupBarrier();
    keep(lower_right, own);
    workgroupBarrier();
    finish(lower, 8u * way + 4u);
}
