"""Joints of arms with a UR5's and a UR5e's links."""

import torch

from whereabot_trainer import golden

BODY, OTHER = golden.ARM["bodies"]


def arms(body, count=200, seed=1):
    """Joints [N, 6, 3] of random arms in front of a camera."""
    generator = torch.Generator().manual_seed(seed)

    def unit():
        return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)

    axis = unit()
    upper, forearm, wrist = (
        torch.nn.functional.normalize(link - (link * axis).sum(1, keepdim=True) * axis, dim=1) for link in (unit(), unit(), unit()))
    first = torch.tensor([0.1, -0.2, 2.5], dtype=torch.float64) + 0.3 * unit()
    return torch.stack([
        first, body["shoulder_offset"] * axis, body["upper_arm"] * upper + body["elbow_offset"] * axis, body["forearm"] * forearm,
        body["wrist_offset"] * axis, body["wrist"] * wrist], 1).cumsum(1)
