// A plane of the canonical camera as the zoomed one sees it: sampled bilinearly, black beyond its borders.

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
    output_set(place.plane, place.y, place.x, sampled_input(place.plane, s));
}
