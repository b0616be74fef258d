// The channels of the first input, then those of the second: a vec4 of the output an invocation.

// Of the first input, and of both.
override FIRST: u32;
override CHANNELS: u32;

// Where a block of the output takes all lanes from one block of one input, as it does if FIRST is a
// multiple of four.
override ALIGNED: bool = FIRST % 4u == 0u;

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
    let block = place.plane / BATCH;
    let image = place.plane % BATCH;
    var texel = vec4(0.0);
    if (block + 1u) * 4u <= FIRST {
        texel = input_at(place.plane, place.y, place.x);
    } else if ALIGNED {
        texel = second_at((block - FIRST / 4u) * BATCH + image, place.y, place.x);
    } else {
        for (var lane = 0u; lane < 4u; lane++) {
            let channel = block * 4u + lane;
            if channel < FIRST {
                texel[lane] = input_at(place.plane, place.y, place.x)[lane];
            } else if channel < CHANNELS {
                let of_second = channel - FIRST;
                let plane = of_second / 4u * BATCH + image;
                texel[lane] = second_at(plane, place.y, place.x)[of_second % 4u];
            }
        }
    }
    output_set(place.plane, place.y, place.x, texel);
}
