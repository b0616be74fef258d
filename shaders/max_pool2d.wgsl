// Maximum over windows of SIZE x SIZE, side by side; what is left over at the bottom and right is
// dropped.

override SIZE: u32;

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
    let y = place.y * SIZE;
    let x = place.x * SIZE;
    var greatest = input_at(place.plane, y, x);
    for (var dy = 0u; dy < SIZE; dy++) {
        for (var dx = 0u; dx < SIZE; dx++) {
            greatest = max(greatest, input_at(place.plane, y + dy, x + dx));
        }
    }
    output_set(place.plane, place.y, place.x, greatest);
}
