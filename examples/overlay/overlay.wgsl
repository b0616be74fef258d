// The camera's picture with the robot's pixels tinted, and a sphere at each joint. `Estimate` stands in
// front of this text: see `HostLocator::wgsl`.

struct View {
    // from the graphics camera's frame to clip space
    projection: mat4x4<f32>,
    // of a sphere, in metres
    radius: f32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var picture: texture_2d<f32>;
@group(0) @binding(2) var mask: texture_2d<f32>;
@group(0) @binding(3) var linear: sampler;
@group(0) @binding(4) var<storage, read> estimates: array<Estimate>;

const TINT = vec3(1.0, 0.15, 0.05);

struct Picture {
    @builtin(position) position: vec4<f32>,
    @location(0) uv: vec2<f32>,
}

@vertex
fn picture_vertex(@builtin(vertex_index) index: u32) -> Picture {
    // One triangle over the whole viewport.
    let corner = vec2(f32(index / 2u), f32(index % 2u)) * 2.0;
    return Picture(vec4(corner * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 1.0, 1.0), corner);
}

@fragment
fn picture_fragment(in: Picture) -> @location(0) vec4<f32> {
    // The mask is the source's size: it lies on the picture texel for texel.
    let colour = textureSample(picture, linear, in.uv).rgb;
    let robot = textureSample(mask, linear, in.uv).r;
    return vec4(mix(colour, TINT, 0.5 * robot), 1.0);
}

const SEGMENTS = 24u;
const RINGS = 12u;

struct Sphere {
    @builtin(position) position: vec4<f32>,
    @location(0) normal: vec3<f32>,
    @location(1) @interpolate(flat) joint: u32,
}

// Six vertices a patch, SEGMENTS * RINGS patches a sphere.
@vertex
fn sphere_vertex(@builtin(vertex_index) index: u32, @builtin(instance_index) joint: u32) -> Sphere {
    let corners = array(vec2(0u, 0u), vec2(0u, 1u), vec2(1u, 0u), vec2(1u, 0u), vec2(0u, 1u), vec2(1u, 1u));
    let patch_index = index / 6u;
    let at = vec2(patch_index % SEGMENTS, patch_index / SEGMENTS) + corners[index % 6u];
    let turn = vec2<f32>(at) * vec2(2.0, 1.0) * 3.14159265 / vec2(f32(SEGMENTS), f32(RINGS));
    let normal = vec3(sin(turn.y) * cos(turn.x), cos(turn.y), sin(turn.y) * sin(turn.x));
    // From the camera optical frame to that of graphics: y up, z backward.
    let centre = estimates[0].joints[joint].xyz * vec3(1.0, -1.0, -1.0);
    var out = Sphere(vec4(0.0, 0.0, 2.0, 1.0), normal, joint);
    if estimates[0].status == FOUND {
        out.position = view.projection * vec4(centre + view.radius * normal, 1.0);
    }
    return out;
}

@fragment
fn sphere_fragment(in: Sphere) -> @location(0) vec4<f32> {
    // From red at the base to blue at the tool.
    let along = f32(in.joint) / f32(JOINTS - 1u);
    let colour = clamp(vec3(2.0 - 3.0 * along, 1.0 - abs(2.0 * along - 1.0), 3.0 * along - 1.0), vec3(0.0), vec3(1.0));
    let light = 0.35 + 0.65 * max(0.0, dot(normalize(in.normal), normalize(vec3(-0.4, 0.6, 0.7))));
    return vec4(colour * light, 1.0);
}
