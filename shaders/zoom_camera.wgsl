// The canonical camera, and those that look closer. Stands behind `gaze.wgsl`, in front of the `zoom_*` kernels.

// Of the canonical camera.
override FX: f32;
override FY: f32;
override CX: f32;
override CY: f32;

// Four texels of a plane, and how heavy each is.
struct Sample {
    low: vec2<u32>,
    high: vec2<u32>,
    weights: vec4<f32>,
}

// What the canonical camera, or one zoomed in by `zoom`, has in the direction `ray`, of a plane of `size`: bilinear. What
// lies beyond the border or behind the camera weighs nothing.
fn sample_of(ray: vec3<f32>, zoom: f32, size: vec2<f32>) -> Sample {
    let at = ray.xy / max(ray.z, 1e-3) * (vec2(FX, FY) * zoom) + vec2(CX, CY);
    if ray.z <= 1e-3 || any(at <= vec2(-1.0)) || any(at >= size) {
        return Sample(vec2(0u), vec2(0u), vec4(0.0));
    }
    let corner = floor(at);
    let part = at - corner;
    let before = select(vec2(0.0), 1.0 - part, corner >= vec2(0.0));
    let behind = select(vec2(0.0), part, corner + 1.0 < size);
    return Sample(
        vec2<u32>(max(corner, vec2(0.0))),
        vec2<u32>(min(corner + 1.0, size - 1.0)),
        vec4(before.x, behind.x, before.x, behind.x) * vec4(before.yy, behind.yy),
    );
}

fn sampled_input(plane: u32, s: Sample) -> vec4<f32> {
    return input_at(plane, s.low.y, s.low.x) * s.weights.x
        + input_at(plane, s.low.y, s.high.x) * s.weights.y
        + input_at(plane, s.high.y, s.low.x) * s.weights.z
        + input_at(plane, s.high.y, s.high.x) * s.weights.w;
}

// Where pixel (x, y) of this camera looks, in the canonical camera's frame.
fn canonical_ray(gaze: Gaze, x: u32, y: u32) -> vec3<f32> {
    let pixel = vec2(f32(x), f32(y));
    return turned_back(gaze, vec3((pixel - vec2(CX, CY)) / (vec2(FX, FY) * gaze.right.w), 1.0));
}
