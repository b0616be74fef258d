// The expected place, under a softmax over a heat map's cells, of what each cell votes for. The first
// input is the heat maps, the second the votes, three channels a joint. A workgroup makes one vec4 of
// the output, in which two joints meet at most.

override JOINTS: u32;
// Place of cell (0, 0), and distance from cell to cell.
override ORIGIN_X: f32;
override ORIGIN_Y: f32;
override STEP_X: f32;
override STEP_Y: f32;

override CELLS: u32 = INPUT_HEIGHT * INPUT_WIDTH;

const LANES = 256u;
const LOWEST = -0x1.fffffep+127f;
var<workgroup> maxima: array<f32, LANES>;
// Weighted x, y and depth, and the weights.
var<workgroup> sums: array<vec4<f32>, LANES>;

fn heat(image: u32, joint: u32, cell: u32) -> f32 {
    let plane = joint / 4u * BATCH + image;
    return input_at(plane, cell / INPUT_WIDTH, cell % INPUT_WIDTH)[joint % 4u];
}

fn vote(image: u32, channel: u32, cell: u32) -> f32 {
    let plane = channel / 4u * BATCH + image;
    return second_at(plane, cell / INPUT_WIDTH, cell % INPUT_WIDTH)[channel % 4u];
}

// The joint's mean, the same in every lane.
fn mean(image: u32, joint: u32, lane: u32) -> vec3<f32> {
    // Less the greatest logit, no exponential overflows and one of them is 1.
    var greatest = LOWEST;
    for (var cell = lane; cell < CELLS; cell += LANES) {
        greatest = max(greatest, heat(image, joint, cell));
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
        let weight = exp(heat(image, joint, cell) - greatest);
        let place = vec3(
            STEP_X * f32(cell % INPUT_WIDTH) + vote(image, 3u * joint, cell),
            STEP_Y * f32(cell / INPUT_WIDTH) + vote(image, 3u * joint + 1u, cell),
            vote(image, 3u * joint + 2u, cell),
        );
        sum += weight * vec4(place, 1.0);
    }
    sums[lane] = sum;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            sums[lane] += sums[lane + half];
        }
    }
    workgroupBarrier();
    let total = sums[0];
    // Before another joint's sums go there.
    workgroupBarrier();
    return total.xyz / total.w + vec3(ORIGIN_X, ORIGIN_Y, 0.0);
}

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let plane = group.y * groups.x + group.x;
    if plane >= OUTPUT_PLANES {
        return;
    }
    let image = plane % BATCH;
    let channel = plane / BATCH * 4u;
    let joint = channel / 3u;
    let one = mean(image, joint, lane);
    let other = mean(image, min(joint + 1u, JOINTS - 1u), lane);
    if lane == 0u {
        var six = array(one.x, one.y, one.z, other.x, other.y, other.z);
        let first = channel % 3u;
        output_set(plane, 0u, 0u, vec4(six[first], six[first + 1u], six[first + 2u], six[first + 3u]));
    }
}
