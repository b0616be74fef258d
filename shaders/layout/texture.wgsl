// Tensors as arrays of textures, a layer a plane, with a margin of zeros round each: for CPU
// rasterisers, which read textures several times faster than buffers.

@group(0) @binding(0) var input: texture_storage_2d_array<rgba32float, read>;
@group(0) @binding(1) var second: texture_storage_2d_array<rgba32float, read>;
@group(0) @binding(2) var output: texture_storage_2d_array<rgba32float, write>;

fn input_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    return textureLoad(input, vec2(x, y) + INPUT_MARGIN, plane);
}

fn second_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    return textureLoad(second, vec2(x, y) + SECOND_MARGIN, plane);
}

fn output_set(plane: u32, y: u32, x: u32, value: vec4<f32>) {
    textureStore(output, vec2(x, y) + OUTPUT_MARGIN, plane, value);
}
