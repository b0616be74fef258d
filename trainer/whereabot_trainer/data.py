"""Recordings as training samples: reading, caching, halving, splitting and augmentation."""

import hashlib
import json
import math
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from filelock import FileLock
from PIL import Image, ImageOps
from tqdm import tqdm

from . import zoom
from .networks import CAMERA, INPUT_HEIGHT, INPUT_WIDTH, JOINTS, run

FORMAT, VERSION = "whereabot-recording", 1


class RecordingError(Exception):
    """A recording that cannot be read; the message names the file and the line."""


# --- reading ---------------------------------------------------------------------------------------------------------

def read_header(folder):
    """recording.json, checked against what the networks are trained for."""
    path = Path(folder) / "recording.json"
    try:
        header = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}") from error
    if not isinstance(header, dict):
        raise RecordingError(f"{path}: expected an object, found {header!r}")
    for key, expected in (("format", FORMAT), ("version", VERSION), ("joints", JOINTS),
                          ("width", 2 * INPUT_WIDTH), ("height", 2 * INPUT_HEIGHT), ("frame", "camera_optical")):
        if header.get(key) != expected:
            raise RecordingError(f"{path}: {key}: expected {expected!r}, found {header.get(key)!r}")
    for key, kind, expected in (("robot", str, "a name"), ("source", dict, "an object")):
        if not header.get(key) or not isinstance(header[key], kind):
            raise RecordingError(f"{path}: {key}: expected {expected}, found {header.get(key)!r}")
    return header


def _inside(path):
    path = PurePosixPath(path)
    return path.parts and not path.is_absolute() and ".." not in path.parts


