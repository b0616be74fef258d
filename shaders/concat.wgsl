// Copies the channels of one input to their place among those of several, a block of four at a
// time. Inputs are copied in their order: what a block holds beyond its input's last channel, the
// next input overwrites. Activations are [image][channel / 4][row][column] of vec4.

// Rows times columns.
override PLANE: u32;
override BATCH: u32;
// Of the input, and the first one's place in the output.
override CHANNELS: u32;
override FIRST: u32;
override OUT_BLOCKS: u32;

override IN_BLOCKS: u32 = (CHANNELS + 3u) / 4u;
// Lanes of the first block that belong to earlier inputs.
override SHIFT: u32 = FIRST % 4u;
// Blocks of the output that the input reaches.
override BLOCKS: u32 = (SHIFT + CHANNELS + 3u) / 4u;
override INVOCATIONS: u32 = BATCH * BLOCKS * PLANE;

@group(0) @binding(0) var<storage, read> input: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> output: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let index = (group.y * groups.x + group.x) * 64u + local;
    if index >= INVOCATIONS {
        return;
    }
    let pixel = index % PLANE;
    let block = index / PLANE % BLOCKS;
    let image = index / (PLANE * BLOCKS);
    let source = image * IN_BLOCKS * PLANE + pixel;
    let place = (image * OUT_BLOCKS + FIRST / 4u + block) * PLANE + pixel;
    if SHIFT == 0u {
        output[place] = input[source + block * PLANE];
        return;
    }
    var texel = output[place];
    for (var lane = 0u; lane < 4u; lane++) {
        // Lanes before the input's first channel wrap round to numbers beyond its last.
        let channel = block * 4u + lane - SHIFT;
        if channel < CHANNELS {
            texel[lane] = input[source + channel / 4u * PLANE][channel % 4u];
        }
    }
    output[place] = texel;
}
