// The mask in the camera's image as it is stored, a byte a texel: bilinear, 0 where the canonical camera
// sees nothing and where a value is not finite. See `camera::Unrectification`.

struct Unrectification {
    // columns and rows of the camera's image
    size: vec2<u32>,
    // columns of nodes
    columns: u32,
    // words of a row of the output
    stride: u32,
    // which image of the batch is read
    index: u32,
}

const STEP = 8u;

// Not a uniform, as in `rectify`.
@group(0) @binding(3) var<storage, read> params: Unrectification;
// [row][column], canonical pixels
@group(0) @binding(4) var<storage, read> nodes: array<vec2<f32>>;
// [row][column / 4], the first texel in the lowest byte
@group(0) @binding(5) var<storage, read_write> bytes: array<u32>;

fn canonical(texel: vec2<u32>) -> vec2<f32> {
    let cell = texel / STEP;
    let part = vec2<f32>(texel % STEP) / f32(STEP);
    let first = cell.y * params.columns + cell.x;
    let top = mix(nodes[first], nodes[first + 1u], part.x);
    let below = first + params.columns;
    let bottom = mix(nodes[below], nodes[below + 1u], part.x);
    return mix(top, bottom, part.y);
}

fn mask_at(at: vec2<u32>) -> f32 {
    return input_at(params.index, at.y, at.x).x;
}

fn sample(texel: vec2<u32>) -> f32 {
    let last = vec2(INPUT_WIDTH, INPUT_HEIGHT) - 1u;
    let at = canonical(texel);
    // Pixels reach half a pixel beyond their centres.
    if !(all(at >= vec2(-0.5)) && all(at <= vec2<f32>(last) + 0.5)) {
        return 0.0;
    }
    let inside = clamp(at, vec2(0.0), vec2<f32>(last));
    let corner = vec2<u32>(inside);
    let next = min(corner + 1u, last);
    let part = inside - floor(inside);
    let left = vec2(mask_at(corner), mask_at(vec2(corner.x, next.y)));
    let right = vec2(mask_at(vec2(next.x, corner.y)), mask_at(next));
    // By their bits, as they were loaded: a compiler may assume that a float, and what is worked out of one, is a number.
    let exponents = bitcast<vec4<u32>>(vec4(left, right)) & vec4(0x7f800000u);
    if any(exponents == vec4(0x7f800000u)) {
        return 0.0;
    }
    let rows = mix(left, right, part.x);
    return mix(rows.x, rows.y, part.y);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    let word = index % params.stride;
    let row = index / params.stride;
    if row >= params.size.y {
        return;
    }
    var four = vec4(0.0);
    for (var i = 0u; i < 4u; i++) {
        let column = 4u * word + i;
        if column < params.size.x {
            four[i] = sample(vec2(column, row));
        }
    }
    bytes[index] = pack4x8unorm(four);
}
