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
    let gaze = gazes[place.plane];
    let focal = vec2(FX, FY);
    let ray = vec3((vec2(f32(place.x), f32(place.y)) - vec2(CX, CY)) / (focal * gaze.right.w), 1.0);
    let seen = turned_back(gaze, ray);
    let size = vec2(f32(INPUT_WIDTH), f32(INPUT_HEIGHT));
    let at = seen.xy / max(seen.z, 1e-3) * focal + vec2(CX, CY);
    var value = vec4(0.0);
    if seen.z > 1e-3 && all(at > vec2(-1.0)) && all(at < size) {
        let corner = floor(at);
        let part = at - corner;
        let before = select(vec2(0.0), 1.0 - part, corner >= vec2(0.0));
        let behind = select(vec2(0.0), part, corner + 1.0 < size);
        // What lies beyond the border weighs nothing.
        let low = vec2<u32>(max(corner, vec2(0.0)));
        let high = vec2<u32>(min(corner + 1.0, size - 1.0));
        let weights = vec4(before.x, behind.x, before.x, behind.x) * vec4(before.yy, behind.yy);
        let colour = input_at(place.plane, low.y, low.x) * weights.x
            + input_at(place.plane, low.y, high.x) * weights.y
            + input_at(place.plane, high.y, low.x) * weights.z
            + input_at(place.plane, high.y, high.x) * weights.w;
        let probability = second_at(place.plane, low.y, low.x).x * weights.x
            + second_at(place.plane, low.y, high.x).x * weights.y
            + second_at(place.plane, high.y, low.x).x * weights.z
            + second_at(place.plane, high.y, high.x).x * weights.w;
        value = colour * shown(probability);
    }
    output_set(place.plane, place.y, place.x, value);
}
