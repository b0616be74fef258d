import torch

from whereabot_trainer import zoom
from whereabot_trainer.networks import CAMERA, INPUT_HEIGHT, INPUT_WIDTH, OVERLAYS, overlay


def _centroid(picture):
    v, u = torch.meshgrid(torch.arange(INPUT_HEIGHT), torch.arange(INPUT_WIDTH), indexing="ij")
    return torch.stack([(picture * u).sum(), (picture * v).sum()]) / picture.sum()


def _project(points):
    return torch.stack([CAMERA["fx"] * points[..., 0] / points[..., 2] + CAMERA["cx"],
                        CAMERA["fy"] * points[..., 1] / points[..., 2] + CAMERA["cy"]], -1)


def _markers(points, width=18):
    images = torch.zeros(len(points), INPUT_HEIGHT, INPUT_WIDTH)
    v, u = torch.meshgrid(torch.arange(INPUT_HEIGHT), torch.arange(INPUT_WIDTH), indexing="ij")
    for channel, (x, y) in enumerate(_project(points)):
        images[channel] = torch.exp(-((u - x) ** 2 + (v - y) ** 2) / width)
    return images


def test_joints_are_where_the_picture_shows_them():
    torch.manual_seed(3)
    joints = torch.tensor([[[0.2, -0.1, 1.5], [-0.3, 0.25, 1.8]]] * 4)
    angles = torch.deg2rad(torch.empty(3, 4).uniform_(-10, 10))
    rotations, zooms = zoom.turns(*angles), torch.tensor([0.7, 1.0, 1.3, 1.8])
    images = _markers(joints[0]).expand(4, -1, -1, -1)
    warped, moved = zoom.see(images, rotations, zooms), zoom.joints_seen(joints, rotations, zooms)
    for sample in range(4):
        for channel in range(2):
            seen, expected = _centroid(warped[sample, channel]), _project(moved[sample, channel])
            assert (seen - expected).norm() < 0.2, (seen, expected)
            # The marker did move: a camera that stays must not pass.
            assert (seen - _project(joints[sample, channel])).norm() > 0.5
    assert torch.allclose(zoom.joints_of(moved, rotations, zooms), joints, atol=1e-6)
    assert not torch.allclose(zoom.joints_of(moved, rotations, zooms + 0.1), joints, atol=1e-2)


def test_the_camera_looks_at_the_robot_at_a_size_of_its_own():
    masks = torch.zeros(3, 1, INPUT_HEIGHT, INPUT_WIDTH)
    masks[0, :, 40:80, 115:195] = 1
    masks[1, :, 90:110, 30:50] = 1
    rotations, zooms = zoom.look_at(masks, zoom.ZOOM, OVERLAYS["ramp"])
    seen = zoom.see(masks, rotations, zooms)[:, 0]
    for picture in seen[:2]:
        x, y = _centroid(picture)
        # A turned camera does not see a surface's middle quite in the middle.
        assert (torch.stack([x - CAMERA["cx"], y - CAMERA["cy"]]).abs() < 6).all(), (x, y)
    assert zooms[1] == zoom.ZOOM["most"] and 1 < zooms[0] < zoom.ZOOM["most"]
    columns = seen[0].amax(0).nonzero()
    share = (columns.max() - columns.min() + 1) / INPUT_WIDTH
    # An even bar spans the square root of twelve of its deviations.
    assert abs(share - 12**0.5 / zoom.ZOOM["spread"]) < 0.06, share
    # Nothing to look at: the camera as it is.
    assert torch.equal(rotations[2], torch.eye(3)) and zooms[2] == 1


def test_what_is_half_shown_weighs_half():
    masks = torch.zeros(3, 1, INPUT_HEIGHT, INPUT_WIDTH)
    masks[:, :, 100, 50] = 1
    masks[:, 0, 100, 150] = torch.tensor([0.5, 0.55, 0.0])
    rays = zoom.look_at(masks, zoom.ZOOM, OVERLAYS["ramp"])[0][:, 2]
    columns = CAMERA["fx"] * rays[:, 0] / rays[:, 2] + CAMERA["cx"]
    assert torch.allclose(columns, torch.tensor([50 + 100 / 3, 50 + 300 / 7, 50]), atol=1e-2)
    assert not torch.allclose(columns[0], columns[1], atol=1)
    shown = overlay(torch.ones(3, 3, INPUT_HEIGHT, INPUT_WIDTH), masks, OVERLAYS["ramp"])[:, :, 100, 150]
    assert torch.allclose(shown[:, 0], torch.tensor([0.5, 0.75, 0.0]))


def test_varied_cameras_still_look_there():
    torch.manual_seed(0)
    rotations, zooms = zoom.vary(torch.eye(3).expand(50, 3, 3), torch.full((50,), 2.0))
    axes = rotations[:, :, 2]
    assert (axes[:, 2] > 0.99).all() and axes[:, 0].std() > 0.005
    assert torch.allclose(rotations @ rotations.mT, torch.eye(3), atol=1e-5)
    assert 1.6 < zooms.min() < 1.9 < 2.1 < zooms.max() < 2.4
