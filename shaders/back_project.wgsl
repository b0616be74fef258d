// From slopes and the logarithm of depth (x / z, y / z, ln z) to the point (x, y, z), joint by joint.
// Activations of one pixel are [image][channel / 4] of vec4, seen here as scalars: a joint may lie
// in two vec4.

override JOINTS: u32;
override BATCH: u32;

override STRIDE: u32 = (3u * JOINTS + 3u) / 4u * 4u;

@group(0) @binding(0) var<storage, read> input: array<f32>;
@group(0) @binding(1) var<storage, read_write> output: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= BATCH * JOINTS {
        return;
    }
    let first = index / JOINTS * STRIDE + index % JOINTS * 3u;
    let z = exp(input[first + 2u]);
    output[first] = input[first] * z;
    output[first + 1u] = input[first + 1u] * z;
    output[first + 2u] = z;
}
