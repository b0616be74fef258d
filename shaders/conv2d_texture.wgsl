// Weights for `conv2d_rows` where subgroups are missing or small: every invocation reads them all.

// Nothing beforehand.
fn read_weights(first: u32, block: u32, pair: u32, lane: u32) -> vec4<f32> {
    return vec4(0.0);
}

// To block `high`, 0 or 1, of the pair.
fn spread_weights(texel: vec4<f32>, first: u32, block: u32, pair: u32, high: u32) -> mat4x4<f32> {
    let column = first + 4u * high;
    return mat4x4(
        textureLoad(weights, vec2(column, block), pair),
        textureLoad(weights, vec2(column + 1u, block), pair),
        textureLoad(weights, vec2(column + 2u, block), pair),
        textureLoad(weights, vec2(column + 3u, block), pair),
    );
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    convolve(group.y * groups.x + group.x, local, 0u);
}
