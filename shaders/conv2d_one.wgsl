// A convolution between buffers to one channel, behind `conv2d_planes`: for GPUs.
//
// A workgroup makes LANES columns of ROWS rows, DILATION apart so that they share the rows that they read. Each
// of its PARTS has every PARTSth block of input channels; their sums meet in workgroup memory.

const LANES = 32u;
const PARTS = 4u;
const GROUP = LANES * PARTS;

override STEPS: u32 = (IN_BLOCKS + PARTS - 1u) / PARTS;
override TILES_ACROSS: u32 = (WIDTH + LANES - 1u) / LANES;
// Rows that do not lie on one lattice share nothing.
override LATTICE: u32 = min(DILATION, HEIGHT);
override TILES_DOWN: u32 = (HEIGHT + LATTICE * ROWS - 1u) / (LATTICE * ROWS) * LATTICE;

// [in block, to full steps][kernel column][kernel row] of four input channels
@group(0) @binding(3) var<storage, read> weights: array<vec4<f32>>;

// [part][row][column]
var<workgroup> sums: array<f32, PARTS * ROWS * LANES>;

fn seen(plane: u32, at: vec2<i32>) -> vec4<f32> {
    if is_inside(at) {
        return input_at(plane, u32(at.y), u32(at.x));
    }
    return vec4(0.0);
}

@compute @workgroup_size(GROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let workgroup = group.y * groups.x + group.x;
    let down = workgroup / TILES_ACROSS % TILES_DOWN;
    let image = workgroup / (TILES_ACROSS * TILES_DOWN) % BATCH;
    let x = workgroup % TILES_ACROSS * LANES + local % LANES;
    let y = down / LATTICE * (LATTICE * ROWS) + down % LATTICE;
    let part = local / LANES;

    let first = vec2(i32(x), i32(y)) - i32(KERNEL / 2u * DILATION);
    var totals: array<vec4<f32>, ROWS>;
    // Not from `part` to IN_BLOCKS: SwiftShader unrolls such a loop without end. Weights beyond are zeros.
    for (var step = 0u; step < STEPS; step++) {
        let block = step * PARTS + part;
        let plane = min(block, IN_BLOCKS - 1u) * BATCH + image;
        // Not written out: software drivers take minutes to compile that.
        for (var kx = 0u; kx < KERNEL; kx++) {
            var values: array<vec4<f32>, ROWS + SIDE - 1u>;
            for (var row = 0u; row < ROWS + SIDE - 1u; row++) {
                values[row] = seen(plane, first + vec2(i32(kx * DILATION), i32(row * DILATION)));
            }
            for (var ky = 0u; ky < SIDE; ky++) {
                let taps = weights[(block * SIDE + kx) * SIDE + ky];
                for (var row = 0u; row < ROWS; row++) {
                    totals[row] += taps * values[row + ky];
                }
            }
        }
    }
    for (var row = 0u; row < ROWS; row++) {
        sums[part * ROWS * LANES + row * LANES + local % LANES] = dot(totals[row], vec4(1.0));
    }
    workgroupBarrier();
    // A row a part; ROWS are no more than PARTS.
    let row = part;
    let to = y + row * LATTICE;
    if row < ROWS && x < WIDTH && to < HEIGHT {
        var sum = bias[0].x;
        for (var other = 0u; other < PARTS; other++) {
            sum += sums[other * ROWS * LANES + row * LANES + local % LANES];
        }
        output_set(image, to, x, activate(vec4(sum, 0.0, 0.0, 0.0)));
    }
}
