"""The joint network's camera: at the place of the canonical one, but turned towards the robot and zoomed in on it. Behind a coarse
network, the mask network looks through such a camera, too.

An arm is then seen in the middle of the picture and at about the same size, wherever it is in the image. The turn is a
rotation and the zoom a focal length, so that what is seen is exact for a pinhole; the network's depths are those of the
canonical focal length, `zoom` times nearer than the arm is.
"""

import torch

from .networks import CAMERA, share

# The picture's side spans so many standard deviations of the mask: nineteen arms in twenty are seen whole.
ZOOM = {"spread": 5.0, "least": 0.5, "most": 4.0}
# The mask network's: never out, in no farther than to the recordings' own pixels, and closer than all of an arm: beyond, the
# coarse mask is.
MASK_ZOOM = {"spread": 4.0, "least": 1.0, "most": 2.0}
# Of the zoom, in an octave; of the direction, in the width of what the camera sees.
STEPS = (8, 64)
# What it looks at: the coarse mask, each pixel as heavy as it is probable. A share of it that rose steeply would turn the camera
# by roundings.
LOOKED_AT = {"rule": "multiply"}


def look_at(masks, zoom, rule, camera=CAMERA):
    """(rotations [N, 3, 3], zooms [N]) of the cameras that see what the overlay's `rule` lets through of `masks`
    [N, 1, H, W]: from the canonical camera's frame to theirs, without a roll. Where it lets nothing through, the canonical
    camera itself. Zooms and directions go in steps: roundings and noise in a mask, which move its mean by hundredths of a pixel,
    moved joints by centimetres through cameras that followed them."""
    inside = share(masks[:, 0], rule)
    height, width = inside.shape[1:]
    total = inside.sum((1, 2))

    def mean_and_deviation(counts, extent):
        places = torch.arange(extent, device=masks.device)
        mean = (counts * places).sum(1) / total.clamp(min=1e-6)
        variance = (counts * (places - mean[:, None]) ** 2).sum(1) / total.clamp(min=1e-6)
        return mean, variance.sqrt()

    x, deviation_x = mean_and_deviation(inside.sum(1), width)
    y, deviation_y = mean_and_deviation(inside.sum(2), height)
    extent = zoom["spread"] * torch.maximum(deviation_x / width, deviation_y / height)
    zooms = (1 / extent.clamp(min=1e-6)).clamp(zoom["least"], zoom["most"])
    zooms = torch.exp2(torch.round(torch.log2(zooms) * STEPS[0]) / STEPS[0]).clamp(zoom["least"], zoom["most"])
    step = width / (STEPS[1] * zooms)
    x, y = (torch.round((place - camera[centre]) / step) * step for place, centre in ((x, "cx"), (y, "cy")))
    ray = torch.stack([x / camera["fx"], y / camera["fy"], torch.ones_like(x)], 1)
    a, b, c = torch.nn.functional.normalize(ray).unbind(1)
    rotations = torch.stack([
        1 - a * a / (1 + c), -a * b / (1 + c), -a,
        -a * b / (1 + c), 1 - b * b / (1 + c), -b,
        a, b, c], 1).reshape(-1, 3, 3)
    seen = total > 1e-6
    canonical = torch.eye(3, device=masks.device)
    return torch.where(seen[:, None, None], rotations, canonical), torch.where(seen, zooms, 1.0)


def vary(rotations, zooms):
    """Cameras near those: looking a little beside, rolled, zoomed a little more or less."""
    pan, tilt = (torch.deg2rad(torch.empty(len(zooms)).uniform_(-3, 3)) / zooms for _ in range(2))
    roll = torch.deg2rad(torch.empty(len(zooms)).uniform_(-15, 15))
    return turns(pan, tilt, roll) @ rotations, zooms * torch.exp(torch.empty(len(zooms)).uniform_(-0.15, 0.15))


def turns(pan, tilt, roll):
    """Rotations [N, 3, 3] by these angles, each [N], in radians: about the camera's y, then its x, then its z."""
    def about(first, second, angle):
        rotation = torch.eye(3, device=angle.device).repeat(len(angle), 1, 1)
        rotation[:, first, first] = rotation[:, second, second] = torch.cos(angle)
        rotation[:, first, second], rotation[:, second, first] = -torch.sin(angle), torch.sin(angle)
        return rotation

    return about(0, 1, roll) @ about(1, 2, tilt) @ about(2, 0, pan)


