// Tensors as buffers, without gaps: for GPUs.

@group(0) @binding(0) var<storage, read> input: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> second: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> output: array<vec4<f32>>;

fn input_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    return input[(plane * INPUT_HEIGHT + y) * INPUT_WIDTH + x];
}

fn second_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    return second[(plane * SECOND_HEIGHT + y) * SECOND_WIDTH + x];
}

fn output_set(plane: u32, y: u32, x: u32, value: vec4<f32>) {
    output[(plane * OUTPUT_HEIGHT + y) * OUTPUT_WIDTH + x] = value;
}
