// Multiply-adds in registers, and nothing else: what an adapter's arithmetic can reach. Eight chains
// an invocation, so that none waits for itself; more would not fit a CPU rasteriser's registers.
// Factor and summand come from memory, so that nothing is worked out beforehand. An invocation does 64
// multiply-adds a round.

struct Params {
    factor: f32,
    summand: f32,
    rounds: u32,
}

@group(0) @binding(0) var<storage, read> params: Params;
@group(0) @binding(1) var<storage, read_write> output: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let factor = vec4(params.factor);
    let summand = vec4(params.summand);
    let rounds = params.rounds;
    var a = vec4(f32(id.x));
    var b = a + 0.5;
    for (var round = 0u; round < rounds; round++) {
        for (var i = 0u; i < 8u; i++) {
            a = fma(a, factor, summand);
            b = fma(b, factor, summand);
        }
    }
    output[id.x] = a + b;
}
