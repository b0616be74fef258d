"""A small recording drawn here: the joints of a UR5 as coloured discs joined by a line, on a noisy background."""

import json
import math

import numpy as np
import pytest
from PIL import Image, ImageDraw

from arms import BODY, arms
from whereabot_trainer.networks import JOINTS

COLOURS = [(220, 40, 40), (40, 200, 60), (60, 80, 230), (230, 210, 50), (210, 60, 210), (60, 210, 220)]


def draw_recording(folder, count, seed=0):
    rng = np.random.default_rng(seed)
    (folder / "image").mkdir(parents=True)
    (folder / "mask").mkdir()
    folder.joinpath("recording.json").write_text(json.dumps({
        "format": "whereabot-recording", "version": 1, "robot": "ur5", "joints": JOINTS, "width": 512, "height": 424,
        "frame": "camera_optical", "source": {"kind": "synthetic", "seed": seed, "protocol": "free_camera"}}))
    lines, joints = [], arms(BODY, count, seed).numpy()
    for number in range(count):
        picture = Image.fromarray(
            np.kron(rng.integers(60, 160, (53, 64, 3), np.uint8), np.ones((8, 8, 1), np.uint8)))
        mask = Image.new("L", picture.size)
        sample = {"id": number, "image": f"image/{number:06}.jpg", "mask": f"mask/{number:06}.png",
                  "intrinsics": {"fx": 365, "fy": 365, "cx": 255.5, "cy": 211.5}}
        if number % 10 != 9:
            points = joints[number]
            pixels = [(365 * x / z + 255.5, 365 * y / z + 211.5) for x, y, z in points]
            for canvas, fills in ((ImageDraw.Draw(picture), COLOURS), (ImageDraw.Draw(mask), [255] * 6)):
                canvas.line(pixels, fill=fills[0], width=24)
                for (u, v), (_, _, z), fill in zip(pixels, points, fills, strict=True):
                    radius = 365 * 0.06 / z
                    canvas.ellipse([u - radius, v - radius, u + radius, v + radius], fill=fill)
            sample |= {"joints_m": points.tolist(), "joints_px": pixels,
                       "joint_angles_rad": [0.0] * 6, "camera_from_base": np.eye(4).ravel().tolist()}
        sample["coverage"] = float((np.asarray(mask) > 0).mean())
        picture.save(folder / sample["image"], quality=92, subsampling=0)
        mask.save(folder / sample["mask"])
        lines.append(json.dumps(sample) + "\n")
    folder.joinpath("samples.jsonl").write_text("".join(lines))
    assert all(math.isfinite(json.loads(line)["coverage"]) for line in lines)


def _drawn(tmp_path_factory, count):
    folder = tmp_path_factory.mktemp("recordings") / "drawn"
    draw_recording(folder, count)
    return folder


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    return _drawn(tmp_path_factory, 40)


@pytest.fixture(scope="session")
def held_out(tmp_path_factory):
    """Of as many samples, to validate on."""
    return _drawn(tmp_path_factory, 40)


@pytest.fixture(scope="session")
def small_recording(tmp_path_factory):
    """For tests of which each picture costs a network's time often."""
    return _drawn(tmp_path_factory, 12)
