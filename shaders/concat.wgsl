// Copies the channels of one input to their place among those of several.
// Activations are [image][channel / 4][row][column] of vec4, seen here as scalars: channels of two
// inputs may share a vec4.

// Rows times columns.
override PLANE: u32;
override BATCH: u32;
// Of the input, and the first one's place in the output.
override CHANNELS: u32;
override FIRST: u32;
override OUT_BLOCKS: u32;

override IN_BLOCKS: u32 = (CHANNELS + 3u) / 4u;
override INVOCATIONS: u32 = BATCH * CHANNELS * PLANE;

@group(0) @binding(0) var<storage, read> input: array<f32>;
@group(0) @binding(1) var<storage, read_write> output: array<f32>;

fn place(image: u32, blocks: u32, channel: u32, pixel: u32) -> u32 {
    return (((image * blocks + channel / 4u) * PLANE) + pixel) * 4u + channel % 4u;
}

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
    let channel = index / PLANE % CHANNELS;
    let image = index / (PLANE * CHANNELS);
    output[place(image, OUT_BLOCKS, FIRST + channel, pixel)]
        = input[place(image, IN_BLOCKS, channel, pixel)];
}
