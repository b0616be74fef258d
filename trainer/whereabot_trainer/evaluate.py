"""The paper's figures (section 5) and what calibration needs, on samples that were not trained on."""

import numpy as np
import torch

from . import kinematic_fit, losses, zoom
from .networks import CAMERA, JOINTS, overlay, run

BATCH = 8
# Bins of the mask's logit, for IoU at every threshold at once.
LOGIT_EDGES = np.linspace(-10, 10, 201)


def _batches(numbers):
    return (numbers[start : start + BATCH] for start in range(0, len(numbers), BATCH))


def shift_logits(network, shift):
    """Adds `shift` to the logit of a mask network, in place: exact, because the last convolution's bias is inside the sigmoid."""
    last = next(layer["name"] for layer in reversed(network.layers) if layer["op"] == "conv2d")
    with torch.no_grad():
        getattr(network, last).bias.add_(shift)


@torch.no_grad()
def masks_of(network, pictures, coarse=None, bf16=False):
    """The canonical camera's masks [N, 1, H, W] of recordings' own pixels [N, 3, 2 H, 2 W]: the mask network's, which looks where the
    `coarse` network's mask turns it to if there is one."""
    images = zoom.canonical(pictures)
    if coarse is None:
        return run(network, images, bf16)
    mask = run(coarse, images, bf16)
    cameras = zoom.look_at(mask, zoom.MASK_ZOOM, zoom.LOOKED_AT)
    return zoom.merge(mask, run(network, zoom.rectify(pictures, *cameras), bf16), *cameras)


def estimate_masks(network, samples, numbers, device, coarse=None):
    """The mask network's answer for each sample as {number: uint8 [H, W]}, 255 for certain; `coarse` as of `masks_of`."""
    answers = {}
    for batch in _batches(numbers):
        estimate = masks_of(network, samples.pictures(batch)[0].to(device), coarse)
        for number, mask in zip(batch, estimate, strict=True):
            answers[int(number)] = (mask[0] * 255).round().byte().cpu().numpy()
    return answers


def mask_histograms(network, samples, numbers, device, coarse=None):
    """Pixels by logit: (robot, background), each [N, bins], for each of the samples."""
    bins = len(LOGIT_EDGES) - 1
    edges = torch.from_numpy(LOGIT_EDGES[1:-1]).to(device)
    histograms = []
    for batch in _batches(numbers):
        pictures, masks = samples.pictures(batch)
        logits = torch.logit(masks_of(network, pictures.to(device), coarse).double(), eps=1e-6)
        # A value on an edge is of the bin above.
        counted = torch.bucketize(logits, edges, right=True) + bins * (masks.to(device) < 0.5)
        histograms += [torch.bincount(each.flatten(), minlength=2 * bins).cpu().numpy() for each in counted]
    robot, background = np.asarray(histograms).reshape(-1, 2, bins).transpose(1, 0, 2)
    return robot, background


def figures_by_threshold(robot, background):
    """Accuracy, IoU, precision and recall at each of LOGIT_EDGES' lower edges as threshold.

    IoU is the mean over the images that show a robot; the others are over all pixels.
    """
    hits, alarms = (part[:, ::-1].cumsum(1)[:, ::-1].astype(float) for part in (robot, background))
    positives = hits[:, :1]
    shown = positives[:, 0] > 0
    iou = (hits[shown] / (positives + alarms)[shown]).mean(0) if shown.any() else np.zeros(robot.shape[1])
    total = robot.sum() + background.sum()
    return {
        "accuracy": (hits.sum(0) + background.sum() - alarms.sum(0)) / total, "iou": iou,
        "precision": hits.sum(0) / np.maximum(hits.sum(0) + alarms.sum(0), 1),
        "recall": hits.sum(0) / max(robot.sum(), 1),
    }


def calibrate(network, samples, numbers, device, coarse=None):
    """The shift of the logit that gives the best IoU at the threshold 0.5."""
    curves = figures_by_threshold(*mask_histograms(network, samples, numbers, device, coarse))
    return round(float(-LOGIT_EDGES[int(curves["iou"].argmax())]), 3)


def score_mask(network, samples, numbers, device, shift=0.0, coarse=None):
    """Figures at the threshold 0.5, the logits being shifted."""
    curves = figures_by_threshold(*mask_histograms(network, samples, numbers, device, coarse))
    half = int(np.argmin(np.abs(LOGIT_EDGES[:-1] + shift)))
    return {name: round(float(curve[half]), 4) for name, curve in curves.items()}


def overlays(images, masks, rule, view, camera=CAMERA):
    """(the joint network's input, the cameras that see it) of images [N, 3, H, W] and masks [N, 1, H, W]: by the overlay's
    rule and, unless it is None, the zoom's."""
    if view is None:
        return overlay(images, masks, rule), None
    cameras = zoom.look_at(masks, view, rule, camera)
    seen = zoom.see(torch.cat([images, masks], 1), *cameras, camera)
    return overlay(seen[:, :3], seen[:, 3:], rule), cameras


@torch.no_grad()
def estimate_joints(network, metres, samples, numbers, estimated, rules, device):
    """The joints [N, 6, 3] in metres with the true masks, or with `estimated` ones; `rules` are the overlay's and the zoom's."""
    joints = []
    for batch in _batches(numbers):
        images, masks = samples.pixels(batch)
        if estimated is not None:
            masks = torch.stack([torch.from_numpy(estimated[int(number)])[None].float() / 255 for number in batch])
        seen, cameras = overlays(images.to(device), masks.to(device), *rules)
        arms = torch.from_numpy(samples.arms[batch]).to(device)
        estimate = metres(network(seen.contiguous(memory_format=torch.channels_last)), arms)
        if cameras is not None:
            estimate = zoom.joints_of(estimate, *cameras)
        joints.append(estimate.cpu())
    return torch.cat(joints)


def joint_errors(network, metres, samples, numbers, estimated, rules, device, arm=None):
    """Distances [N, 6] in metres of those from the true joints, fitted to the `arm` where there is one."""
    estimate = estimate_joints(network, metres, samples, numbers, estimated, rules, device)
    if arm is not None:
        estimate = kinematic_fit.fit(estimate, arm)
    return losses.joint_distances(estimate, torch.from_numpy(samples.joints[numbers])).numpy()


def score_joints(network, metres, samples, numbers, estimated, rules, device, name, arm=None):
    """Mean and median over samples of the error in centimetres, each sample's being the mean over its joints."""
    each = 100 * joint_errors(network, metres, samples, numbers, estimated, rules, device, arm).mean(1)
    return {f"{name}_mean_cm": round(float(each.mean()), 2), f"{name}_median_cm": round(float(np.median(each)), 2)}


def identity_metres(outputs, _arms):
    """The joints [N, 6, 3] of an exported joint network, whose outputs are metres."""
    return outputs.reshape(-1, len(JOINTS), 3)
