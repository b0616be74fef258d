import numpy as np
import pytest
import torch

from arms import BODY, OTHER, arms
from whereabot_trainer import golden, kinematic_fit


def off_by(joints, metres, seed=2):
    noise = torch.randn(joints.shape, generator=torch.Generator().manual_seed(seed), dtype=joints.dtype)
    return joints + metres * noise


def mean_error(joints, truth):
    return (joints - truth).norm(dim=2).mean().item()


def test_the_bodies_among_joints_are_told():
    found = kinematic_fit.bodies(torch.cat([arms(BODY), arms(OTHER)]).numpy())
    assert found == [pytest.approx(BODY, abs=1e-5), pytest.approx(OTHER, abs=1e-5)]
    # Joints of an arm of another kind have no such links.
    bent = arms(BODY)
    bent[:, 5] += 0.02
    assert kinematic_fit.bodies(bent.numpy()) is None
    assert kinematic_fit.arm_of(bent.numpy(), bent.numpy()) is None


def test_the_fit_takes_out_what_no_arm_can_have():
    truth = arms(BODY)
    seen = off_by(truth, 0.015)
    arm = kinematic_fit.arm_of(off_by(arms(BODY, seed=3), 0.015, seed=4).numpy(), arms(BODY, seed=3).numpy())
    fitted = kinematic_fit.fit(seen, arm)
    # Eight freedoms of eighteen.
    assert mean_error(fitted, truth) < 0.75 * mean_error(seen, truth)
    # Negative control: of another arm's links.
    longer = arm | {"bodies": [BODY | {"forearm": 0.55}]}
    assert mean_error(kinematic_fit.fit(seen, longer), truth) > mean_error(seen, truth)
    links = kinematic_fit.links_of(fitted.numpy())
    assert np.abs(links - [BODY[link] for link in kinematic_fit.LINKS]).max() < 1e-5


def test_errors_that_go_together_are_learnt():
    truth = arms(BODY, 400)
    generator = torch.Generator().manual_seed(5)
    # All of an arm as much too far away, and joints a little off.
    farther = 1 + 0.05 * torch.randn(400, 1, 1, generator=generator, dtype=truth.dtype)
    seen = off_by(truth, 0.005) * farther
    arm = kinematic_fit.arm_of(seen.numpy(), truth.numpy())
    alone = arm | {part: np.diag(np.diag(arm[part])).tolist() for part in ("across", "along")}
    assert mean_error(kinematic_fit.fit(seen, arm), truth) < mean_error(kinematic_fit.fit(seen, alone), truth)


def test_joints_that_cannot_be_stay_as_they_are():
    seen = off_by(arms(BODY, 4), 0.02)
    seen[0, 2, 1], seen[1, 3, 2] = torch.nan, -3.0
    fitted = kinematic_fit.fit(seen, golden.ARM)
    assert torch.equal(fitted[:2].nan_to_num(7), seen[:2].nan_to_num(7))
    assert not torch.isclose(fitted[2:], seen[2:], atol=1e-4).all()


def test_of_two_bodies_the_one_that_fits_is_taken():
    for body in (BODY, OTHER):
        truth = arms(body)
        assert mean_error(kinematic_fit.fit(truth, golden.ARM), truth) < 1e-4


def test_it_runs_where_the_joints_are():
    # As on a machine with a GPU, whose tensors are made there unless one says otherwise.
    truth = arms(BODY, 4)
    seen, expected = off_by(truth, 0.01), kinematic_fit.fit(off_by(truth, 0.01), golden.ARM)
    with torch.device("meta"):
        assert torch.zeros(1).device.type == "meta"
        assert torch.equal(kinematic_fit.fit(seen, golden.ARM), expected)
        assert kinematic_fit.arm_of(seen.numpy(), truth.numpy())["bodies"] == [pytest.approx(BODY, abs=1e-5)]
