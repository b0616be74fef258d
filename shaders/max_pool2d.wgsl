// Maximum over windows of SIZE x SIZE, side by side; what is left over at the bottom and right is
// dropped. Activations are [image][channel / 4][row][column] of vec4.

// Images times blocks of four channels.
override PLANES: u32;
override IN_HEIGHT: u32;
override IN_WIDTH: u32;
override SIZE: u32;

override HEIGHT: u32 = IN_HEIGHT / SIZE;
override WIDTH: u32 = IN_WIDTH / SIZE;
override INVOCATIONS: u32 = PLANES * HEIGHT * WIDTH;

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
    let x = index % WIDTH;
    let y = index / WIDTH % HEIGHT;
    let plane = index / (WIDTH * HEIGHT);

    let corner = (plane * IN_HEIGHT + y * SIZE) * IN_WIDTH + x * SIZE;
    var greatest = input[corner];
    for (var dy = 0u; dy < SIZE; dy++) {
        for (var dx = 0u; dx < SIZE; dx++) {
            greatest = max(greatest, input[corner + dy * IN_WIDTH + dx]);
        }
    }
    output[index] = greatest;
}
