"""Photographs: fitted into the networks' input, with hand-made masks, never trained on.

An annotation file is a JSON list of {"file", "width", "height", "polygons", "holes", "ignore_polygons"}, polygons as
lists of [x, y] in the photo's pixels. A photo's camera is unknown, so that only its mask is judged here.
"""

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from . import evaluate
from .networks import INPUT_HEIGHT, INPUT_WIDTH

SUFFIXES = {".jpg", ".jpeg", ".png"}


def _fit(picture, resample):
    """The picture scaled to fit, in the middle of a black input, and the share of the input that it fills."""
    scale = min(INPUT_WIDTH / picture.width, INPUT_HEIGHT / picture.height)
    width, height = round(picture.width * scale), round(picture.height * scale)
    fitted = Image.new(picture.mode, (INPUT_WIDTH, INPUT_HEIGHT))
    fitted.paste(picture.resize((width, height), resample), ((INPUT_WIDTH - width) // 2, (INPUT_HEIGHT - height) // 2))
    return np.asarray(fitted), width * height / (INPUT_WIDTH * INPUT_HEIGHT)


def read_photo(path):
    """(image [3, H, W] in [0, 1], share of the input that the photo fills)."""
    with Image.open(path) as file:
        pixels, share = _fit(file.convert("RGB"), Image.Resampling.LANCZOS)
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255, share


def _draw(annotation, fills):
    picture = Image.new("L", (annotation["width"], annotation["height"]))
    draw = ImageDraw.Draw(picture)
    for key, value in fills:
        for polygon in annotation.get(key, []):
            draw.polygon([tuple(point) for point in polygon], fill=value)
    return _fit(picture, Image.Resampling.BOX)[0] >= 128


def score_annotated(mask_network, photos, annotations, threshold=0.5):
    """IoU of the mask in each annotated photo, by file name."""
    scores = {}
    for annotation in json.loads(Path(annotations).read_text()):
        image, _ = read_photo(Path(photos) / annotation["file"])
        truth = _draw(annotation, (("polygons", 255), ("holes", 0)))
        judged = ~_draw(annotation, (("ignore_polygons", 255),))
        estimate = (evaluate.masks_of(mask_network, image[None])[0, 0] >= threshold).numpy()
        union = ((estimate | truth) & judged).sum()
        scores[annotation["file"]] = float((estimate & truth & judged).sum() / max(union, 1))
    return scores


def coverages(mask_network, folder, threshold=0.5):
    """The mask's coverage of each photo in a folder, by file name, as the engine counts it: over the whole input."""
    return {
        path.name: float((evaluate.masks_of(mask_network, read_photo(path)[0][None]) >= threshold).float().mean())
        for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in SUFFIXES
    }
