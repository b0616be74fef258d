// From slopes and the logarithm of depth (x / z, y / z, ln z) to the point (x, y, z), joint by joint:
// a vec4 of the output an invocation. A joint may lie in two vec4.

override JOINTS: u32;

fn value(image: u32, channel: u32) -> f32 {
    return input_at(channel / 4u * BATCH + image, 0u, 0u)[channel % 4u];
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= OUTPUT_PLANES {
        return;
    }
    let image = index % BATCH;
    var texel = vec4(0.0);
    for (var lane = 0u; lane < 4u; lane++) {
        let channel = index / BATCH * 4u + lane;
        if channel < 3u * JOINTS {
            let z = exp(value(image, channel / 3u * 3u + 2u));
            texel[lane] = select(value(image, channel) * z, z, channel % 3u == 2u);
        }
    }
    output_set(index, 0u, 0u, texel);
}
