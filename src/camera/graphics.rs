//! For programs that draw: the frame and the projection of graphics.

use glam::{Mat4, Vec3, Vec4};

use super::Camera;

/// A point of the camera optical frame (REP 103: x right, y down, z forward) in the frame of a graphics
/// camera: x right, y up, z backward. In metres.
pub fn to_graphics([x, y, z]: [f64; 3]) -> Vec3 {
    Vec3::new(x as f32, -y as f32, -z as f32)
}

/// The projection that draws points of the graphics camera's frame where `camera`'s intrinsics put them
/// in an image that fills the viewport. To the clip space of WebGPU: y up, depth from 0 at `near` to 1 at
/// `far`, in metres. It has no lens: over an image of a camera that bends lines, what is drawn is off by as
/// much as [`Distortion`](super::Distortion) says.
pub fn projection(camera: &Camera, near: f32, far: f32) -> Mat4 {
    let intrinsics = camera.intrinsics;
    let [width, height] = [camera.width, camera.height].map(f64::from);
    // Pixel (0, 0) is the centre of the top-left pixel: the image begins half a pixel before.
    let x = (2.0 * (intrinsics.cx + 0.5) / width - 1.0) as f32;
    let y = (1.0 - 2.0 * (intrinsics.cy + 0.5) / height) as f32;
    let depth = far / (near - far);
    Mat4::from_cols(
        Vec4::new((2.0 * intrinsics.fx / width) as f32, 0.0, 0.0, 0.0),
        Vec4::new(0.0, (2.0 * intrinsics.fy / height) as f32, 0.0, 0.0),
        Vec4::new(-x, -y, depth, -1.0),
        Vec4::new(0.0, 0.0, near * depth, 0.0),
    )
}
