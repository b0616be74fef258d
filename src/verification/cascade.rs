use image::{Rgba, RgbaImage, imageops};

use super::comparison::Comparison;
use super::stages::numbers;
use crate::camera::{Camera, Distortion, Gaze, Intrinsics, Rectification};
use crate::gpu::{Device, Frame, GpuError, Plan, Precision};
use crate::network::Model;
use crate::reference;

/// What is compared of the cascade.
pub(super) const PARTS: [&str; 3] = ["cascade.mask", "cascade.coverage", "cascade.joints"];

/// How far masks (probabilities) and joints (metres) may be apart. The pictures show no arm, and the kinematic fit of joints that
/// are far from any makes several times of what roundings bring them apart.
fn allowed(precision: Precision, fitted: bool) -> [f32; 2] {
    let [mask, joints] = match precision {
        Precision::F32 => [1e-4, 1e-4],
        Precision::F16 => [5e-2, 2e-3],
    };
    [mask, if fitted { 5.0 * joints } else { joints }]
}

/// Runs `model` on the pictures: comparisons of each of [`PARTS`], picture by picture. The joints are held to
/// what the reference makes of the adapter's own mask: whether a pixel that hardly reaches the overlay's
/// threshold does so is rounding's choice.
///
/// # Errors
/// Whatever keeps the device from running it.
pub(super) async fn compare(
    device: &Device,
    model: &Model,
    precision: Precision,
) -> Result<[Vec<Comparison>; 3], GpuError> {
    let description = &model.description;
    let input = description.input;
    let mut plan = Plan::new(device, model, 1, precision)?;
    let mut frames = Vec::new();
    let mut images = Vec::new();
    for (picture, camera) in pictures() {
        let params = Rectification::new(&camera, &description.camera, input.width, input.height);
        plan.write(device, 0, &picture, &params)?;
        frames.extend(plan.run_async(device, true, true).await?);
        let (rows, columns) = (input.height as usize, input.width as usize);
        let rectified =
            move |gaze: &Gaze| reference::rectify(&picture, &params, gaze, rows, columns);
        images.push(rectified);
    }
    let [mask_allowed, joints_allowed] = allowed(precision, model.description.arm.is_some());
    let mut parts = [Vec::new(), Vec::new(), Vec::new()];
    // The control is the answer to the other picture.
    for ((rectified, frame), other) in images.iter().zip(&frames).zip(frames.iter().rev()) {
        let expected = expected(model, rectified, &frame.mask).unwrap_or(Frame {
            joints: Vec::new(),
            mask: Vec::new(),
            ..frame.clone()
        });
        let comparison = |value: &dyn Fn(&Frame) -> Vec<f32>, allowed| Comparison {
            found: value(frame),
            expected: value(&expected),
            control: value(other),
            allowed,
        };
        parts[0].push(comparison(&|frame| frame.mask.clone(), mask_allowed));
        parts[1].push(comparison(&|frame| numbers(frame.coverage).to_vec(), 0.0));
        parts[2].push(comparison(&|frame| frame.joints.clone(), joints_allowed));
    }
    Ok(parts)
}

/// What the reference makes of a picture, of which `rectified` gives what a camera sees: the mask; and behind `mask`, coverage
/// and joints. `None` where the networks do not fit together.
fn expected(
    model: &Model,
    rectified: impl Fn(&Gaze) -> reference::Tensor,
    mask: &[f32],
) -> Option<Frame> {
    let description = &model.description;
    let presence = description.presence;
    let image = &rectified(&Gaze::CANONICAL);
    let expected = reference::mask(model, image, rectified)?;
    let mask = reference::Tensor::new(expected.shape(), mask.to_vec())?;
    Some(Frame {
        coverage: reference::coverage(&mask, presence.mask_threshold, presence.sure_threshold),
        joints: reference::joints(model, image, &mask)?,
        mask: expected.data().to_vec(),
    })
}

/// A rendered UR5 of 128 x 106 pixels, and what comes before its pixels in the file.
const HEADER: &[u8] = b"P6\n128 106\n255\n";
const ROBOT: &[u8; HEADER.len() + 3 * 128 * 106] = include_bytes!("robot.ppm");

/// A robot as it was rendered, and the same mirrored, as if a lens had bent it.
fn pictures() -> [(RgbaImage, Camera); 2] {
    let (width, height) = (128, 106);
    let picture = RgbaImage::from_fn(width, height, |x, y| {
        let at = HEADER.len() + 3 * (y * width + x) as usize;
        Rgba([ROBOT[at], ROBOT[at + 1], ROBOT[at + 2], 255])
    });
    let camera = Camera {
        width,
        height,
        intrinsics: Intrinsics {
            fx: 91.25,
            fy: 91.25,
            cx: 63.5,
            cy: 52.5,
        },
        distortion: Distortion::None,
    };
    let lens = Distortion::Rational {
        k: [-0.1, 0.01, 0.0, 0.0, 0.0, 0.0],
        p: [0.001, -0.001],
    };
    let mirrored = imageops::flip_horizontal(&picture);
    let bent = Camera {
        distortion: lens,
        ..camera
    };
    [(picture, camera), (mirrored, bent)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_is_what_its_header_says() {
        assert_eq!(&ROBOT[..HEADER.len()], HEADER);
        let [(picture, _), (mirrored, _)] = pictures();
        assert_eq!(picture.get_pixel(0, 7), mirrored.get_pixel(127, 7));
        assert_ne!(picture, mirrored);
    }
}
