// Bilinear enlargement, pixel centres aligned as areas; beyond the border its pixels go on.

override SCALE: u32;

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
    // In half pixels of the output, as whole numbers: far from the origin, floats would be too coarse.
    let at = max(2u * vec2(place.x, place.y) + 1u, vec2(SCALE)) - SCALE;
    let low = at / (2u * SCALE);
    let high = min(low + 1u, vec2(INPUT_WIDTH, INPUT_HEIGHT) - 1u);
    let part = vec2<f32>(at % (2u * SCALE)) / f32(2u * SCALE);
    let plane = place.plane;
    let value = mix(
        mix(input_at(plane, low.y, low.x), input_at(plane, low.y, high.x), part.x),
        mix(input_at(plane, high.y, low.x), input_at(plane, high.y, high.x), part.x),
        part.y,
    );
    output_set(plane, place.y, place.x, value);
}
