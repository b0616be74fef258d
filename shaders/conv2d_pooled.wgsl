// A convolution without dilation and the max-pool behind it, behind `conv2d_rows`: the greatest of each window of
// SIZE x SIZE, 2 or 4. What is pooled is never stored: that costs a CPU rasteriser as much as a few channels' sums.
//
// Rows of a window are an invocation's own, WINDOWS windows above each other; its columns are those of SIZE neighbours in
// the subgroup, which counts its invocations in their order. Width and height are the pool's: of what is left over
// at the bottom and right there is no window.

fn greatest(own: vec4<f32>) -> vec4<f32> {
    let pair = max(own, subgroupShuffleXor(own, 1u));
    if SIZE == 2u {
        return pair;
    }
    return max(pair, subgroupShuffleXor(pair, 2u));
}

fn convolve(workgroup: u32, local: u32, lane: u32) {
    let columns = layer.width * SIZE;
    let part = part_of(workgroup, layer.row_groups * columns);
    let position = part.first + local;
    let row_group = quotient(position, columns);
    let column = position - row_group * columns;
    let sums = sums_at(vec2(column, row_group * ROWS), part.image, part.pair, lane);
    for (var window = 0u; window < WINDOWS; window++) {
        var low = sums.low[window * SIZE];
        var high = sums.high[window * SIZE];
        for (var row = 0u; row < SIZE; row++) {
            low = max(low, sums.low[window * SIZE + row]);
            high = max(high, sums.high[window * SIZE + row]);
        }
        low = greatest(low);
        high = greatest(high);
        let at = vec2(column / SIZE, row_group * WINDOWS + window);
        let first = column % SIZE == 0u && position < layer.row_groups * columns;
        if first && at.y < layer.height {
            // No activation falls: the greatest sum becomes the greatest value.
            store(at, part.image, part.pair, low, high);
        }
    }
}
