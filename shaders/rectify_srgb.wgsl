// A source for `rectify`: a texture that gives linear light (rgba8unorm-srgb, bgra8unorm-srgb). The networks
// were trained on encoded values: they are encoded again (IEC 61966-2-1).

@group(0) @binding(3) var source: texture_2d<f32>;

fn source_at(at: vec2<i32>) -> vec3<f32> {
    let linear = textureLoad(source, at, 0).rgb;
    let curve = 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055;
    return select(curve, 12.92 * linear, linear <= vec3(0.0031308));
}
