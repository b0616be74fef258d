// A source for `rectify`: NV12, a plane of luma and one of Cb and Cr at half the size, each of whose texels
// stands for four pixels.

// red = Y + RED_CR Cr, green = Y + GREEN_CB Cb + GREEN_CR Cr, blue = Y + BLUE_CB Cb, with Y over its range
override LUMA_SCALE: f32;
override LUMA_BLACK: f32;
override RED_CR: f32;
override GREEN_CB: f32;
override GREEN_CR: f32;
override BLUE_CB: f32;

@group(0) @binding(3) var luma: texture_2d<f32>;
@group(0) @binding(5) var chroma: texture_2d<f32>;

fn source_at(at: vec2<i32>) -> vec3<f32> {
    let y = (textureLoad(luma, at, 0).r - LUMA_BLACK) * LUMA_SCALE;
    let c = textureLoad(chroma, at / 2, 0).rg - 128.0 / 255.0;
    let colour = y + vec3(RED_CR * c.y, GREEN_CB * c.x + GREEN_CR * c.y, BLUE_CB * c.x);
    return clamp(colour, vec3(0.0), vec3(1.0));
}
