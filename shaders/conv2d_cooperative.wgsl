// What multiplies tiles for `conv2d_matrix`: a GPU's matrix units, by cooperative matrices, and halves as
// they lie in memory. Offsets are of a tile's first element, in fours of elements; rows lie one after the
// other.
enable f16;
enable wgpu_cooperative_matrix;

alias Half = f16;
alias Values = coop_mat16x16<f16, A>;
alias Taps = coop_mat16x16<f16, B>;
alias Sums = coop_mat16x16<f32, C>;

@group(0) @binding(3) var<storage, read> weights: array<vec4<f16>>;
// The input again: its halves need no unpacking.
@group(0) @binding(5) var<storage, read> texels: array<vec4<f16>>;

fn weight_at(index: u32) -> vec4<Half> {
    return weights[index];
}

fn texel_at(index: u32) -> vec4<Half> {
    return texels[index];
}

fn values_at(first: u32) -> Values {
    return coopLoadT<Values>(&values[first], VALUES_STRIDE);
}

fn taps_at(first: u32) -> Taps {
    return coopLoadT<Taps>(&taps[first], TAPS_STRIDE);
}

fn sums_at(first: u32) -> Sums {
    return coopLoadT<Sums>(&sums[first], SUMS_STRIDE);
}

fn multiply_add(a: Values, b: Taps, c: Sums) -> Sums {
    return coopMultiplyAdd(a, b, c);
}

fn keep(tile: Sums, first: u32) {
    coopStoreT(tile, &sums[first], SUMS_STRIDE);
}
