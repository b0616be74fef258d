// A convolution between buffers as a product of matrices in tiles of 16 x 16, behind `conv2d_planes` and
// what multiplies tiles, in subgroups of 32. Factors are halves, sums f32.
//
// A workgroup of four subgroups makes TILE pixels of an image, as they come row after row, in 32 output
// channels; a subgroup makes 32 of the pixels. Of each tap it brings STEP blocks of input channels and
// their weights to workgroup memory.

const TILE = 128u;
// Output blocks of a workgroup.
const BLOCKS = 8u;
// Of rows in workgroup memory: a little apart, so that they do not begin in the same bank.
const VALUES_STRIDE = 4u * STEP + 8u;
const TAPS_STRIDE = 4u * BLOCKS + 8u;
const SUMS_STRIDE = 4u * BLOCKS + 4u;
// Not written out, as loops to a size are.
const DEPTH = STEP / 4u;

override STEPS: u32 = (IN_BLOCKS + STEP - 1u) / STEP;
override TILES: u32 = (HEIGHT * WIDTH + TILE - 1u) / TILE;
override BLOCK_GROUPS: u32 = (OUT_BLOCKS + BLOCKS - 1u) / BLOCKS;

// [kernel row][kernel column][in block, to full steps][out block, to full groups][in channel] of four
// outputs
@group(0) @binding(3) var<storage, read> weights: array<vec4<f32>>;

// [pixel][in channel]
var<workgroup> values: array<Half, TILE * VALUES_STRIDE>;
// [in channel][out channel]
var<workgroup> taps: array<Half, 4u * STEP * TAPS_STRIDE>;
// [pixel][out channel]
var<workgroup> sums: array<f32, TILE * SUMS_STRIDE>;

// Of the invocation: its index, and the pixel that it brings and stores.
var<private> local: u32;
var<private> pixel: u32;

// What a tap sees of STEP blocks of channels from `first` on.
fn bring_values(image: u32, first: u32, tap: u32) {
    let at = seen_from(pixel, tap);
    let inside = is_inside(at);
    for (var n = 0u; n < STEP; n++) {
        var value = vec4(0.0);
        if inside && first + n < IN_BLOCKS {
            value = input_at((first + n) * BATCH + image, u32(at.y), u32(at.x));
        }
        let to = local * VALUES_STRIDE + 4u * n;
        values[to] = Half(value.x);
        values[to + 1u] = Half(value.y);
        values[to + 2u] = Half(value.z);
        values[to + 3u] = Half(value.w);
    }
}

// The weights of STEP blocks of input channels for the workgroup's output channels: from `first` on, in
// blocks of both.
fn bring_taps(first: u32) {
    for (var i = local; i < STEP * BLOCKS * 4u; i += TILE) {
        let in_block = i / (BLOCKS * 4u);
        let out_block = i / 4u % BLOCKS;
        let weight = weights[(first + in_block * BLOCK_GROUPS * BLOCKS + out_block) * 4u + i % 4u];
        let to = (4u * in_block + i % 4u) * TAPS_STRIDE + 4u * out_block;
        taps[to] = Half(weight.x);
        taps[to + 1u] = Half(weight.y);
        taps[to + 2u] = Half(weight.z);
        taps[to + 3u] = Half(weight.w);
    }
}

@compute @workgroup_size(TILE)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
) {
    local = index;
    let workgroup = group.y * groups.x + group.x;
    let first_block = workgroup % BLOCK_GROUPS * BLOCKS;
    pixel = workgroup / BLOCK_GROUPS % TILES * TILE + local;
    let image = workgroup / (BLOCK_GROUPS * TILES) % BATCH;

    for (var block = 0u; block < 8u; block++) {
        let start = bias[first_block + block];
        let to = local * SUMS_STRIDE + 4u * block;
        sums[to] = start.x;
        sums[to + 1u] = start.y;
        sums[to + 2u] = start.z;
        sums[to + 3u] = start.w;
    }
    workgroupBarrier();
    let upper = local / 32u * 32u;
    let lower = upper + 16u;
    var upper_left = sums_at(upper * SUMS_STRIDE);
    var upper_right = sums_at(upper * SUMS_STRIDE + 16u);
    var lower_left = sums_at(lower * SUMS_STRIDE);
    var lower_right = sums_at(lower * SUMS_STRIDE + 16u);

    for (var tap = 0u; tap < KERNEL * KERNEL; tap++) {
        for (var step = 0u; step < STEPS; step++) {
            workgroupBarrier();
            bring_values(image, step * STEP, tap);
            bring_taps((tap * STEPS + step) * STEP * BLOCK_GROUPS * BLOCKS + first_block);
            workgroupBarrier();
            for (var k = 0u; k < DEPTH; k++) {
                let above = values_at(upper * VALUES_STRIDE + 16u * k);
                let below = values_at(lower * VALUES_STRIDE + 16u * k);
                let left = taps_at(16u * k * TAPS_STRIDE);
                let right = taps_at(16u * k * TAPS_STRIDE + 16u);
                upper_left = multiply_add(above, left, upper_left);
                upper_right = multiply_add(above, right, upper_right);
                lower_left = multiply_add(below, left, lower_left);
                lower_right = multiply_add(below, right, lower_right);
            }
        }
    }

    keep(upper_left, upper * SUMS_STRIDE);
    keep(upper_right, upper * SUMS_STRIDE + 16u);
    keep(lower_left, lower * SUMS_STRIDE);
    keep(lower_right, lower * SUMS_STRIDE + 16u);
    workgroupBarrier();
    if pixel < HEIGHT * WIDTH {
        for (var block = 0u; block < 8u; block++) {
            let from_sum = local * SUMS_STRIDE + 4u * block;
            let sum = vec4(sums[from_sum], sums[from_sum + 1u], sums[from_sum + 2u], sums[from_sum + 3u]);
            if first_block + block < OUT_BLOCKS {
                let plane = (first_block + block) * BATCH + image;
                output_set(plane, pixel / WIDTH, pixel % WIDTH, activate(sum));
            }
        }
    }
}
