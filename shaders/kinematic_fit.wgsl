// Moves six joints to where an arm can have them: `reference::kinematic_fit`, in the same steps. A workgroup an image, in which
// an invocation works out what a column of the errors' changes, or of the errors themselves, holds of a joint.
//
// Functions are called from as few places as can be, and loops over joints end at a number that no compiler knows: drivers write
// both out as often as they are run, and compile that before the first image.

override BODIES: u32;

const JOINTS = 6u;
const STEPS = 4u;
const DAMPING = 0.01;
// The place of the first joint, the turn about it, and those of forearm and wrist; behind their columns, the errors.
const FREEDOMS = 8u;
const COLUMNS = FREEDOMS + 1u;
const NEAREST = 0.01;
const GREATEST = 3.4e38;

struct Links {
    shoulder_offset: f32,
    upper_arm: f32,
    elbow_offset: f32,
    forearm: f32,
    wrist_offset: f32,
    wrist: f32,
}

struct Posture {
    origin: vec3<f32>,
    axis: vec3<f32>,
    // Unit vectors at right angles to the axis.
    limbs: array<vec3<f32>, 3>,
}

const UPPER_ARM = 0u;
const FOREARM = 1u;
const WRIST = 2u;

// JOINTS.
var<private> joints: u32;

// The links of each body, then `across` and `along`, row by row.
@group(0) @binding(3) var<storage, read> arm: array<f32>;

var<workgroup> seen: array<vec3<f32>, JOINTS>;
var<workgroup> sight: vec3<f32>;
var<workgroup> mean_depth: f32;
var<workgroup> posture: Posture;
// Where that has the joints.
var<workgroup> places: array<vec3<f32>, JOINTS>;
// Each column as it is, and whitened.
var<workgroup> plain: array<array<vec4<f32>, JOINTS>, COLUMNS>;
var<workgroup> columns: array<array<vec4<f32>, JOINTS>, COLUMNS>;
// The normal equations, below them the errors' own product, and what solves them.
var<workgroup> rows: array<array<f32, COLUMNS>, COLUMNS>;
var<workgroup> by: array<f32, FREEDOMS>;
var<workgroup> best: array<vec3<f32>, JOINTS>;

fn value(image: u32, channel: u32) -> f32 {
    return input_at(channel / 4u * BATCH + image, 0u, 0u)[channel % 4u];
}

fn links_of(body: u32) -> Links {
    let at = 6u * body;
    return Links(arm[at], arm[at + 1u], arm[at + 2u], arm[at + 3u], arm[at + 4u], arm[at + 5u]);
}

fn weight(i: u32, j: u32) -> vec4<f32> {
    let at = 6u * BODIES + JOINTS * i + j;
    return vec4(vec3(arm[at]), arm[at + JOINTS * JOINTS]);
}

// A unit vector, or nothing of nothing.
fn direction(vector: vec3<f32>) -> vec3<f32> {
    return vector / max(length(vector), 1e-12);
}

// Of a link at a right angle to the axis.
fn level(link: vec3<f32>, axis: vec3<f32>) -> vec3<f32> {
    return direction(link - dot(link, axis) * axis);
}

fn turned(vector: vec3<f32>, turn: vec3<f32>) -> vec3<f32> {
    let angle = length(turn);
    let axis = turn / max(angle, 1e-12);
    return vector * cos(angle) + cross(axis, vector) * sin(angle) + axis * (dot(axis, vector) * (1.0 - cos(angle)));
}

fn joint_of(links: Links, joint: u32) -> vec3<f32> {
    var place = posture.origin;
    if joint >= 1u {
        place += links.shoulder_offset * posture.axis;
    }
    if joint >= 2u {
        place += links.upper_arm * posture.limbs[UPPER_ARM] + links.elbow_offset * posture.axis;
    }
    if joint >= 3u {
        place += links.forearm * posture.limbs[FOREARM];
    }
    if joint >= 4u {
        place += links.wrist_offset * posture.axis;
    }
    if joint >= 5u {
        place += links.wrist * posture.limbs[WRIST];
    }
    return place;
}

fn assume_posture(links: Links) {
    let along = direction(links.shoulder_offset * (seen[1] - seen[0]) + links.wrist_offset * (seen[4] - seen[3]));
    let upper_arm = seen[2] - seen[1] - links.elbow_offset * along;
    let forearm = seen[3] - seen[2];
    var across = cross(upper_arm, forearm) / max(length(upper_arm) * length(forearm), 1e-12);
    if dot(across, along) < 0.0 {
        across = -across;
    }
    let axis = direction(along + across);
    var limbs = array(upper_arm, forearm, seen[5] - seen[4]);
    // Of as many joints each link is a part.
    let lengths = array(4.0 * links.upper_arm, 3.0 * links.forearm, links.wrist);
    var off = -(5.0 * links.shoulder_offset + 4.0 * links.elbow_offset + 2.0 * links.wrist_offset) * axis;
    for (var limb = 0u; limb < 3u; limb++) {
        limbs[limb] = level(limbs[limb], axis);
        off -= lengths[limb] * limbs[limb];
    }
    for (var joint = 0u; joint < joints; joint++) {
        off += seen[joint];
    }
    posture = Posture(off / f32(JOINTS), axis, limbs);
}

fn depth_of(joint: vec3<f32>) -> f32 {
    return max(dot(joint, sight), NEAREST);
}

// How far a joint is from where it is seen.
fn error(place: vec3<f32>, joint: u32) -> vec4<f32> {
    let depth = depth_of(place);
    let seen_depth = depth_of(seen[joint]);
    return vec4(mean_depth * (place / depth - seen[joint] / seen_depth), log(depth / seen_depth));
}

