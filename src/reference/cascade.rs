use super::{
    Gaze, Tensor, kinematic_fit, overlay, run, zoom, zoom_image, zoom_joints, zoom_mask,
    zoom_overlay,
};
use crate::network::{Description, Model, Overlay};

/// The mask of the robot in `image`: the mask network's, of the second look too where `model` takes one. `None` where the
/// image is not what the network takes.
pub fn mask(model: &Model, image: &Tensor) -> Option<Tensor> {
    let (network, description) = (&model.mask_network, &model.description);
    let first = run(network, image)?;
    let Some((closer, gaze)) = second_look(image, &first, description) else {
        return Some(first);
    };
    let closer = run(network, &closer)?;
    Some(zoom_mask(&closer, &first, &description.camera, &gaze))
}

/// The mask network's input when it looks again, at what its `first` mask of `image` shows, and where it looks from. `None` where
/// `description` asks for one look.
pub fn second_look(
    image: &Tensor,
    first: &Tensor,
    description: &Description,
) -> Option<(Tensor, Gaze)> {
    let camera = &description.camera;
    let gaze = zoom(
        first,
        Overlay::Multiply {},
        camera,
        description.second_look?,
    );
    Some((zoom_image(image, camera, &gaze), gaze))
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
