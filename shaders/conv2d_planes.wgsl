// What the convolutions between buffers share. They have stride 1, dilation and zero padding 'same', with
// bias and activation fused.

override KERNEL: u32;
override DILATION: u32;
// 0 none, 1 ReLU, 2 sigmoid
override ACTIVATION: u32;

override IN_BLOCKS: u32 = INPUT_PLANES / BATCH;
override OUT_BLOCKS: u32 = OUTPUT_PLANES / BATCH;
override HEIGHT: u32 = OUTPUT_HEIGHT;
override WIDTH: u32 = OUTPUT_WIDTH;

// [out block], to as many as the kernel makes
@group(0) @binding(4) var<storage, read> bias: array<vec4<f32>>;

fn activate(x: vec4<f32>) -> vec4<f32> {
    if ACTIVATION == 1u {
        return max(x, vec4(0.0));
    }
    if ACTIVATION == 2u {
        return 1.0 / (1.0 + exp(-x));
    }
    return x;
}

// Column and row that a tap, row after row of the kernel's, sees from `pixel`, row after row of an
// image's.
fn seen_from(pixel: u32, tap: u32) -> vec2<i32> {
    let place = vec2(tap % KERNEL, tap / KERNEL);
    let offset = (vec2<i32>(place) - i32(KERNEL / 2u)) * i32(DILATION);
    return vec2(i32(pixel % WIDTH), i32(pixel / WIDTH)) + offset;
}

fn is_inside(at: vec2<i32>) -> bool {
    return all(at >= vec2(0)) && all(at < vec2(i32(WIDTH), i32(HEIGHT)));
}
