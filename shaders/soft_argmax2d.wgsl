// The expected place, under a softmax over a heat map's cells, of what each cell votes for: a
// workgroup for each joint of each image. Activations are [image][channel / 4][row][column] of
// vec4, seen here as scalars: a joint's three channels of votes may lie in two vec4.

override JOINTS: u32;
override BATCH: u32;
override HEIGHT: u32;
override WIDTH: u32;
// Place of cell (0, 0), and distance from cell to cell.
override ORIGIN_X: f32;
override ORIGIN_Y: f32;
override STEP_X: f32;
override STEP_Y: f32;

override CELLS: u32 = HEIGHT * WIDTH;

// [JOINTS, HEIGHT, WIDTH] an image
@group(0) @binding(0) var<storage, read> heat: array<f32>;
// [3 * JOINTS, HEIGHT, WIDTH] an image
@group(0) @binding(1) var<storage, read> votes: array<f32>;
// [3 * JOINTS, 1, 1] an image
@group(0) @binding(2) var<storage, read_write> output: array<f32>;

const LANES = 64u;
const LOWEST = -3.40282347e+38f;
var<workgroup> maxima: array<f32, LANES>;
// Weighted x, y and depth, and the weights.
var<workgroup> sums: array<vec4<f32>, LANES>;

fn place(image: u32, channels: u32, channel: u32, cell: u32) -> u32 {
    let block = image * ((channels + 3u) / 4u) + channel / 4u;
    return (block * CELLS + cell) * 4u + channel % 4u;
}

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let index = group.y * groups.x + group.x;
    if index >= BATCH * JOINTS {
        return;
    }
    let joint = index % JOINTS;
    let image = index / JOINTS;

    // Less the greatest logit, no exponential overflows and one of them is 1.
    var greatest = LOWEST;
    for (var cell = lane; cell < CELLS; cell += LANES) {
        greatest = max(greatest, heat[place(image, JOINTS, joint, cell)]);
    }
    maxima[lane] = greatest;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            maxima[lane] = max(maxima[lane], maxima[lane + half]);
        }
    }
    workgroupBarrier();
    greatest = maxima[0];

    var sum = vec4(0.0);
    for (var cell = lane; cell < CELLS; cell += LANES) {
        let weight = exp(heat[place(image, JOINTS, joint, cell)] - greatest);
        let vote = vec3(
            STEP_X * f32(cell % WIDTH) + votes[place(image, 3u * JOINTS, 3u * joint, cell)],
            STEP_Y * f32(cell / WIDTH) + votes[place(image, 3u * JOINTS, 3u * joint + 1u, cell)],
            votes[place(image, 3u * JOINTS, 3u * joint + 2u, cell)],
        );
        sum += weight * vec4(vote, 1.0);
    }
    sums[lane] = sum;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            sums[lane] += sums[lane + half];
        }
    }
    if lane == 0u {
        let mean = sums[0].xyz / sums[0].w + vec3(ORIGIN_X, ORIGIN_Y, 0.0);
        // A plane of one cell: channels lie one after the other.
        let first = image * ((3u * JOINTS + 3u) / 4u * 4u) + 3u * joint;
        output[first] = mean.x;
        output[first + 1u] = mean.y;
        output[first + 2u] = mean.z;
    }
}
