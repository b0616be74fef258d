import torch

from whereabot_trainer import evaluate, zoom
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


def test_what_a_camera_sees_of_own_pixels_is_what_it_sees_of_halved_ones_but_sharper():
    torch.manual_seed(1)
    rotations, zooms = zoom.turns(*torch.deg2rad(torch.empty(3, 3).uniform_(-8, 8))), torch.tensor([1.0, 1.4, 2.0])
    smooth = torch.nn.functional.interpolate(torch.rand(3, 3, 8, 10), (2 * INPUT_HEIGHT, 2 * INPUT_WIDTH), mode="bicubic")
    halved = zoom.canonical(smooth)
    found, expected = zoom.rectify(smooth, rotations, zooms), zoom.see(halved, rotations, zooms)
    # Within a picture: at its border, a sample's pixels are half as wide.
    inside = zoom.see(torch.ones_like(halved), rotations, zooms) == 1
    inside &= zoom.rectify(torch.ones_like(smooth), rotations, zooms) > 1 - 1e-5
    assert inside.float().mean() > 0.7 and (found - expected)[inside].abs().max() < 0.02
    # Another turn, another zoom, and it is not.
    assert (zoom.rectify(smooth, rotations.mT, zooms) - expected)[inside].abs().max() > 0.2
    assert (zoom.rectify(smooth, rotations, zooms * 1.1) - expected)[inside].abs().max() > 0.1
    # The canonical camera's image is what halving makes.
    still = torch.eye(3).expand(3, 3, 3), torch.ones(3)
    pictures = torch.rand(3, 3, 2 * INPUT_HEIGHT, 2 * INPUT_WIDTH)
    assert torch.allclose(zoom.rectify(pictures, *still), zoom.canonical(pictures), atol=1e-3)
    # Zoomed in by two, each pixel is a picture's own.
    ahead = torch.eye(3).expand(3, 3, 3), torch.full((3,), 2.0)
    assert zoom.rectify(pictures, *ahead).std() > 1.3 * zoom.see(zoom.canonical(pictures), *ahead).std()


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


def test_what_is_half_shown_weighs_half(monkeypatch):
    monkeypatch.setattr(zoom, "STEPS", (8000, 64000))
    masks = torch.zeros(3, 1, INPUT_HEIGHT, INPUT_WIDTH)
    masks[:, :, 100, 50] = 1
    masks[:, 0, 100, 150] = torch.tensor([0.5, 0.55, 0.0])
    rays = zoom.look_at(masks, zoom.ZOOM, OVERLAYS["ramp"])[0][:, 2]
    columns = CAMERA["fx"] * rays[:, 0] / rays[:, 2] + CAMERA["cx"]
    assert torch.allclose(columns, torch.tensor([50 + 100 / 3, 50 + 300 / 7, 50]), atol=1e-2)
    assert not torch.allclose(columns[0], columns[1], atol=1)
    shown = overlay(torch.ones(3, 3, INPUT_HEIGHT, INPUT_WIDTH), masks, OVERLAYS["ramp"])[:, :, 100, 150]
    assert torch.allclose(shown[:, 0], torch.tensor([0.5, 0.75, 0.0]))


def test_roundings_and_noise_do_not_turn_the_camera():
    torch.manual_seed(2)
    masks = torch.zeros(40, 1, INPUT_HEIGHT, INPUT_WIDTH)
    for mask, x in zip(masks, torch.randint(10, 150, (40,)), strict=True):
        mask[:, 60:140, x : x + 50] = 0.9
    noisy = (masks + 0.02 * torch.randn_like(masks)).clamp(0, 1)

    def turned(masks):
        rotations, zooms = zoom.look_at(masks, zoom.ZOOM, OVERLAYS["ramp"])
        return torch.cat([rotations[:, 2], zooms[:, None]], 1)

    same = (turned(masks) == turned(noisy)).all(1)
    assert same.float().mean() > 0.85
    # Eight pixels to the side are two steps or more.
    assert (turned(masks) != turned(masks.roll(8, 3))).any(1).all()


