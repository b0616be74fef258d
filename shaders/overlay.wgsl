// The joint network's input (paper, section IV): colour times the mask's probability, or colour
// where the probability reaches THRESHOLD and black elsewhere. The probability is the second
// input's first lane.

override SOFT: bool;
override THRESHOLD: f32;

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
    let probability = second_at(place.plane, place.y, place.x).x;
    var share = probability;
    if !SOFT {
        share = select(0.0, 1.0, probability >= THRESHOLD);
    }
    output_set(place.plane, place.y, place.x, input_at(place.plane, place.y, place.x) * share);
}
