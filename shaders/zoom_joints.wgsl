// From the joints as the zoomed camera sees them to the canonical camera's frame: farther by the zoom, and turned back. A vec4
// of the output an invocation; a joint may lie in two.

override JOINTS: u32;

// [image]
@group(0) @binding(3) var<storage, read> gazes: array<Gaze>;

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
    let gaze = gazes[image];
    var texel = vec4(0.0);
    for (var lane = 0u; lane < 4u; lane++) {
        let channel = index / BATCH * 4u + lane;
        if channel < 3u * JOINTS {
            let first = channel / 3u * 3u;
            let seen = vec3(value(image, first), value(image, first + 1u), value(image, first + 2u) * gaze.right.w);
            texel[lane] = turned_back(gaze, seen)[channel % 3u];
        }
    }
    output_set(index, 0u, 0u, texel);
}
