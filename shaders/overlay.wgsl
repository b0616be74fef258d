// The joint network's input (paper, section IV): colour times the mask's probability, or colour
// where the probability reaches THRESHOLD and black elsewhere. Both are [image][row][column] of
// vec4; the probability is the first lane.

// Pixels of the whole batch.
override PIXELS: u32;
override SOFT: bool;
override THRESHOLD: f32;

@group(0) @binding(0) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> mask: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= PIXELS {
        return;
    }
    let probability = mask[index].x;
    var share = probability;
    if !SOFT {
        share = select(0.0, 1.0, probability >= THRESHOLD);
    }
    output[index] = image[index] * share;
}