def _is_number(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _check_sample(sample, number):
    if not isinstance(sample, dict):
        raise ValueError(f"expected an object, found {sample!r}")
    # The id tells what is kept for testing.
    found = sample.get("id")
    if type(found) is not int or found != number - 1:
        raise ValueError(f"id: expected {number - 1}, found {found!r}")
    for key in ("image", "mask"):
        found = sample.get(key)
        if not isinstance(found, str) or not _inside(found):
            raise ValueError(f"{key}: expected a path inside the recording's folder, found {found!r}")
    intrinsics = sample.get("intrinsics")
    if not isinstance(intrinsics, dict) or not all(_is_number(intrinsics.get(key)) for key in CAMERA):
        raise ValueError(f"intrinsics: expected the numbers {', '.join(CAMERA)}, found {intrinsics!r}")
    for key, value in CAMERA.items():
        # Pixel (0, 0) is a pixel's centre: halving the image halves cx + 0.5.
        found = intrinsics[key]
        halved = found / 2 if key.startswith("f") else (found + 0.5) / 2 - 0.5
        # Written so that NaN is refused.
        if not abs(halved - value) <= 1e-3:
            raise ValueError(f"intrinsics: {key}: expected {value} at half size, found {halved}")
    joints = sample.get("joints_m")
    if joints is not None and not (np.shape(joints) == (len(JOINTS), 3) and np.isfinite(joints).all()
                                   and (np.asarray(joints)[:, 2] > 0).all()):
        raise ValueError(f"joints_m: expected {len(JOINTS)} finite points before the camera (z > 0), found {joints!r}")


def read_samples(folder):
    """The samples of samples.jsonl. A last line without its end (the recording is still being written) is left out."""
    path = Path(folder) / "samples.jsonl"
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise RecordingError(f"{path}: {error}") from error
    if lines[-1]:
        warnings.warn(f"{path}: line {len(lines)} is unfinished and left out", stacklevel=2)
    samples = []
    for number, line in enumerate(lines[:-1], start=1):
        try:
            sample = json.loads(line)
            _check_sample(sample, number)
        except (ValueError, TypeError) as error:
            raise RecordingError(f"{path}: line {number}: {error}") from error
        samples.append(sample)
    return samples


def halve(pixels):
    """The mean of every 2x2 block of uint8 [N, H, W, ...], in the same type."""
    rows = pixels[:, ::2].short() + pixels[:, 1::2]
    return ((rows[:, :, ::2] + rows[:, :, 1::2] + 2) // 4).byte()


def truth_of(masks):
    """The canonical camera's masks f32 [N, 1, H, W] of 0 and 1, of a recording's own, uint8 [N, 2 H, 2 W]: at least half of the block."""
    return (halve(masks) >= 128)[:, None].float()


def _decode(folder, number, sample):
    try:
        with Image.open(folder / sample["image"]) as file:
            image = np.asarray(file.convert("RGB"))
        with Image.open(folder / sample["mask"]) as file:
            mask = np.asarray(file.convert("L"))
        for key, shape in (("image", image.shape[:2]), ("mask", mask.shape)):
            if shape != (2 * INPUT_HEIGHT, 2 * INPUT_WIDTH):
                raise ValueError(
                    f"{key}: expected {2 * INPUT_WIDTH}x{2 * INPUT_HEIGHT} pixels, found {shape[1]}x{shape[0]}")
    except (OSError, ValueError) as error:
        raise RecordingError(f"{folder / 'samples.jsonl'}: line {number}: {error}") from error
    return image, mask


def _cached_pixels(folder, samples, cache):
    """(images [N, 424, 512, 3], masks [N, 424, 512]) as memory maps; only new samples are decoded."""
    folder, cache = Path(folder).resolve(), Path(cache)
    cache.mkdir(parents=True, exist_ok=True)
    stem = f"{folder.name}-{hashlib.sha256(str(folder).encode()).hexdigest()[:8]}"
    # Two trainings may start at once.
    with FileLock(cache / f"{stem}.lock"):
        return _locked_pixels(folder, samples, cache, stem)


def _version(path):
    """What changes with a file's contents; [] where there is none."""
    try:
        known = path.stat()
    except OSError:
        return []
    return [known.st_size, known.st_mtime_ns]


def _locked_pixels(folder, samples, cache, stem):
    index = cache / f"{stem}.json"
    size = (2 * INPUT_HEIGHT, 2 * INPUT_WIDTH)
    shapes = {"images": (*size, 3), "masks": size}
    files = [[_version(folder / sample[key]) for key in ("image", "mask")] for sample in samples]

    def digest(count):
        return hashlib.sha256(json.dumps([samples[:count], files[:count], shapes]).encode()).hexdigest()

    done = 0
    try:
        known = json.loads(index.read_text())
        if known["count"] <= len(samples) and known["digest"] == digest(known["count"]):
            done = known["count"]
    except (OSError, ValueError, KeyError, TypeError):
        # All can be decoded again.
        pass
    paths = {key: cache / f"{stem}.{key}.u8" for key in shapes}
    if done < len(samples):
        if not done:
            # Somebody may train on what was there: it stays theirs.
            for path in (index, *paths.values()):
                path.unlink(missing_ok=True)
        with open(paths["images"], "ab") as images, open(paths["masks"], "ab") as masks, ThreadPoolExecutor() as pool:
            images.truncate(done * math.prod(shapes["images"]))
            masks.truncate(done * math.prod(shapes["masks"]))
            jobs = pool.map(lambda n: _decode(folder, n + 1, samples[n]), range(done, len(samples)))
            for image, mask in tqdm(jobs, f"decoding {folder.name}", len(samples) - done, mininterval=5):
                images.write(image.tobytes())
                masks.write(mask.tobytes())
        partial = index.with_suffix(".partial")
        partial.write_text(json.dumps({"count": len(samples), "digest": digest(len(samples))}))
        partial.replace(index)
    return tuple(np.memmap(paths[key], np.uint8, "r", shape=(len(samples), *shape)) for key, shape in shapes.items())


class Samples:
    """Samples of one or more recordings, by number.

    `joints` is [N, 6, 3] in metres in the camera's optical frame, NaN where there is no robot; `coverage` [N] is the
    share of robot pixels; `ids` [N] are the samples' ids in their recordings; `robots` [N] are the robots' names.
    `arms` [N] is the length of the robot's arm in metres: all recordings of a robot have the same. It is in `arm_lengths` by
    the robot's name, as it is given or else measured (see `arm_length`).
    """

    def __init__(self, folders, cache, arm_lengths=None):
        self.parts, joints, coverage, ids, robots, self.sources = [], [], [], [], [], []
        for folder in folders:
            header, samples = read_header(folder), read_samples(folder)
            if not samples:
                raise RecordingError(f"{folder}: no samples")
            images, masks = _cached_pixels(folder, samples, cache)
            self.parts.append((images, masks))
            absent = np.full((len(JOINTS), 3), np.nan)
            joints += [sample.get("joints_m", absent) for sample in samples]
            # One at a time: a memory map's mean is of a copy of all.
            coverage.append([(mask >= 128).mean() for mask in masks])
            ids += [sample["id"] for sample in samples]
            robots += [header["robot"]] * len(samples)
            self.sources.append({"name": Path(folder).name, "robot": header["robot"], "samples": len(samples),
                                 **header["source"]})
        self.joints = np.asarray(joints, np.float32)
        self.coverage = np.concatenate(coverage)
        self.ids = np.asarray(ids)
        self.robots = np.asarray(robots)
        measured = {robot: arm_length(self.joints[self.robots == robot]) for robot in sorted(set(robots))}
        self.arm_lengths = measured | (arm_lengths or {})
        self.arms = np.asarray([self.arm_lengths[robot] for robot in robots], np.float32)
        self._starts = np.cumsum([0] + [len(images) for images, _ in self.parts])
        self._kept = None

    def __len__(self):
        return len(self.joints)

    @property
    def has_robot(self):
        return ~np.isnan(self.joints[:, 0, 0])

    def pixels(self, numbers):
        """(images [N, 3, H, W] in [0, 1], masks [N, 1, H, W] of 0 and 1) of the canonical camera, as f32 tensors."""
        pictures, masks = self.pictures(numbers)
        return zoom.canonical(pictures), masks

    def pictures(self, numbers):
        """(recordings' own pixels [N, 3, 2 H, 2 W] in [0, 1], the canonical camera's masks [N, 1, H, W] of 0 and 1) as f32 tensors."""
        images, masks = self.bytes(numbers)
        return images.permute(0, 3, 1, 2).float() / 255, truth_of(masks)

    def keep(self, device):
        """Holds all pixels in a GPU's memory from now on (868 KB a sample): on their way there, training would wait."""
        self._kept = [torch.cat([torch.from_numpy(np.array(part[kind])).to(device) for part in self.parts]) for kind in (0, 1)]

    def bytes(self, numbers):
        """(images [N, 2 H, 2 W, 3], masks [N, 2 H, 2 W]) as they were recorded, uint8, where they are kept."""
        if self._kept is not None:
            images, masks = self._kept
            rows = torch.from_numpy(np.asarray(numbers)).to(images.device)
            return images[rows], masks[rows]
        found = []
        for number in numbers:
            part = np.searchsorted(self._starts, number, "right") - 1
            found.append([pixels[number - self._starts[part]] for pixels in self.parts[part]])
        images, masks = (torch.from_numpy(np.stack(pixels)) for pixels in zip(*found, strict=True))
        return images, masks


def read_negatives(folders, cache):
    """Photographs without a robot as uint8 [N, 424, 512, 3], cut to fill a recording's picture; decoded once."""
    paths = sorted(path for folder in folders for path in Path(folder).resolve().iterdir()
                   if path.suffix.lower() in {".jpg", ".jpeg", ".png", ".webp"})
    if not paths:
        raise RecordingError(f"no photographs in {', '.join(map(str, folders))}")
    size = (2 * INPUT_WIDTH, 2 * INPUT_HEIGHT)
    files = json.dumps([size, [[str(path), _version(path)] for path in paths]])
    stored = Path(cache) / f"photographs-{hashlib.sha256(files.encode()).hexdigest()[:8]}.npy"
    stored.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(stored.with_suffix(".lock")):
        if not stored.exists():
            pictures = []
            for path in tqdm(paths, "decoding photographs", mininterval=5):
                try:
                    with Image.open(path) as file:
                        pictures.append(np.asarray(ImageOps.fit(file.convert("RGB"), size)))
                except (OSError, ValueError) as error:
                    raise RecordingError(f"{path}: expected a photograph: {error}") from error
            partial = stored.with_suffix(".partial")
            with open(partial, "wb") as file:
                np.save(file, np.stack(pictures))
            partial.replace(stored)
    return np.load(stored, mmap_mode="r")


def arm_length(joints):
    """Shoulder to elbow to wrist, metres: the median over samples [N, 6, 3]; 1 where no sample has a robot.

    Robots of one make are nearly the same but for their size; in this unit, they are nearly the same.
    """
    shoulder, elbow, wrist = (joints[:, JOINTS.index(name)] for name in ("shoulder_lift", "elbow", "wrist_1"))
    lengths = np.linalg.norm(elbow - shoulder, axis=1) + np.linalg.norm(wrist - elbow, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else 1.0


def is_test(ids):
    """Which samples of a recording are kept for testing: one in five, told by splitmix64 of the sample's id, as
    everything that reads recordings does it (paper, section 2: 80 % and 20 % at random)."""
    z = (np.asarray(ids, np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))) % np.uint64(5) == 0


def refuse_common(recordings, validation):
    """What is validated on is not trained on."""
    common = {Path(folder).resolve() for folder in recordings} & {Path(folder).resolve() for folder in validation or []}
    if common:
        raise RecordingError(f"{min(common)}: expected recordings of their own to validate on, found one that is trained on")


def split(samples):
    """(training, test) numbers."""
    test = is_test(samples.ids)
    return np.flatnonzero(~test), np.flatnonzero(test)


# --- augmentation ----------------------------------------------------------------------------------------------------

def _uniform(count, low, high, *shape):
    return torch.empty(count, *shape).uniform_(low, high)


# Share of the samples whose colours, and whose view or mask, vary beyond what the recordings vary already.
VARIED = 0.35
# Of what a coarse network learns from: it has to find the robot in any picture, and need not be exact.
COARSE_VARIED = 0.6
# The share of the robots with other light in what a mask network's camera sees, as the shipped networks were trained on it.
CLOSER_RELIT = 0.1


def jitter_masks(masks):
    """Another estimate of the same: probabilities moved, as a whole and each by itself, where they are not sure.

    A joint network that never sees other borders leans on single pixels: one more or less moved joints by millimetres.
    From f32 [N, 1, H, W] in [0, 1] to the same.
    """
    logits = torch.logit(masks, eps=1 / 255)
    return torch.sigmoid(logits + torch.randn(len(masks), 1, 1, 1) + 0.5 * torch.randn_like(masks))


def jitter_colours(images):
    """Other light and another camera: gain, white balance, gamma, saturation, contrast, blur and noise.

    From uint8 [N, H, W, 3] to f32 [N, 3, H, W] in [0, 1], in memory as before: the format that convolutions like best.
    """
    # On a CPU, one image at a time stays in the cache through all of these passes.
    parts = images.split(1 if images.device.type == "cpu" else len(images))
    return torch.cat([_jitter_colours(part) for part in parts]).permute(0, 3, 1, 2)


def relight_robots(images, masks):
    """Other light on the robot than on what is behind it: against the sky, a window or a lamp, an arm is darker in a photograph than
    where a renderer lights both.

    From f32 [N, 3, H, W] and [N, 1, H, W], both in [0, 1], to images of the same shape.
    """
    gain = torch.exp(_uniform(len(images), math.log(0.3), math.log(1.3), 1, 1, 1))
    return (images * (1 + masks * (gain - 1))).clamp_(max=1)


def relight_some_robots(images, masks, share=VARIED):
    """The same of a share of the images, in place."""
    relit = torch.rand(len(images)) < share
    if relit.any():
        images[relit] = relight_robots(images[relit], masks[relit])
    return images


def jitter_some_colours(images, share=VARIED):
    """The same of a share of the images; the others as they are."""
    plain = images.permute(0, 3, 1, 2).float() / 255
    some = torch.rand(len(images)) < share
    if some.any():
        plain[some] = jitter_colours(images[some])
    return plain


def _jitter_colours(images):
    count, height, width, _ = images.shape
    images = images.reshape(count, -1, 3) * (
        _uniform(count, 0.75 / 255, 1.25 / 255, 1, 1) * _uniform(count, 0.93, 1.07, 1, 3))
    images = images.clamp_(1e-3, 1).pow_(torch.exp(_uniform(count, -0.25, 0.25, 1, 1)))
    contrast, saturation = _uniform(count, 0.8, 1.2, 1, 1), _uniform(count, 0.6, 1.4, 1, 1)
    mixing = contrast * (saturation * torch.eye(3) + (1 - saturation) / 3)
    images = torch.baddbmm((1 - contrast) * images[:, ::7].mean((1, 2), keepdim=True), images, mixing)
    blurred = torch.rand(count) < 0.25
    if blurred.any():
        planes = images[blurred].reshape(-1, height, width, 3).permute(0, 3, 1, 2)
        soft = torch.nn.functional.avg_pool2d(planes, 3, 1, 1, count_include_pad=False)
        # Between sharpened (-0.5) and blurred (1).
        planes = torch.lerp(planes, soft, _uniform(len(planes), -0.5, 1, 1, 1, 1))
        images[blurred] = planes.permute(0, 2, 3, 1).reshape(len(planes), -1, 3)
    noisy = torch.rand(count) < 0.5
    if noisy.any():
        noise = torch.empty_like(images[noisy]).uniform_(-1, 1)
        images[noisy] += noise * _uniform(len(noise), 0, 0.08, 1, 1)
    return images.clamp_(0, 1).reshape(count, height, width, 3)


def random_views(images, masks, height, width, tilt_degrees=10, zoom=(0.7, 1.6)):
    """Random views of height x width: zoomed, tilted, and mirrored half of the time. For the mask network alone: an arm
    is not its mirror image, and a zoom changes the camera. Beyond the image it is reflected, or at times black, as
    beside a portrait photo."""
    count, _, full_height, full_width = images.shape
    step = 1 / torch.exp(_uniform(count, math.log(zoom[0]), math.log(zoom[1])))
    angle = torch.deg2rad(_uniform(count, -tilt_degrees, tilt_degrees))
    mirror = torch.where(torch.rand(count) < 0.5, -1.0, 1.0)
    cos, sin = torch.cos(angle) * step, torch.sin(angle) * step
    shift_x = (full_width - width * step).abs() / full_width * _uniform(count, -1, 1)
    shift_y = (full_height - height * step).abs() / full_height * _uniform(count, -1, 1)
    # grid_sample's coordinates run from -1 to 1 over the source's width and height.
    theta = torch.stack([
        torch.stack([mirror * cos * width / full_width, -sin * height / full_width, shift_x], 1),
        torch.stack([mirror * sin * width / full_height, cos * height / full_height, shift_y], 1),
    ], 1)
    grid = torch.nn.functional.affine_grid(theta, [count, 1, height, width], align_corners=False)
    both = torch.cat([images, masks], 1)
    # Sampled further apart than this, single pixels would alias.
    shrunk = step > 1.5
    both[shrunk] = torch.nn.functional.avg_pool2d(both[shrunk], 3, 1, 1, count_include_pad=False)
    padding = "zeros" if torch.rand(()) < 0.1 else "reflection"
    both = torch.nn.functional.grid_sample(both, grid, padding_mode=padding, align_corners=False)
    return both[:, :3], (both[:, 3:] >= 0.5).float()


def mixed_views(images, masks, height, width, zoom, share=VARIED):
    """What a free camera's mask network learns from: parts of height x width of the pictures, uint8 [N, H, W, 3], as they are, mirrored
    half of the time; of a share the colours vary, of one the light on the robot, of one the view. Of all, that would be another task than the one it is judged
    by: the pictures have lights, cameras and sizes of their own."""
    plain = relight_some_robots(jitter_some_colours(images, share), masks, share)
    moved = torch.rand(len(images)) < share
    parts, truth = random_crops(plain, masks, height, width)
    mirrored = torch.rand(len(images)) < 0.5
    parts[mirrored], truth[mirrored] = parts[mirrored].flip(3), truth[mirrored].flip(3)
    if moved.any():
        parts[moved], truth[moved] = random_views(plain[moved], masks[moved], height, width, zoom=zoom)
    return parts, truth


def closer_views(images, masks, coarse, bf16, share=VARIED):
    """What a mask network behind a `coarse` one learns from: what its camera sees of the pictures, uint8 [N, 2 H, 2 W, 3] with their
    masks [N, 2 H, 2 W], from their own pixels. Mirrored half of the time; of a share the colours vary, of one the camera, of a smaller one
    the light on the robot."""
    masks = masks[:, None].float() / 255
    pictures = relight_some_robots(jitter_some_colours(images, share), masks, min(share, CLOSER_RELIT))
    with torch.no_grad():
        cameras = zoom.look_at(run(coarse, zoom.canonical(pictures), bf16), zoom.MASK_ZOOM, zoom.LOOKED_AT)
    varied = (torch.rand(len(images)) < share)[:, None, None]
    others = zoom.vary(*cameras)
    cameras = torch.where(varied, others[0], cameras[0]), torch.where(varied[:, 0, 0], others[1], cameras[1])
    seen = zoom.rectify(torch.cat([pictures, masks], 1), *cameras)
    mirrored = torch.rand(len(images)) < 0.5
    seen[mirrored] = seen[mirrored].flip(3)
    return seen[:, :3], (seen[:, 3:] >= 0.5).float()


def random_crops(images, masks, height, width):
    """Random parts of height x width, at the size they have: what a camera that stands still will see again."""
    parts = []
    for picture in torch.cat([images, masks], 1):
        y = int(torch.randint(0, picture.shape[1] - height + 1, (), device="cpu"))
        x = int(torch.randint(0, picture.shape[2] - width + 1, (), device="cpu"))
        parts.append(picture[:, y : y + height, x : x + width])
    both = torch.stack(parts)
    return both[:, :3], both[:, 3:]


def erase_rectangles(overlays, chance=0.5):
    """Zeroes one random rectangle in some of the overlays: what an occluder leaves of the mask."""
    count, _, height, width = overlays.shape

    def stripes(extent):
        length = torch.randint(8, 64, (count, 1))
        first = (torch.rand(count, 1) * (extent - length)).long()
        places = torch.arange(extent)
        return (places >= first) & (places < first + length)

    hidden = stripes(height)[:, None, :, None] & stripes(width)[:, None, None, :]
    hidden &= (torch.rand(count) < chance)[:, None, None, None]
    return overlays * ~hidden
