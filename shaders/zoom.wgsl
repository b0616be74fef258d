// Turns a network's camera to what the overlay shows of each image and zooms in on it: to the mean of the pixels,
// each as heavy as it is shown, so close that SPREAD of their standard deviations are as wide or as high as the image, both
// in steps, which roundings and noise do not take. A workgroup an image, which adds up every GROUPth pixel in each
// invocation: always in the same order.

override SPREAD: f32;
override LEAST: f32;
override MOST: f32;

const GROUP = 256u;
// Of the zoom, in an octave; of the direction, in the width of what the camera sees.
const STEPS = vec2(8.0, 64.0);
override PIXELS: u32 = INPUT_WIDTH * INPUT_HEIGHT;

// [image]
@group(0) @binding(3) var<storage, read_write> gazes: array<Gaze>;

// Of a part of the pixels: weight; weighted sums of x, y and of their squares, from the image's middle.
var<workgroup> weights: array<f32, GROUP>;
var<workgroup> sums: array<vec4<f32>, GROUP>;

@compute @workgroup_size(GROUP)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let image = group.y * groups.x + group.x;
    let size = vec2(f32(INPUT_WIDTH), f32(INPUT_HEIGHT));
    let middle = 0.5 * (size - 1.0);
    var weight = 0.0;
    var sum = vec4(0.0);
    if image < BATCH {
        for (var pixel = local; pixel < PIXELS; pixel += GROUP) {
            let x = pixel % INPUT_WIDTH;
            let y = pixel / INPUT_WIDTH;
            let share = shown(input_at(image, y, x).x);
            let at = vec2(f32(x), f32(y)) - middle;
            weight += share;
            sum += share * vec4(at, at * at);
        }
    }
    weights[local] = weight;
    sums[local] = sum;
    for (var half = GROUP / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half {
            weights[local] += weights[local + half];
            sums[local] += sums[local + half];
        }
    }
    if local > 0u || image >= BATCH {
        return;
    }
    if weights[0] < 1e-6 {
        gazes[image] = Gaze(vec4(1.0, 0.0, 0.0, 1.0), vec4(0.0, 1.0, 0.0, 0.0), vec4(0.0, 0.0, 1.0, 0.0));
        return;
    }
    let means = sums[0] / weights[0];
    let deviation = sqrt(max(means.zw - means.xy * means.xy, vec2(0.0)));
    let share = SPREAD * deviation / size;
    let wanted = clamp(1.0 / max(max(share.x, share.y), 1e-6), LEAST, MOST);
    let zoom = clamp(exp2(round(log2(wanted) * STEPS.x) / STEPS.x), LEAST, MOST);
    let step = size.x / (STEPS.y * zoom);
    let at = round((means.xy + middle - vec2(CX, CY)) / step) * step;
    let ray = normalize(vec3(at / vec2(FX, FY), 1.0));
    // The shortest turn that brings the axis to the ray.
    let bent = ray.xy / (1.0 + ray.z);
    gazes[image] = Gaze(
        vec4(1.0 - ray.x * bent.x, -ray.x * bent.y, -ray.x, zoom),
        vec4(-ray.y * bent.x, 1.0 - ray.y * bent.y, -ray.y, 0.0),
        vec4(ray, 0.0),
    );
}
