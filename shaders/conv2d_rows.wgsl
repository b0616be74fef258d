// A convolution between textures, behind `conv2d_lattice`: eight output channels an invocation, two
// blocks of four. What stands behind this gives the entry point and reads the weights: a texture layer
// a pair of blocks, a row an input block, and in it two matrices for each row of each kernel column.

// From four input channels to four of the first and four of the second block.
struct Taps {
    low: mat4x4<f32>,
    high: mat4x4<f32>,
}

fn convolve(workgroup: u32, local: u32, lane: u32) {
    let pairs = (layer.out_blocks + 1u) / 2u;
    let batch = layer.batch;
    let pixels = quotient(workgroup, pairs);
    let pair = workgroup - pixels * pairs;
    let part = quotient(pixels, batch);
    let image = pixels - part * batch;
    let position = part * 64u + local;
    let pixel = first_pixel(position);
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
            var values: array<vec4<f32>, ROWS + KERNEL - 1u>;
            for (var row = 0u; row < ROWS + KERNEL - 1u; row++) {
                values[row] = textureLoad(input, vec2(xs[kx], ys[row]), plane);
            }
            for (var ky = 0u; ky < KERNEL; ky++) {
                let taps = read_taps((kx * KERNEL + ky) * 8u, block, pair, lane);
                // One after the other: the weights of both at once would not fit a CPU's registers.
                for (var row = 0u; row < ROWS; row++) {
                    low[row] += taps.low * values[row + ky];
                }
                for (var row = 0u; row < ROWS; row++) {
                    high[row] += taps.high * values[row + ky];
                }
            }
        }
    }
    for (var row = 0u; row < ROWS; row++) {
        let y = pixel.y + row * layer.lattice;
        if position < layer.row_groups * layer.width && y < layer.height {
            let at = vec2(pixel.x, y) + layer.out_margin;
            let plane = 2u * pair * batch + image;
            textureStore(output, at, plane, activate(low[row]));
            if 2u * pair + 1u < layer.out_blocks {
                textureStore(output, at, plane + batch, activate(high[row]));
            }
        }
    }
}
