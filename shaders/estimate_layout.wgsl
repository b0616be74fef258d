// What was found in an image, for a host's shaders: `array<Estimate>`, one an image of the batch.
// JOINTS is the model's number of joints.

// Too few pixels surely belong to a robot.
const NOT_FOUND = 0u;
// A robot, with joints.
const FOUND = 1u;
// A mask or joints that cannot be.
const INVALID = 2u;

struct Estimate {
    status: u32,
    // pixels of the network's image that are robot, and those that surely are
    pixels: u32,
    sure: u32,
    // camera optical frame (x right, y down, z forward), in metres; w is 1 where the status is FOUND, and
    // all is 0 elsewhere
    joints: array<vec4<f32>, JOINTS>,
}
