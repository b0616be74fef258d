"""Cuts views out of CC0 panoramas, as backgrounds for recordings: `panoramas.py PACKAGE OUT`.

PACKAGE is the unpacked npm package @pmndrs/assets (1.7.0). OUT/train and OUT/test get views of different places: test
recordings are to show places that no network was trained with. The same views are made each time.
"""

import base64
import math
import re
import sys
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

WIDTH, HEIGHT, FOCAL = 512, 424, 365.0
TEST = {"city", "hall", "lab"}
VIEWS = 12


def read(path):
    """A panorama [height, width, 3], linear light."""
    exr = path.parent / f"{path.stem}.decoded"
    exr.write_bytes(base64.b64decode(re.search(r"base64,([A-Za-z0-9+/=]+)", path.read_text()).group(1)))
    with OpenEXR.File(str(exr)) as file:
        pixels = file.channels()["RGB"].pixels.astype(np.float32)
    exr.unlink()
    return np.nan_to_num(pixels).clip(0, 1e4)


def view(panorama, yaw, pitch):
    """What the recorder's camera sees of it, sRGB; exposed so that few parts are white."""
    x = (np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL
    y = (np.arange(HEIGHT) - (HEIGHT - 1) / 2) / FOCAL
    x, y = np.meshgrid(x, y)
    y, z = math.cos(pitch) * y - math.sin(pitch), math.sin(pitch) * y + math.cos(pitch)
    height, width, _ = panorama.shape
    column = (np.arctan2(x, z) + yaw) / (2 * math.pi) * width - 0.5
    row = (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * height - 0.5
    left, above = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[..., None], (row - above)[..., None]

    def at(rows, columns):
        return panorama[np.clip(rows, 0, height - 1), columns % width]

    upper = (1 - across) * at(above, left) + across * at(above, left + 1)
    lower = (1 - across) * at(above + 1, left) + across * at(above + 1, left + 1)
    light = (1 - down) * upper + down * lower
    light = light / max(np.percentile(light, 97), 1e-4)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
    return (255 * curve.clip(0, 1) + 0.5).astype(np.uint8)


def main():
    package, out = map(Path, sys.argv[1:])
    for path in sorted((package / "hdri").glob("*.exr.js")):
        name = path.name.removesuffix(".exr.js")
        folder = out / ("test" if name in TEST else "train")
        folder.mkdir(parents=True, exist_ok=True)
        panorama, random = read(path), np.random.default_rng(list(name.encode()))
        for number in range(VIEWS):
            yaw, pitch = (number + random.uniform()) / VIEWS * 2 * math.pi, math.radians(random.uniform(-25, 15))
            Image.fromarray(view(panorama, yaw, pitch)).save(folder / f"{name}_{number:02}.png")


if __name__ == "__main__":
    main()
