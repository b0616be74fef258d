// The canonical camera's mask from the zoomed one's, the input: sampled bilinearly as far as that sees, the second input's
// beyond, and both over the pixel between.

// [image]
@group(0) @binding(3) var<storage, read> gazes: array<Gaze>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    let place = output_place(index);
    if place.plane >= OUTPUT_PLANES {
        return;
    }
    let gaze = gazes[place.plane];
    let pixel = vec2(f32(place.x), f32(place.y));
    let ray = turned(gaze, vec3((pixel - vec2(CX, CY)) / vec2(FX, FY), 1.0));
    let s = sample_of(ray, gaze.right.w, vec2(f32(INPUT_WIDTH), f32(INPUT_HEIGHT)));
    let closer = sampled_input(place.plane, s);
    let beyond = 1.0 - dot(s.weights, vec4(1.0));
    output_set(place.plane, place.y, place.x, closer + beyond * second_at(place.plane, place.y, place.x));
}
