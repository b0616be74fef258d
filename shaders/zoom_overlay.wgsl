// The joint network's input as its zoomed camera sees it: colour as far as the mask's probability lets it through; image
// and mask are sampled bilinearly, black beyond their borders. The mask is the second input, its probability the first
// lane.

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
    let size = vec2(f32(INPUT_WIDTH), f32(INPUT_HEIGHT));
    let s = sample_of(canonical_ray(gazes[place.plane], place.x, place.y), 1.0, size);
    let probability = second_at(place.plane, s.low.y, s.low.x).x * s.weights.x
        + second_at(place.plane, s.low.y, s.high.x).x * s.weights.y
        + second_at(place.plane, s.high.y, s.low.x).x * s.weights.z
        + second_at(place.plane, s.high.y, s.high.x).x * s.weights.w;
    output_set(place.plane, place.y, place.x, sampled_input(place.plane, s) * shown(probability));
}
