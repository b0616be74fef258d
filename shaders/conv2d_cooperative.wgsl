// What multiplies tiles for `conv2d_matrix`: a GPU's matrix units, by cooperative matrices. Offsets are
// of a tile's first element; rows lie one after the other.
enable f16;
enable wgpu_cooperative_matrix;

alias Half = f16;
alias Values = coop_mat16x16<f16, A>;
alias Taps = coop_mat16x16<f16, B>;
alias Sums = coop_mat16x16<f32, C>;

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
