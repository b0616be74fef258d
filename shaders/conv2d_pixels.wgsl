// Every pixel of a convolution, behind `conv2d_rows`.

fn convolve(workgroup: u32, local: u32, lane: u32) {
    let part = part_of(workgroup, layer.row_groups * layer.width);
    let position = part.first + local;
    let pixel = first_pixel(position);
    let sums = sums_at(pixel, part.image, part.pair, lane);
    for (var row = 0u; row < ROWS; row++) {
        let y = pixel.y + row * layer.lattice;
        if position < layer.row_groups * layer.width && y < layer.height {
            store(vec2(pixel.x, y), part.image, part.pair, sums.low[row], sums.high[row]);
        }
    }
}
