// `conv2d_rows` where subgroups are missing or small: every invocation reads every weight.

fn read_taps(first: u32, block: u32, pair: u32, lane: u32) -> Taps {
    return Taps(
        mat4x4(
            textureLoad(weights, vec2(first, block), pair),
            textureLoad(weights, vec2(first + 1u, block), pair),
            textureLoad(weights, vec2(first + 2u, block), pair),
            textureLoad(weights, vec2(first + 3u, block), pair),
        ),
        mat4x4(
            textureLoad(weights, vec2(first + 4u, block), pair),
            textureLoad(weights, vec2(first + 5u, block), pair),
            textureLoad(weights, vec2(first + 6u, block), pair),
            textureLoad(weights, vec2(first + 7u, block), pair),
        ),
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
