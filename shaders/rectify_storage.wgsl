// A source for `rectify`: an image that was written to a storage texture of our own, which CPU
// rasterisers read several times faster than others.

@group(0) @binding(3) var source: texture_storage_2d<rgba8unorm, read>;

fn source_at(at: vec2<i32>) -> vec3<f32> {
    return textureLoad(source, at).rgb;
}
