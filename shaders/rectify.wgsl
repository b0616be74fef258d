// Undistorts and resamples a camera's image into the canonical pinhole camera of the networks, or into one that is turned and
// zoomed in (`gaze.wgsl`, which stands in front).
//
// An output pixel is the mean of a grid of bilinear samples over its footprint in the source, as
// many as the footprint has pixels: nothing is skipped when the image shrinks. What the source does
// not show is black. Formulas: OpenCV's camera models; see `camera::Rectification`. What the source is
// made of is in the `rectify_*` file that stands behind this one: `source_at` gives a texel's colour.

struct Rectification {
    // 1 / fx, 1 / fy, cx, cy of the canonical camera
    canonical: vec4<f32>,
    // fx, fy, cx, cy of the source
    source: vec4<f32>,
    // size of the source in pixels
    size: vec2<f32>,
    // samples across the footprint, along canonical x and y
    samples: vec2<u32>,
    // rational: k1 .. k4; equidistant: k1 .. k4
    k_low: vec4<f32>,
    // rational: k5, k6, p1, p2
    k_high: vec4<f32>,
    // 0 none, 1 rational, 2 equidistant
    model: u32,
    // beyond this distance from the axis (at z = 1) the lens shows nothing
    max_radius: f32,
    // which image of the batch is written
    index: u32,
    // where the pixels of the source lie in its texture: pixel (0, 0), and the next ones from there
    across: vec2<i32>,
    down: vec2<i32>,
    origin: vec2<i32>,
}

// Not a uniform: where loops and branches depend on one, Mesa's lavapipe makes a shader of its values for every dispatch, and
// keeps them all.
@group(0) @binding(4) var<storage, read> stored: Rectification;

// [image]: what sees each.
@group(0) @binding(6) var<storage, read> gazes: array<Gaze>;

// Where a ray at z = 1 lands in the source, in pixels.
fn project(params: Rectification, ray: vec2<f32>) -> vec2<f32> {
    let r2 = dot(ray, ray);
    var bent = ray;
    if params.model == 1u {
        let k = params.k_low;
        let radial = (1.0 + r2 * (k.x + r2 * (k.y + r2 * k.z)))
            / (1.0 + r2 * (k.w + r2 * (params.k_high.x + r2 * params.k_high.y)));
        let p = params.k_high.zw;
        let xy = 2.0 * ray.x * ray.y;
        bent = ray * radial + vec2(
            p.x * xy + p.y * (r2 + 2.0 * ray.x * ray.x),
            p.x * (r2 + 2.0 * ray.y * ray.y) + p.y * xy,
        );
    } else if params.model == 2u {
        let r = sqrt(r2);
        let theta = atan(r);
        let t2 = theta * theta;
        let k = params.k_low;
        let bent_theta = theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w))));
        // On the axis the ratio tends to 1.
        bent = ray * select(1.0, bent_theta / r, r > 1e-6);
    }
    return bent * params.source.xy + params.source.zw;
}

// Where a pixel looks, in the canonical camera's frame.
fn ray_of(params: Rectification, gaze: Gaze, pixel: vec2<f32>) -> vec3<f32> {
    let seen = (pixel - params.canonical.zw) * params.canonical.xy / gaze.right.w;
    return turned_back(gaze, vec3(seen, 1.0));
}

// At z = 1, for what is ahead.
fn at_one(ray: vec3<f32>) -> vec2<f32> {
    return ray.xy / max(ray.z, AHEAD);
}

// What is less far ahead is beside the camera or behind it.
const AHEAD = 1e-3;

// Bilinear, as if black pixels lay round the source: without a step at its border. What lies beyond it may be
// read, but weighs nothing.
fn sample(params: Rectification, at: vec2<f32>) -> vec3<f32> {
    if !(all(at > vec2(-1.0)) && all(at < params.size)) {
        return vec3(0.0);
    }
    let corner = vec2<i32>(floor(at));
    let part = at - floor(at);
    let before = select(vec2(0.0), 1.0 - part, corner >= vec2(0));
    let behind = select(vec2(0.0), part, corner + 1 < vec2<i32>(params.size));
    let texel = params.origin + params.across * corner.x + params.down * corner.y;
    let top = source_at(texel) * before.x + source_at(texel + params.across) * behind.x;
    let below = texel + params.down;
    let bottom = source_at(below) * before.x + source_at(below + params.across) * behind.x;
    return top * before.y + bottom * behind.y;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= OUTPUT_WIDTH * OUTPUT_HEIGHT {
        return;
    }
    // Read once: a CPU rasteriser takes as long for one of these numbers as for three texels.
    let params = stored;
    let gaze = gazes[params.index];
    let place = output_place(index);
    let pixel = vec2(f32(place.x), f32(place.y));
    var colour = vec3(0.0);
    let ray = ray_of(params, gaze, pixel);
    let middle = at_one(ray);
    if ray.z > AHEAD && dot(middle, middle) <= params.max_radius * params.max_radius {
        let centre = project(params, middle);
        let right = project(params, at_one(ray_of(params, gaze, pixel + vec2(0.5, 0.0))));
        let left = project(params, at_one(ray_of(params, gaze, pixel - vec2(0.5, 0.0))));
        let lower = project(params, at_one(ray_of(params, gaze, pixel + vec2(0.0, 0.5))));
        let upper = project(params, at_one(ray_of(params, gaze, pixel - vec2(0.0, 0.5))));
        let along_x = right - left;
        let along_y = lower - upper;
        let step = 1.0 / vec2<f32>(params.samples);
        for (var j = 0u; j < params.samples.y; j++) {
            for (var i = 0u; i < params.samples.x; i++) {
                let part = (vec2(f32(i), f32(j)) + 0.5) * step - 0.5;
                colour += sample(params, centre + along_x * part.x + along_y * part.y);
            }
        }
        colour *= step.x * step.y;
    }
    output_set(params.index, place.y, place.x, vec4(colour, 0.0));
}
