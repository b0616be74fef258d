// A convolution between buffers as a product of matrices, through workgroup memory, behind
// `conv2d_planes`: for GPUs.
//
// A workgroup makes TILE pixels of an image, as they come row after row, in BLOCKS blocks of four output
// channels. Of each tap it brings STEP blocks of input channels and their weights to workgroup memory,
// where its invocations share them: each makes PIXELS pixels, LANES apart, in a pair of blocks, and
// reads from there two texels for sixteen multiply-adds each.

const GROUP = 64u;
const LANES = GROUP / PAIRS;
const TILE = LANES * PIXELS;
const BLOCKS = 2u * PAIRS;
// Not written out, as loops to a size are: long enough as it is.
const DEPTH = STEP;

override STEPS: u32 = (IN_BLOCKS + STEP - 1u) / STEP;
override TILES: u32 = (HEIGHT * WIDTH + TILE - 1u) / TILE;
override BLOCK_GROUPS: u32 = (OUT_BLOCKS + BLOCKS - 1u) / BLOCKS;

// [kernel row][kernel column][in block, to full steps][out block, to full groups][in channel] of four
// outputs
@group(0) @binding(3) var<storage, read> weights: array<vec4<f32>>;

// [in block][pixel]
var<workgroup> values: array<vec4<f32>, STEP * TILE>;
// [in block][out block][in channel] of four outputs
var<workgroup> taps: array<vec4<f32>, STEP * BLOCKS * 4u>;

// What a tap sees of a block of channels from `pixel`.
fn seen(image: u32, block: u32, pixel: u32, tap: u32) -> vec4<f32> {
    let at = seen_from(pixel, tap);
    if block < IN_BLOCKS && is_inside(at) {
        return input_at(block * BATCH + image, u32(at.y), u32(at.x));
    }
    return vec4(0.0);
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
    let first_block = workgroup % BLOCK_GROUPS * BLOCKS;
    let first_pixel = workgroup / BLOCK_GROUPS % TILES * TILE;
    let image = workgroup / (BLOCK_GROUPS * TILES) % BATCH;
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

    for (var tap = 0u; tap < KERNEL * KERNEL; tap++) {
        for (var step = 0u; step < STEPS; step++) {
            workgroupBarrier();
            for (var n = 0u; n < STAGED; n++) {
                let i = n * GROUP + local;
                if i < STEP * TILE {
                    let block = step * STEP + i / TILE;
                    values[i] = seen(image, block, first_pixel + i % TILE, tap);
                }
            }
            let first = (tap * STEPS + step) * STEP;
            for (var i = local; i < STEP * BLOCKS * 4u; i += GROUP) {
                let row = (first + i / (BLOCKS * 4u)) * BLOCK_GROUPS * BLOCKS + first_block;
                taps[i] = weights[row * 4u + i % (BLOCKS * 4u)];
            }
            workgroupBarrier();
            for (var block = 0u; block < DEPTH; block++) {
                let weight_low = matrix((block * BLOCKS + 2u * pair) * 4u);
                let weight_high = matrix((block * BLOCKS + 2u * pair + 1u) * 4u);
                for (var i = 0u; i < PIXELS; i++) {
                    let value = values[block * TILE + i * LANES + lane];
                    low[i] += weight_low * value;
                    high[i] += weight_high * value;
                }
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