// How that changes with a freedom.
fn change(place: vec3<f32>, links: Links, freedom: u32, joint: u32) -> vec4<f32> {
    var moved = vec3(0.0);
    if freedom < 3u {
        moved[freedom] = 1.0;
    } else if freedom < 6u {
        var unit = vec3(0.0);
        unit[freedom - 3u] = 1.0;
        moved = cross(unit, place - posture.origin);
    } else if freedom == 6u && joint >= 3u {
        moved = links.forearm * cross(posture.axis, posture.limbs[FOREARM]);
    } else if freedom == 7u && joint == 5u {
        moved = links.wrist * cross(posture.axis, posture.limbs[WRIST]);
    }
    let depth = depth_of(place);
    let nearer = dot(sight, moved) / depth;
    return vec4(mean_depth / depth * (moved - nearer * place), nearer);
}

// What a column holds of a joint: how its error changes, or the error itself.
fn entry_of(column: u32, joint: u32, links: Links) -> vec4<f32> {
    let place = places[joint];
    if column == FREEDOMS {
        return error(place, joint);
    }
    return change(place, links, column, joint);
}

fn whitened(column: u32, i: u32) -> vec4<f32> {
    var sum = vec4(0.0);
    for (var j = 0u; j < joints; j++) {
        sum += weight(i, j) * plain[column][j];
    }
    return sum;
}

fn product(a: u32, b: u32) -> f32 {
    var sum = 0.0;
    for (var joint = 0u; joint < joints; joint++) {
        sum += dot(columns[a][joint], columns[b][joint]);
    }
    return sum;
}

// By Gauss's elimination.
fn solve() {
    for (var i = 0u; i < FREEDOMS; i++) {
        for (var j = i + 1u; j < FREEDOMS; j++) {
            let factor = rows[j][i] / rows[i][i];
            for (var k = i; k < COLUMNS; k++) {
                rows[j][k] -= factor * rows[i][k];
            }
        }
    }
    for (var back = 0u; back < FREEDOMS; back++) {
        let i = FREEDOMS - 1u - back;
        var value = rows[i][FREEDOMS];
        for (var j = i + 1u; j < FREEDOMS; j++) {
            value -= rows[i][j] * by[j];
        }
        by[i] = value / rows[i][i];
    }
}

fn move_posture() {
    solve();
    let turn = vec3(by[3], by[4], by[5]);
    posture.origin += vec3(by[0], by[1], by[2]);
    // Links keep their lengths, however roughly a driver works out sines.
    posture.axis = direction(turned(posture.axis, turn));
    for (var limb = 0u; limb < 3u; limb++) {
        // The upper arm turns with the whole alone.
        let bend = select(by[5u + limb], 0.0, limb == UPPER_ARM);
        let turned_limb = turned(turned(posture.limbs[limb], turn), bend * posture.axis);
        posture.limbs[limb] = level(turned_limb, posture.axis);
    }
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let image = group.y * groups.x + group.x;
    joints = JOINTS * groups.z;
    if image >= BATCH {
        return;
    }
    if lane < JOINTS {
        seen[lane] = vec3(value(image, 3u * lane), value(image, 3u * lane + 1u), value(image, 3u * lane + 2u));
    }
    workgroupBarrier();
    if lane == 0u {
        var sum = vec3(0.0);
        for (var joint = 0u; joint < joints; joint++) {
            sum += seen[joint];
        }
        sight = direction(sum);
    }
    workgroupBarrier();
    // Joints that are not numbers, or not in front of the camera, stay as they are.
    var possible = true;
    var depths = 0.0;
    for (var joint = 0u; joint < joints; joint++) {
        let depth = dot(seen[joint], sight);
        possible &= depth >= NEAREST && depth <= 1e6;
        depths += depth;
    }
    if lane == 0u {
        mean_depth = depths / f32(JOINTS);
    }
    if lane < JOINTS {
        best[lane] = seen[lane];
    }
    var least = GREATEST;
    for (var body = 0u; body < BODIES; body++) {
        let links = links_of(body);
        if lane == 0u {
            assume_posture(links);
        }
        // One more than steps: for the errors that remain.
        for (var iteration = 0u; iteration <= STEPS; iteration++) {
            workgroupBarrier();
            if lane < JOINTS {
                places[lane] = joint_of(links, lane);
            }
            workgroupBarrier();
            let column = lane / JOINTS;
            let joint = lane % JOINTS;
            if column < COLUMNS {
                plain[column][joint] = entry_of(column, joint, links);
            }
            workgroupBarrier();
            if column < COLUMNS {
                columns[column][joint] = whitened(column, joint);
            }
            workgroupBarrier();
            for (var entry = lane; entry < COLUMNS * COLUMNS; entry += 64u) {
                let i = entry / COLUMNS;
                let j = entry % COLUMNS;
                let sum = product(i, j);
                let signed = select(sum, -sum, j == FREEDOMS && i < FREEDOMS);
                rows[i][j] = select(signed, (1.0 + DAMPING) * sum, i == j && i < FREEDOMS);
            }
            workgroupBarrier();
            if lane == 0u && iteration < STEPS {
                move_posture();
            }
        }
        let cost = rows[FREEDOMS][FREEDOMS];
        if possible && cost < least {
            least = cost;
            if lane < JOINTS {
                best[lane] = places[lane];
            }
        }
    }
    workgroupBarrier();
    if 4u * lane < 3u * JOINTS {
        var texel = vec4(0.0);
        for (var part = 0u; part < 4u; part++) {
            let channel = 4u * lane + part;
            if channel < 3u * JOINTS {
                texel[part] = best[channel / 3u][channel % 3u];
            }
        }
        output_set(lane * BATCH + image, 0u, 0u, texel);
    }
}