def test_varied_cameras_still_look_there():
    torch.manual_seed(0)
    rotations, zooms = zoom.vary(torch.eye(3).expand(50, 3, 3), torch.full((50,), 2.0))
    axes = rotations[:, :, 2]
    assert (axes[:, 2] > 0.99).all() and axes[:, 0].std() > 0.005
    assert torch.allclose(rotations @ rotations.mT, torch.eye(3), atol=1e-5)
    assert 1.6 < zooms.min() < 1.9 < 2.1 < zooms.max() < 2.4


def test_a_closer_mask_is_merged_where_its_camera_sees_and_the_coarse_one_stays_elsewhere():
    rotations = zoom.turns(*torch.deg2rad(torch.tensor([[14.0, -5.0], [-9.0, 4.0], [0.0, 7.0]])))
    zooms = torch.tensor([2.0, 1.4])
    v, u = torch.meshgrid(torch.arange(INPUT_HEIGHT), torch.arange(INPUT_WIDTH), indexing="ij")
    # Linear in the pixel: a bilinear sample of it is exact.
    closer, coarse = ((2 * u + v) / 1000).expand(2, 1, -1, -1), torch.full((2, 1, INPUT_HEIGHT, INPUT_WIDTH), 0.25)
    merged = zoom.merge(coarse, closer, rotations, zooms)
    inside, border = 0, 0
    for number in range(2):
        for y in range(0, INPUT_HEIGHT, 3):
            for x in range(0, INPUT_WIDTH, 3):
                ray = torch.tensor([(x - CAMERA["cx"]) / CAMERA["fx"], (y - CAMERA["cy"]) / CAMERA["fy"], 1.0])
                seen = rotations[number] @ ray
                q = [float(seen[axis] / seen[2] * zooms[number] * CAMERA[f"f{name}"] + CAMERA[f"c{name}"])
                     for axis, name in enumerate("xy")]
                ends = [min(q[0], INPUT_WIDTH - 1 - q[0]), min(q[1], INPUT_HEIGHT - 1 - q[1])]
                found = float(merged[number, 0, y, x])
                if min(ends) > 0.01:
                    inside += 1
                    assert abs(found - (2 * q[0] + q[1]) / 1000) < 1e-4
                elif min(ends) <= -1:
                    assert found == 0.25
                else:
                    border += 1
    count = len(range(0, INPUT_HEIGHT, 3)) * len(range(0, INPUT_WIDTH, 3))
    # Neither is all of it, and few pixels are left unlooked at.
    assert 0.3 * 2 * count < inside < 0.8 * 2 * count and border < 0.05 * count
    # The coarse mask is what shows through, and no other turn will do.
    assert (zoom.merge(coarse + 0.5, closer, rotations, zooms) != merged).any()
    assert (zoom.merge(coarse, closer, rotations.mT, zooms) - merged).abs().max() > 0.1


def test_at_the_border_of_a_closer_mask_the_mask_does_not_jump():
    nothing, all_of_it = torch.zeros(1, 1, INPUT_HEIGHT, INPUT_WIDTH), torch.ones(1, 1, INPUT_HEIGHT, INPUT_WIDTH)
    pans = torch.deg2rad(torch.linspace(8, 8.5, 150))
    zeros = torch.zeros(1)
    masks = torch.cat([
        zoom.merge(nothing, all_of_it, zoom.turns(pan[None], zeros, zeros), torch.full((1,), 1.5)) for pan in pans])
    # The border passes some columns of pixels, by about two hundredths of its pixels a step.
    assert (masks[0] != masks[-1]).any() and masks.diff(dim=0).abs().max() < 0.05
    # A border that belonged to either mask would jump.
    assert (masks > 0.999).float().diff(dim=0).abs().max() == 1


class _Bright(torch.nn.Module):
    """As probable as it is red."""

    def forward(self, images):
        return images[:, :1].sigmoid() * 0.8


def test_of_what_is_alike_everywhere_the_closer_mask_is_the_same():
    torch.manual_seed(0)
    pictures = torch.rand(2, 3, 2 * INPUT_HEIGHT, 2 * INPUT_WIDTH)
    pictures[0] = 0.5
    pictures[1] -= 8
    pictures[1, :, 120:200, 60:180] += 8
    once, twice = (evaluate.masks_of(_Bright(), pictures, coarse) for coarse in (None, _Bright()))
    assert torch.allclose(once[0], twice[0], atol=1e-4)
    # Where there is something, it is looked at.
    assert not torch.allclose(once[1], twice[1], atol=0.1)