def canonical(pictures):
    """The canonical camera's images [N, C, H, W] of recordings' own pixels [N, C, 2 H, 2 W]."""
    return torch.nn.functional.avg_pool2d(pictures, 2)


def rectify(pictures, rotations, zooms, camera=CAMERA):
    """What the cameras see [N, C, H, W] of recordings' own pixels [N, C, 2 H, 2 W]: as the engine's `rectify`, the mean of 2 x 2
    samples of a pixel's footprint, which is taken to be a parallelogram."""
    height, width = (extent // 2 for extent in pictures.shape[2:])
    k, ray = _pinhole((height, width), camera, pictures.device)

    def places(x, y):
        beside = ray + torch.tensor([x / camera["fx"], y / camera["fy"]], device=ray.device)
        beside = torch.cat([beside / zooms[:, None, None], torch.ones(len(zooms), height * width, 1, device=ray.device)], 2)
        return _places(beside @ (k @ rotations.mT).mT)

    middle = places(0, 0)
    across, along = places(0.5, 0) - places(-0.5, 0), places(0, 0.5) - places(0, -0.5)
    return sum(_sample(pictures, middle + x * across + y * along, (height, width)) for x in (-0.25, 0.25) for y in (-0.25, 0.25)) / 4


def see(images, rotations, zooms, camera=CAMERA):
    """What the cameras see of `images` [N, C, H, W] of the canonical camera: bilinear, zero beyond them."""
    k, ray = _pinhole(images.shape[2:], camera, images.device)
    ray = torch.cat([ray / zooms[:, None, None], torch.ones(len(images), ray.shape[1], 1, device=images.device)], 2)
    return _sample(images, _places(ray @ (k @ rotations.mT).mT), images.shape[2:])


def merge(coarse, closer, rotations, zooms, camera=CAMERA):
    """The canonical camera's masks [N, 1, H, W]: `closer`, which those cameras see, and beyond their view `coarse`. At a view's
    border, where a bilinear sample is partly beyond, they share."""
    k, ray = _pinhole(coarse.shape[2:], camera, coarse.device)
    turned = torch.cat([ray, torch.ones_like(ray[..., :1])], 2) @ rotations.mT
    seen = torch.cat([turned[..., :2] * zooms[:, None, None], turned[..., 2:]], 2)
    both = torch.cat([closer, torch.ones_like(closer)], 1)
    closer, within = _sample(both, _places(seen @ k.mT), coarse.shape[2:]).split(1, 1)
    return closer + (1 - within) * coarse


def _pinhole(size, camera, device):
    """(the camera's matrix, x / z and y / z of the rays [1, H W, 2] of the pixels of a `size` of (H, W))."""
    k = torch.tensor([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]], device=device)
    v, u = torch.meshgrid(*(torch.arange(float(extent), device=device) for extent in size), indexing="ij")
    return k, torch.stack([(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"]], -1).reshape(1, -1, 2)


def _places(source):
    """Pixels [N, H W, 2] of homogeneous coordinates [N, H W, 3]."""
    # Behind the camera it sees nothing; a pixel far away is none either.
    ahead = source[..., 2:] > 1e-3
    return torch.where(ahead, source[..., :2] / source[..., 2:].clamp(min=1e-3), -1e4)


def _sample(images, places, size):
    """`images` [N, C, ...], of that `size` (H, W) or of more pixels that show the same, at as many of its `places` [N, H W, 2]."""
    height, width = size
    # Pixel centres are whole numbers here; grid_sample's -1 and 1 are the image's outer edges.
    grid = (2 * places + 1) / torch.tensor([width, height], device=images.device) - 1
    return torch.nn.functional.grid_sample(images, grid.reshape(len(images), height, width, 2), align_corners=False)


def joints_seen(joints, rotations, zooms):
    """Where the network is to see `joints` [N, 6, 3] of the canonical camera's frame: turned, and as much nearer as the
    zoom makes it look."""
    turned = joints @ rotations.mT
    return torch.cat([turned[..., :2], turned[..., 2:] / zooms[:, None, None]], 2)


def joints_of(seen, rotations, zooms):
    """The joints in the canonical camera's frame that are `seen` there: the inverse of `joints_seen`."""
    return torch.cat([seen[..., :2], seen[..., 2:] * zooms[:, None, None]], 2) @ rotations
