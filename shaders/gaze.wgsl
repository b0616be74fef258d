// A camera that looks closer, one an image of the batch: where the canonical camera is, turned to the robot, zoomed in on
// it. Stands in front of the kernels that see through it.
struct Gaze {
    // Rows of the rotation from the canonical camera's frame to this one's; beside the first, the zoom.
    right: vec4<f32>,
    down: vec4<f32>,
    ahead: vec4<f32>,
}

// What lies in the direction `seen`, in the canonical camera's frame.
fn turned_back(gaze: Gaze, seen: vec3<f32>) -> vec3<f32> {
    return gaze.right.xyz * seen.x + gaze.down.xyz * seen.y + gaze.ahead.xyz * seen.z;
}

// What lies in the direction `ray` of the canonical camera's frame, in this one's.
fn turned(gaze: Gaze, ray: vec3<f32>) -> vec3<f32> {
    return vec3(dot(gaze.right.xyz, ray), dot(gaze.down.xyz, ray), dot(gaze.ahead.xyz, ray));
}
