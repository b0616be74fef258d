// Draws a recording's scene: background photo, objects with light and shadow, and which samples show
// the robot. All positions and directions are in the camera optical frame (x right, y down, z forward).

struct View {
    clip_from_camera: mat4x4<f32>,
    // Texture coordinates (xy, in [0, 1]) and depth (z) of the shadow map.
    shadow_from_camera: mat4x4<f32>,
    // xyz: the direction away from the floor; w: a point's height above the robot's base is its part
    // along xyz, and this.
    up: vec4<f32>,
    // rgb: light from above and from below.
    sky: vec4<f32>,
    ground: vec4<f32>,
    // xyz: towards the light. The first one casts shadows, as dark as its w.
    light_direction: array<vec4<f32>, 3>,
    light_colour: array<vec4<f32>, 3>,
    // What metal mirrors: three waves over directions, xyz wave vector, w phase.
    mirrored: array<vec4<f32>, 3>,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var photos: texture_2d_array<f32>;
@group(0) @binding(2) var photo_sampler: sampler;
@group(0) @binding(3) var shadow_map: texture_depth_2d;
@group(0) @binding(4) var shadow_sampler: sampler_comparison;

struct Vertex {
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
}

struct Item {
    // Rows of the 3x4 matrix from the mesh's frame to the camera's.
    @location(2) row0: vec4<f32>,
    @location(3) row1: vec4<f32>,
    @location(4) row2: vec4<f32>,
    // rgb: albedo, linear; w: 1 for the robot.
    @location(5) albedo: vec4<f32>,
    // x: metal, y: specular strength, z: shininess, w: how much of the photo texture shows.
    @location(6) finish: vec4<f32>,
    // xy: offset of the photo texture, z: its repeats a metre.
    @location(7) texture: vec4<f32>,
}

struct Lit {
    @builtin(position) clip: vec4<f32>,
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    // The point and the normal in the mesh's axes, in metres.
    @location(2) surface: vec3<f32>,
    @location(3) facing: vec3<f32>,
    @location(4) @interpolate(flat) albedo: vec4<f32>,
    @location(5) @interpolate(flat) finish: vec4<f32>,
    @location(6) @interpolate(flat) texture: vec4<f32>,
}

fn place(item: Item, position: vec3<f32>) -> vec3<f32> {
    let p = vec4(position, 1.0);
    return vec3(dot(item.row0, p), dot(item.row1, p), dot(item.row2, p));
}

@vertex
fn object_vertex(vertex: Vertex, item: Item) -> Lit {
    let x = vec3(item.row0.x, item.row1.x, item.row2.x);
    let y = vec3(item.row0.y, item.row1.y, item.row2.y);
    let z = vec3(item.row0.z, item.row1.z, item.row2.z);
    var out: Lit;
    out.position = place(item, vertex.position);
    out.clip = view.clip_from_camera * vec4(out.position, 1.0);
    // The cofactor matrix turns normals under any scale.
    out.normal = cross(y, z) * vertex.normal.x + cross(z, x) * vertex.normal.y + cross(x, y) * vertex.normal.z;
    out.surface = vertex.position * vec3(length(x), length(y), length(z));
    out.facing = vertex.normal;
    out.albedo = item.albedo;
    out.finish = item.finish;
    out.texture = item.texture;
    return out;
}

// Distance between the points where the shadow map is read, as a share of its edge.
const SHADOW_BLUR = 0.004;

struct Pixel {
    @location(0) colour: vec4<f32>,
    @location(1) robot: f32,
}

fn encode_srgb(colour: vec3<f32>) -> vec3<f32> {
    let c = clamp(colour, vec3(0.0), vec3(1.0));
    return select(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, 12.92 * c, c < vec3(0.0031308));
}

@fragment
fn object_fragment(in: Lit) -> Pixel {
    let to_eye = -normalize(in.position);
    var normal = normalize(in.normal);
    if dot(normal, to_eye) < 0.0 {
        normal = -normal;
    }

    var albedo = in.albedo.rgb;
    if in.finish.w > 0.0 {
        let facing = abs(in.facing);
        var uv = in.surface.xy;
        if facing.x > max(facing.y, facing.z) {
            uv = in.surface.yz;
        } else if facing.y > facing.z {
            uv = in.surface.xz;
        }
        let texel = textureSampleLevel(photos, photo_sampler, uv * in.texture.z + in.texture.xy, 1, 0.0).rgb;
        albedo = mix(albedo, texel * texel, in.finish.w);
    }

    let s = view.shadow_from_camera * vec4(in.position + 0.012 * normal, 1.0);
    var lit = 1.0;
    if all(s.xy > vec2(0.0)) && all(s.xy < vec2(1.0)) && s.z < 1.0 {
        lit = 0.0;
        for (var i = 0; i < 4; i++) {
            let shift = (vec2(f32(i & 1), f32(i >> 1)) - 0.5) * SHADOW_BLUR;
            lit += 0.25 * textureSampleCompareLevel(shadow_map, shadow_sampler, s.xy + shift, s.z);
        }
    }
    lit = mix(1.0, lit, view.light_direction[0].w);

    let metal = in.finish.x;
    // Less light comes from all sides close above the robot's base.
    let height = dot(in.position, view.up.xyz) + view.up.w;
    let facing_up = dot(normal, view.up.xyz);
    let open = mix(0.65, 1.0, max(max(smoothstep(0.0, 0.15, height), -height * 20.0), facing_up));
    var diffuse = mix(view.ground.rgb, view.sky.rgb, 0.5 + 0.5 * facing_up) * min(open, 1.0);
    var specular = vec3(0.0);
    for (var i = 0; i < 3; i++) {
        let to_light = view.light_direction[i].xyz;
        let shade = select(1.0, lit, i == 0);
        let colour = view.light_colour[i].rgb * shade;
        diffuse += colour * max(dot(normal, to_light), 0.0);
        let halfway = max(dot(normal, normalize(to_light + to_eye)), 0.0);
        specular += colour * in.finish.y * pow(halfway, in.finish.z);
    }
    let mirror = reflect(-to_eye, normal);
    var reflected = 0.75;
    for (var i = 0; i < 3; i++) {
        let wave = view.mirrored[i];
        reflected += 0.3 * sin(dot(wave.xyz, mirror) + wave.w);
    }
    let surroundings = mix(view.ground.rgb, view.sky.rgb, 0.5 + 0.5 * dot(mirror, view.up.xyz));
    var shine = surroundings * 1.6 * max(reflected, 0.0) * mix(0.6, 1.0, lit);
    if metal > 0.0 {
        // The photo behind stands in for what is around; four points of it, as brushed metal smears.
        var photo = vec3(0.0);
        for (var i = 0; i < 4; i++) {
            let shift = 0.09 * (vec2(f32(i & 1), f32(i >> 1)) - 0.5);
            let uv = 0.5 + 0.5 * mirror.xy + shift;
            let texel = textureSampleLevel(photos, photo_sampler, uv, 0, 0.0).rgb;
            photo += 0.25 * texel * texel;
        }
        photo = mix(photo, vec3(dot(photo, vec3(0.21, 0.72, 0.07))), 0.6);
        shine = mix(shine, 1.3 * photo, 0.4) * mix(0.55, 1.1, dot(normal, to_eye));
    }
    let colour = mix(albedo * diffuse, albedo * shine, metal) + specular;

    var out: Pixel;
    out.colour = vec4(encode_srgb(colour), 1.0);
    out.robot = in.albedo.w;
    return out;
}

@vertex
fn shadow_vertex(vertex: Vertex, item: Item) -> @builtin(position) vec4<f32> {
    let s = view.shadow_from_camera * vec4(place(item, vertex.position), 1.0);
    return vec4(s.x * 2.0 - 1.0, 1.0 - s.y * 2.0, s.z, 1.0);
}

struct Backdrop {
    @builtin(position) clip: vec4<f32>,
    @location(0) uv: vec2<f32>,
}

// One triangle over the whole picture.
@vertex
fn background_vertex(@builtin(vertex_index) index: u32) -> Backdrop {
    let corner = vec2(f32(index & 1u), f32(index >> 1u)) * 2.0;
    var out: Backdrop;
    out.clip = vec4(corner.x * 2.0 - 1.0, 1.0 - corner.y * 2.0, 1.0, 1.0);
    out.uv = corner;
    return out;
}

@fragment
fn background_fragment(in: Backdrop) -> Pixel {
    var out: Pixel;
    out.colour = textureSampleLevel(photos, photo_sampler, in.uv, 0, 0.0);
    out.robot = 0.0;
    return out;
}
