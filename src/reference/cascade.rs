use super::{
    Gaze, Tensor, kinematic_fit, overlay, run, zoom, zoom_image, zoom_joints, zoom_mask,
    zoom_overlay,
};
use crate::camera::Intrinsics;
use crate::network::{Description, Model, Overlay, Zoom};

/// The mask of the robot in `image`: the mask network's and, where `model` has a coarse network, that one's beyond what its camera
/// sees. `None` where the image is not what the networks take.
pub fn mask(model: &Model, image: &Tensor) -> Option<Tensor> {
    let Some((network, rules)) = model.coarse() else {
        return run(&model.mask_network, image);
    };
    let (coarse, camera) = (run(network, image)?, &model.description.camera);
    let (seen, gaze) = mask_input(image, &coarse, camera, rules);
    let closer = run(&model.mask_network, &seen)?;
    Some(zoom_mask(&closer, &coarse, camera, &gaze))
}

/// The mask network's input behind a coarse network, and where it looks from: what it sees of `image` by the `coarse` mask.
pub fn mask_input(
    image: &Tensor,
    coarse: &Tensor,
    camera: &Intrinsics,
    rules: Zoom,
) -> (Tensor, Gaze) {
    let gaze = zoom(coarse, Overlay::Multiply {}, camera, rules);
    (zoom_image(image, camera, &gaze), gaze)
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
