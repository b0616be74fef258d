"""The paper's losses, equations 1 to 5."""

import torch

CLIP = 1e-6


def class_weights(foreground_share):
    """(w_fg, w_bg): the inverse class probabilities (eq. 1 and 2), from the share of robot pixels in the training set.

    The share is kept within [0.005, 0.995], so that a nearly empty training set gives a finite weight.
    """
    share = min(max(foreground_share, 0.005), 0.995)
    return 1 / share, 1 / (1 - share)


def mask_loss(estimate, truth, w_fg, w_bg):
    """The weighted cross-entropy per pixel (eq. 3), summed and divided by the number of pixels (eq. 4).

    Equation 3 is printed with estimate and truth exchanged, which would take the logarithm of the truth's zeros; this
    is the cross-entropy that it means. The estimate is clipped so that no logarithm is infinite.
    """
    estimate = estimate.clamp(CLIP, 1 - CLIP)
    loss = -w_fg * truth * torch.log(estimate) - w_bg * (1 - truth) * torch.log(1 - estimate)
    return loss.mean()


def joint_distances(estimate, truth):
    """Euclidean distance of each joint, [N, joints], of positions [N, joints, 3]."""
    return torch.linalg.vector_norm(estimate - truth, dim=-1)


def joint_loss(estimate, truth):
    """The mean Euclidean distance over joints (eq. 5) and samples."""
    return joint_distances(estimate, truth).mean()
