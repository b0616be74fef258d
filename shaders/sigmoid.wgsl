// 1 / (1 + exp(-x)) of each value.

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    let place = output_place(index);
    if place.plane < OUTPUT_PLANES {
        let value = input_at(place.plane, place.y, place.x);
        output_set(place.plane, place.y, place.x, 1.0 / (1.0 + exp(-value)));
    }
}
