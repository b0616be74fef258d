// What the convolutions between textures share. They have stride 1, dilation and zero padding 'same',
// with bias and activation fused. An invocation makes ROWS pixels, DILATION rows apart so that they
// share the rows that they read; a workgroup's invocations take pixels as they come, row after row, of
// one image. There are no bounds to look after: the margin is zero.
//
// The layer's numbers are in a uniform: layers of one kernel size then share one pipeline, and
// compiling is what the first image waits for.

struct Layer {
    // Images of the batch, and blocks of four channels.
    batch: u32,
    in_blocks: u32,
    out_blocks: u32,
    height: u32,
    width: u32,
    in_margin: u32,
    out_margin: u32,
    dilation: u32,
    // Rows from one pixel of an invocation to the next: rows with another remainder share nothing.
    lattice: u32,
    // Invocations above each other.
    row_groups: u32,
    // 0 none, 1 ReLU, 2 sigmoid
    activation: u32,
    // The first of the invocations that spread weights (`conv2d_subgroup`): zero, but the driver does not know that.
    first_lane: u32,
}

// A layer of a texture is `block * batch + image`.
@group(0) @binding(0) var input: texture_storage_2d_array<rgba32float, read>;
@group(0) @binding(2) var output: texture_storage_2d_array<rgba32float, write>;
@group(0) @binding(3) var weights: texture_storage_2d_array<rgba32float, read>;
// [out block], to full pairs
@group(0) @binding(4) var<storage, read> bias: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> layer: Layer;

fn activate(x: vec4<f32>) -> vec4<f32> {
    if layer.activation == 1u {
        return max(x, vec4(0.0));
    }
    if layer.activation == 2u {
        return 1.0 / (1.0 + exp(-x));
    }
    return x;
}

// `dividend / divisor`, both below 2^31, the divisor below 2^23. A CPU rasteriser divides whole numbers lane by lane, and
// f32 all at once: a guess that rounding may put beside the quotient, and what it leaves, which f32 holds exactly.
fn quotient(dividend: u32, divisor: u32) -> u32 {
    let whole = i32(divisor);
    let guess = i32(f32(i32(dividend)) / f32(whole));
    let rest = i32(dividend) - guess * whole;
    return u32(guess + i32(floor((f32(rest) + 0.5) / f32(whole))));
}

// The first pixel of invocation `position` of an image.
fn first_pixel(position: u32) -> vec2<u32> {
    let row_group = quotient(position, layer.width);
    let step = layer.lattice;
    let cycle = quotient(row_group, step);
    return vec2(position - row_group * layer.width, cycle * (step * (ROWS - 1u)) + row_group);
}

// Of a tap from its pixel. Where the margin ends before the tap, all beyond is zero.
fn offset(tap: u32) -> i32 {
    let exact = i32(tap * layer.dilation) - i32(KERNEL / 2u * layer.dilation);
    if ROWS > 1u {
        return exact;
    }
    return clamp(exact, -i32(layer.in_margin), i32(layer.in_margin));
}
