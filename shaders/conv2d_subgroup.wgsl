// Weights for `conv2d_rows` with subgroups of eight or more: an invocation reads one texel of a tap's eight, and
// the subgroup spreads them. All of a workgroup make the same output channels.

fn read_weights(first: u32, block: u32, pair: u32, lane: u32) -> vec4<f32> {
    return textureLoad(weights, vec2(first + lane, block), pair);
}

// To block `high`, 0 or 1, of the pair.
fn spread_weights(texel: vec4<f32>, first: u32, block: u32, pair: u32, high: u32) -> mat4x4<f32> {
    var taps: mat4x4<f32>;
    for (var i = 0u; i < 4u; i++) {
        // From an invocation that the driver does not know beforehand, it is one instruction of lavapipe's where a
        // subgroup is a register of eight values, else a loop. From one that it knows, it is two everywhere.
        if SUBGROUP == 8u {
            taps[i] = subgroupShuffle(texel, layer.first_lane + 4u * high + i);
        } else if high == 0u {
            taps[i] = subgroupBroadcast(texel, i);
        } else {
            taps[i] = subgroupBroadcast(texel, 4u + i);
        }
    }
    return taps;
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
