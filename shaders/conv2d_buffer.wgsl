// A convolution between buffers on every adapter, behind `conv2d_planes`. An invocation makes COLUMNS
// pixels of one row, TILES apart so that neighbouring invocations read neighbouring texels, in eight
// output channels: two blocks of four.

const COLUMNS = 4u;
override TILES: u32 = (WIDTH + COLUMNS - 1u) / COLUMNS;
override OUT_PAIRS: u32 = (OUT_BLOCKS + 1u) / 2u;
override INVOCATIONS: u32 = BATCH * OUT_PAIRS * HEIGHT * TILES;

// [out block][kernel row][kernel column][in block], a column of the matrix for each input channel
@group(0) @binding(3) var<storage, read> weights: array<mat4x4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= INVOCATIONS {
        return;
    }
    let tile = index % TILES;
    let y = index / TILES % HEIGHT;
    let pair = index / (TILES * HEIGHT) % OUT_PAIRS;
    let image = index / (TILES * HEIGHT * OUT_PAIRS);
    let first = 2u * pair;
    let second = min(first + 1u, OUT_BLOCKS - 1u);

    var low: array<vec4<f32>, COLUMNS>;
    var high: array<vec4<f32>, COLUMNS>;
    for (var i = 0u; i < COLUMNS; i++) {
        low[i] = bias[first];
        high[i] = bias[second];
    }

    let reach = i32(KERNEL / 2u * DILATION);
    let taps = KERNEL * KERNEL * IN_BLOCKS;
    for (var ky = 0u; ky < KERNEL; ky++) {
        let in_y = i32(y + ky * DILATION) - reach;
        if in_y < 0 || in_y >= i32(HEIGHT) {
            continue;
        }
        for (var kx = 0u; kx < KERNEL; kx++) {
            var inside: array<bool, COLUMNS>;
            var in_x: array<u32, COLUMNS>;
            for (var i = 0u; i < COLUMNS; i++) {
                let x = i32(tile + i * TILES + kx * DILATION) - reach;
                inside[i] = x >= 0 && x < i32(WIDTH);
                in_x[i] = u32(clamp(x, 0, i32(WIDTH) - 1));
            }
            let tap = (ky * KERNEL + kx) * IN_BLOCKS;
            for (var block = 0u; block < IN_BLOCKS; block++) {
                let weight_low = weights[first * taps + tap + block];
                let weight_high = weights[second * taps + tap + block];
                for (var i = 0u; i < COLUMNS; i++) {
                    let texel = input_at(block * BATCH + image, u32(in_y), in_x[i]);
                    let value = select(vec4(0.0), texel, inside[i]);
                    low[i] += weight_low * value;
                    high[i] += weight_high * value;
                }
            }
        }
    }

    for (var i = 0u; i < COLUMNS; i++) {
        let x = tile + i * TILES;
        if x < WIDTH {
            output_set(first * BATCH + image, y, x, activate(low[i]));
            if second != first {
                output_set(second * BATCH + image, y, x, activate(high[i]));
            }
        }
    }
}
