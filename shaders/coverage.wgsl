// Counts and bounds the pixels of each mask that reach THRESHOLD, and counts those that reach
// SURE_THRESHOLD and those that are not finite. A workgroup reduces its 256 pixels, then adds them to its image's totals.
// Counts its own runs too: it is the last of a frame's kernels.

override THRESHOLD: f32;
override SURE_THRESHOLD: f32;

override PIXELS: u32 = INPUT_WIDTH * INPUT_HEIGHT;
override GROUPS: u32 = (PIXELS + 255u) / 256u;

struct Totals {
    pixels: atomic<u32>,
    sure: atomic<u32>,
    not_finite: atomic<u32>,
    // The greatest of width - x, height - y, x + 1 and y + 1: zero, to which the buffer is cleared,
    // stands for no pixel.
    from_right: atomic<u32>,
    from_bottom: atomic<u32>,
    from_left: atomic<u32>,
    from_top: atomic<u32>,
}

// [image], cleared before
@group(0) @binding(3) var<storage, read_write> totals: array<Totals>;
@group(0) @binding(4) var<storage, read_write> runs: u32;

var<workgroup> pixels: atomic<u32>;
var<workgroup> sure: atomic<u32>;
var<workgroup> not_finite: atomic<u32>;
var<workgroup> from_right: atomic<u32>;
var<workgroup> from_bottom: atomic<u32>;
var<workgroup> from_left: atomic<u32>;
var<workgroup> from_top: atomic<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let group_index = group.y * groups.x + group.x;
    let image = group_index / GROUPS;
    let pixel = group_index % GROUPS * 256u + local;
    if image < BATCH && pixel < PIXELS {
        let x = pixel % INPUT_WIDTH;
        let y = pixel / INPUT_WIDTH;
        let probability = input_at(image, y, x).x;
        // By its bits: a compiler may assume that a float is a number.
        let finite = (bitcast<u32>(probability) & 0x7f800000u) != 0x7f800000u;
        if finite && probability >= SURE_THRESHOLD {
            atomicAdd(&sure, 1u);
        }
        if !finite {
            atomicAdd(&not_finite, 1u);
        } else if probability >= THRESHOLD {
            atomicAdd(&pixels, 1u);
            atomicMax(&from_right, INPUT_WIDTH - x);
            atomicMax(&from_bottom, INPUT_HEIGHT - y);
            atomicMax(&from_left, x + 1u);
            atomicMax(&from_top, y + 1u);
        }
    }
    workgroupBarrier();
    if group_index == 0u && local == 0u {
        runs += 1u;
    }
    if local == 0u && image < BATCH {
        atomicAdd(&totals[image].not_finite, atomicLoad(&not_finite));
        atomicAdd(&totals[image].sure, atomicLoad(&sure));
        if atomicLoad(&pixels) > 0u {
            atomicAdd(&totals[image].pixels, atomicLoad(&pixels));
            atomicMax(&totals[image].from_right, atomicLoad(&from_right));
            atomicMax(&totals[image].from_bottom, atomicLoad(&from_bottom));
            atomicMax(&totals[image].from_left, atomicLoad(&from_left));
            atomicMax(&totals[image].from_top, atomicLoad(&from_top));
        }
    }
}
