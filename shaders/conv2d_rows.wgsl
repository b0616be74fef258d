// Sums of a convolution between textures, behind `conv2d_lattice`: eight output channels an invocation,
// two blocks of four. `conv2d_pixels` or `conv2d_pooled` says which pixels, and stores them; what stands
// behind that gives the entry point and reads the weights: a texture layer a pair of blocks, a row an
// input block, and in it eight texels for each row of each kernel column: from four input channels to the
// first block, and to the second.

// Of ROWS pixels, before the activation.
struct Sums {
    low: array<vec4<f32>, ROWS>,
    high: array<vec4<f32>, ROWS>,
}

// What a workgroup makes: a pair of blocks of an image, at 64 positions.
struct Part {
    pair: u32,
    image: u32,
    first: u32,
}

// Image after image, of so many positions each: the rows that neighbours share stay in a CPU's caches. Behind the last image
// there may be workgroups that a long dispatch has too many.
fn part_of(workgroup: u32, positions: u32) -> Part {
    let pairs = (layer.out_blocks + 1u) / 2u;
    let pixels = quotient(workgroup, pairs);
    let parts = (positions + 63u) / 64u;
    let image = quotient(pixels, parts);
    return Part(workgroup - pixels * pairs, image, (pixels - image * parts) * 64u);
}

fn sums_at(pixel: vec2<u32>, image: u32, pair: u32, lane: u32) -> Sums {
    let batch = layer.batch;
    let centre = vec2<i32>(pixel + layer.in_margin);
    var low: array<vec4<f32>, ROWS>;
    var high: array<vec4<f32>, ROWS>;
    for (var row = 0u; row < ROWS; row++) {
        low[row] = bias[2u * pair];
        high[row] = bias[2u * pair + 1u];
    }
    var xs: array<i32, KERNEL>;
    for (var kx = 0u; kx < KERNEL; kx++) {
        xs[kx] = centre.x + offset(kx);
    }
    var ys: array<i32, ROWS + KERNEL - 1u>;
    for (var row = 0u; row < ROWS + KERNEL - 1u; row++) {
        ys[row] = centre.y + offset(row);
    }
    let in_blocks = layer.in_blocks;
    for (var block = 0u; block < in_blocks; block++) {
        let plane = block * batch + image;
        for (var kx = 0u; kx < KERNEL; kx++) {
            var texels: array<vec4<f32>, KERNEL>;
            for (var ky = 0u; ky < KERNEL; ky++) {
                texels[ky] = read_weights((kx * KERNEL + ky) * 8u, block, pair, lane);
            }
            var values: array<vec4<f32>, ROWS + KERNEL - 1u>;
            for (var row = 0u; row < ROWS + KERNEL - 1u; row++) {
                values[row] = textureLoad(input, vec2(xs[kx], ys[row]), plane);
            }
            // All loads before, and one block after the other: the weights and sums of both at once would not fit
            // a CPU's registers.
            for (var ky = 0u; ky < KERNEL; ky++) {
                let taps = spread_weights(texels[ky], (kx * KERNEL + ky) * 8u, block, pair, 0u);
                for (var row = 0u; row < ROWS; row++) {
                    low[row] += taps * values[row + ky];
                }
            }
            for (var ky = 0u; ky < KERNEL; ky++) {
                let taps = spread_weights(texels[ky], (kx * KERNEL + ky) * 8u, block, pair, 1u);
                for (var row = 0u; row < ROWS; row++) {
                    high[row] += taps * values[row + ky];
                }
            }
        }
    }
    return Sums(low, high);
}

// Stores a pixel's four channels of each block.
fn store(at: vec2<u32>, image: u32, pair: u32, low: vec4<f32>, high: vec4<f32>) {
    if image >= layer.batch {
        return;
    }
    let plane = 2u * pair * layer.batch + image;
    textureStore(output, at + layer.out_margin, plane, activate(low));
    if 2u * pair + 1u < layer.out_blocks {
        textureStore(output, at + layer.out_margin, plane + layer.batch, activate(high));
    }
}
