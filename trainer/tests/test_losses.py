import math

import pytest
import torch

from whereabot_trainer import losses


def test_class_weights_are_inverse_frequencies():
    assert losses.class_weights(0.1) == pytest.approx((10, 1 / 0.9))
    assert losses.class_weights(0.0)[0] == 200, "an empty class is clamped"


def test_mask_loss_by_hand():
    estimate, truth = torch.tensor([[0.8, 0.3]]), torch.tensor([[1.0, 0.0]])
    by_hand = (-10 * math.log(0.8) - 2 * math.log(1 - 0.3)) / 2
    assert losses.mask_loss(estimate, truth, 10, 2).item() == pytest.approx(by_hand, rel=1e-6)
    # Exchanged as the equation is printed, or with exchanged weights, the value is another.
    assert losses.mask_loss(truth, estimate, 10, 2).item() != pytest.approx(by_hand, rel=1e-2)
    assert losses.mask_loss(estimate, truth, 2, 10).item() != pytest.approx(by_hand, rel=1e-2)


def test_mask_loss_is_finite_where_the_estimate_is_certain():
    loss = losses.mask_loss(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0]), 10, 2)
    assert torch.isfinite(loss) and loss > 10


def test_joint_loss_by_hand():
    truth = torch.zeros(1, 2, 3)
    estimate = torch.tensor([[[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]]])
    assert losses.joint_loss(estimate, truth).item() == pytest.approx((5 + 1) / 2)
    estimate[0, 1, 2] += 0.1
    assert losses.joint_loss(estimate, truth).item() != pytest.approx((5 + 1) / 2, rel=1e-3)
