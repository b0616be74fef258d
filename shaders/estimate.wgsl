// Says on the GPU what `cascade::Estimate` says on the CPU: whether there is a robot, and where its joints are.

// Sure pixels that it takes for a robot.
override MIN_SURE: u32;

struct Totals {
    pixels: u32,
    sure: u32,
    not_finite: u32,
    from_right: u32,
    from_bottom: u32,
    from_left: u32,
    from_top: u32,
}

// [image], as `coverage` leaves them
@group(0) @binding(3) var<storage, read> totals: array<Totals>;
// [image], the farthest that its lens shows anything from the axis, at z = 1
@group(0) @binding(4) var<storage, read> max_radius: array<f32>;
@group(0) @binding(5) var<storage, read_write> estimates: array<Estimate>;

fn value(image: u32, index: u32) -> f32 {
    return input_at(index / 4u * BATCH + image, 0u, 0u)[index % 4u];
}

fn finite(value: f32) -> bool {
    // By its bits, as they were loaded: a compiler may assume that a float, and what is worked out of one, is a number.
    return (bitcast<u32>(value) & 0x7f800000u) != 0x7f800000u;
}

fn possible(joint: vec3<f32>, most: f32) -> bool {
    if !(finite(joint.x) && finite(joint.y) && finite(joint.z) && joint.z > 0.0) {
        return false;
    }
    // No lens shows rays farther than 1e9 from its axis, and of nearer ones the quotient is finite.
    if max(abs(joint.x), abs(joint.y)) > 2e9 * joint.z {
        return false;
    }
    let ray = joint.xy / joint.z;
    return dot(ray, ray) <= most * most;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let image = id.x;
    if image >= BATCH {
        return;
    }
    let total = totals[image];
    var status = FOUND;
    if total.not_finite > 0u {
        status = INVALID;
    } else if total.sure < MIN_SURE {
        status = NOT_FOUND;
    } else {
        for (var i = 0u; i < JOINTS; i++) {
            let joint = vec3(value(image, 3u * i), value(image, 3u * i + 1u), value(image, 3u * i + 2u));
            if !possible(joint, max_radius[image]) {
                status = INVALID;
            }
        }
    }
    estimates[image].status = status;
    estimates[image].pixels = total.pixels;
    estimates[image].sure = total.sure;
    for (var i = 0u; i < JOINTS; i++) {
        var joint = vec4(0.0);
        if status == FOUND {
            joint = vec4(value(image, 3u * i), value(image, 3u * i + 1u), value(image, 3u * i + 2u), 1.0);
        }
        estimates[image].joints[i] = joint;
    }
}
