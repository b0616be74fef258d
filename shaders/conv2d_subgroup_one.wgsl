// A convolution between textures to one channel, behind `conv2d_lattice`, for subgroups of eight or
// more. Of a kernel column's weights an invocation reads one texel, four input channels of one kernel
// row, and the subgroup spreads them: a row an input block, and in it eight texels a column, of which
// KERNEL are used.

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let workgroup = group.y * groups.x + group.x;
    let batch = layer.batch;
    let parts = (layer.row_groups * layer.width + 63u) / 64u;
    let image = workgroup / parts;
    let position = workgroup % parts * 64u + local;
    let pixel = first_pixel(position);
    let centre = vec2<i32>(pixel + layer.in_margin);

    var sums: array<vec4<f32>, ROWS>;
    let in_blocks = layer.in_blocks;
    for (var block = 0u; block < in_blocks; block++) {
        for (var kx = 0u; kx < KERNEL; kx++) {
            var values: array<vec4<f32>, ROWS + KERNEL - 1u>;
            for (var row = 0u; row < ROWS + KERNEL - 1u; row++) {
                let at = centre + vec2(offset(kx), offset(row));
                values[row] = textureLoad(input, at, block * batch + image);
            }
            let texel = textureLoad(weights, vec2(kx * 8u + lane % 8u, block), 0u);
            for (var ky = 0u; ky < KERNEL; ky++) {
                let taps = subgroupBroadcast(texel, ky);
                for (var row = 0u; row < ROWS; row++) {
                    sums[row] += taps * values[row + ky];
                }
            }
        }
    }
    for (var row = 0u; row < ROWS; row++) {
        let y = pixel.y + row * layer.lattice;
        if image < batch && position < layer.row_groups * layer.width && y < layer.height {
            let sum = dot(sums[row], vec4(1.0)) + bias[0].x;
            let at = vec2(pixel.x, y) + layer.out_margin;
            textureStore(output, at, image, activate(vec4(sum, 0.0, 0.0, 0.0)));
        }
    }
}
