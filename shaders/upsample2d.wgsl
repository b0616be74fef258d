// Bilinear enlargement, pixel centres aligned as areas; beyond the border its pixels go on.
// Activations are [image][channel / 4][row][column] of vec4.

// Images times blocks of four channels.
override PLANES: u32;
override IN_HEIGHT: u32;
override IN_WIDTH: u32;
override SCALE: u32;

override HEIGHT: u32 = IN_HEIGHT * SCALE;
override WIDTH: u32 = IN_WIDTH * SCALE;
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
    let pixel = vec2(index % WIDTH, index / WIDTH % HEIGHT);
    let plane = index / (WIDTH * HEIGHT) * IN_HEIGHT;

    let at = max((vec2<f32>(pixel) + 0.5) / f32(SCALE) - 0.5, vec2(0.0));
    let low = vec2<u32>(at);
    let high = min(low + 1u, vec2(IN_WIDTH, IN_HEIGHT) - 1u);
    let part = at - vec2<f32>(low);
    let top = (plane + low.y) * IN_WIDTH;
    let bottom = (plane + high.y) * IN_WIDTH;
    output[index] = mix(
        mix(input[top + low.x], input[top + high.x], part.x),
        mix(input[bottom + low.x], input[bottom + high.x], part.x),
        part.y,
    );
}
