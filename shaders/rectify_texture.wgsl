// A source for `rectify`: a texture whose values are as the camera encoded them (rgba8unorm, bgra8unorm).

@group(0) @binding(3) var source: texture_2d<f32>;

fn source_at(at: vec2<i32>) -> vec3<f32> {
    return textureLoad(source, at, 0).rgb;
}
