// The joint network's input (paper, section IV): colour as far as the mask's probability, the second input's first lane,
// lets it through.

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
    let share = shown(second_at(place.plane, place.y, place.x).x);
    output_set(place.plane, place.y, place.x, input_at(place.plane, place.y, place.x) * share);
}
