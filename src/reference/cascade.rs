use super::{Tensor, kinematic_fit, overlay, run, zoom, zoom_joints, zoom_mask, zoom_overlay};
use crate::camera::{Gaze, Intrinsics};
use crate::network::{Description, Model, Overlay, Zoom};

/// The mask of the robot in `image`, the canonical camera's: the mask network's and, where `model` has a coarse network, that one's
/// beyond what its camera sees. `rectified` gives what a camera sees of the picture that `image` was made from. `None` where the images
/// are not what the networks take.
pub fn mask(
    model: &Model,
    image: &Tensor,
    rectified: impl FnOnce(&Gaze) -> Tensor,
) -> Option<Tensor> {
    let Some((network, rules)) = model.coarse() else {
        return run(&model.mask_network, image);
    };
    let (coarse, camera) = (run(network, image)?, &model.description.camera);
    let gaze = mask_gaze(&coarse, camera, rules);
    let closer = run(&model.mask_network, &rectified(&gaze))?;
    Some(zoom_mask(&closer, &coarse, camera, &gaze))
}

/// Where the mask network looks behind a coarse network: to the `coarse` mask, each pixel as heavy as it is probable.
pub fn mask_gaze(coarse: &Tensor, camera: &Intrinsics, rules: Zoom) -> Gaze {
    zoom(coarse, Overlay::Multiply {}, camera, rules)
}

/// The joint network's input, and where it looks from unless that is the canonical camera: the overlay of `image` and
/// `mask` that `description` asks for.
pub fn joint_input(
    image: &Tensor,
    mask: &Tensor,
    description: &Description,
) -> (Tensor, Option<Gaze>) {
    let rule = description.overlay;
    let Some(rules) = description.zoom else {
        return (overlay(image, mask, rule), None);
    };
    let camera = &description.camera;
    let gaze = zoom(mask, rule, camera, rules);
    (zoom_overlay(image, mask, rule, camera, &gaze), Some(gaze))
}

/// Where `model` puts the joints of the robot that `mask` shows in `image`: `x, y, z` a joint, in the canonical camera's
/// frame. `None` where image and mask are not what its networks take.
pub fn joints(model: &Model, image: &Tensor, mask: &Tensor) -> Option<Vec<f32>> {
    let (input, gaze) = joint_input(image, mask, &model.description);
    let joints = run(&model.joint_network, &input)?;
    let joints = match gaze {
        Some(gaze) => zoom_joints(joints.data(), &gaze),
        None => joints.data().to_vec(),
    };
    Some(match &model.description.arm {
        Some(arm) => kinematic_fit(&joints, arm),
        None => joints,
    })
}
