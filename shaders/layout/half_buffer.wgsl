// Tensors as buffers of halves, four channels in two words, without gaps: for GPUs. Arithmetic stays in
// f32. Tensors of one pixel are FULL, in f32 too: they are few numbers, and the joints are among them.

@group(0) @binding(0) var<storage, read> input: array<vec2<u32>>;
@group(0) @binding(1) var<storage, read> second: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> output: array<vec2<u32>>;

fn from_halves(words: vec2<u32>) -> vec4<f32> {
    return vec4(unpack2x16float(words.x), unpack2x16float(words.y));
}

fn input_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    let at = (plane * INPUT_HEIGHT + y) * INPUT_WIDTH + x;
    if INPUT_FULL {
        return bitcast<vec4<f32>>(vec4(input[2u * at], input[2u * at + 1u]));
    }
    return from_halves(input[at]);
}

fn second_at(plane: u32, y: u32, x: u32) -> vec4<f32> {
    let at = (plane * SECOND_HEIGHT + y) * SECOND_WIDTH + x;
    if SECOND_FULL {
        return bitcast<vec4<f32>>(vec4(second[2u * at], second[2u * at + 1u]));
    }
    return from_halves(second[at]);
}

fn output_set(plane: u32, y: u32, x: u32, value: vec4<f32>) {
    let at = (plane * OUTPUT_HEIGHT + y) * OUTPUT_WIDTH + x;
    if OUTPUT_FULL {
        let words = bitcast<vec4<u32>>(value);
        output[2u * at] = words.xy;
        output[2u * at + 1u] = words.zw;
    } else {
        output[at] = vec2(pack2x16float(value.xy), pack2x16float(value.zw));
    }
}
