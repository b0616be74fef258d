// A picture with its mask tinted, over the whole target, pixel by pixel.

@group(0) @binding(0) var picture: texture_2d<f32>;
@group(0) @binding(1) var mask: texture_2d<f32>;

override RED: f32;
override GREEN: f32;
override BLUE: f32;
override STRENGTH: f32;

// A triangle that covers the target.
@vertex
fn cover(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4(f32(index & 1u) * 4.0 - 1.0, f32(index & 2u) * 2.0 - 1.0, 0.0, 1.0);
}

@fragment
fn tint(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let at = vec2<u32>(position.xy);
    let share = STRENGTH * textureLoad(mask, at, 0).r;
    return vec4(mix(textureLoad(picture, at, 0).rgb, vec3(RED, GREEN, BLUE), share), 1.0);
}
