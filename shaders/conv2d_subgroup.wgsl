// `conv2d_rows` with subgroups of eight or more: an invocation reads one texel of a tap's eight, and
// the subgroup spreads them. All of a workgroup make the same output channels.

fn read_taps(first: u32, block: u32, pair: u32, lane: u32) -> Taps {
    let texel = textureLoad(weights, vec2(first + lane, block), pair);
    return Taps(
        mat4x4(
            subgroupBroadcast(texel, 0u),
            subgroupBroadcast(texel, 1u),
            subgroupBroadcast(texel, 2u),
            subgroupBroadcast(texel, 3u),
        ),
        mat4x4(
            subgroupBroadcast(texel, 4u),
            subgroupBroadcast(texel, 5u),
            subgroupBroadcast(texel, 6u),
            subgroupBroadcast(texel, 7u),
        ),
    );
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    convolve(group.y * groups.x + group.x, local, lane % 8u);
}
