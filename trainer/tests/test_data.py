import json
import math
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from whereabot_trainer import data, zoom
from whereabot_trainer.networks import INPUT_HEIGHT, INPUT_WIDTH


CAMERA = {"fx": 365, "fy": 365, "cx": 255.5, "cy": 211.5}


def test_halve_is_the_mean_of_each_block():
    pixels = torch.tensor([[[0, 1, 10, 10], [2, 4, 10, 14]]], dtype=torch.uint8)
    assert data.halve(pixels).tolist() == [[[2, 11]]]
    assert data.halve(torch.full((2, 4, 6, 3), 255, dtype=torch.uint8)).tolist() == [[[[255] * 3] * 3] * 2] * 2
    # A mask's pixel is robot where at least half of the block is.
    masks = torch.tensor([[[255, 254, 255, 0], [0, 0, 255, 0]]], dtype=torch.uint8)
    assert data.truth_of(masks).tolist() == [[[[0, 1]]]]


def test_reads_a_recording_and_its_growth(recording, tmp_path):
    folder = tmp_path / "growing"
    shutil.copytree(recording, folder)
    lines = (recording / "samples.jsonl").read_text().splitlines(keepends=True)
    (folder / "samples.jsonl").write_text("".join(lines[:7]) + lines[7][:30])
    with pytest.warns(UserWarning, match="line 8 is unfinished"):
        first = data.Samples([folder], tmp_path / "cache")
    assert len(first) == 7
    (folder / "samples.jsonl").write_text("".join(lines))
    grown = data.Samples([folder], tmp_path / "cache")
    whole = data.Samples([recording], tmp_path / "other")
    numbers = np.arange(len(lines))
    for left, right in zip(grown.pixels(numbers), whole.pixels(numbers), strict=True):
        assert torch.equal(left, right)
    assert whole.has_robot.sum() == 36 and whole.coverage[9] == 0
    # What was on the validation side before stays there.
    assert set(data.split(first)[1]) == {n for n in data.split(grown)[1] if n < 7}


def test_another_picture_under_the_same_name_is_read(recording, tmp_path):
    folder = tmp_path / "redrawn"
    shutil.copytree(recording, folder)
    cache = tmp_path / "cache"
    before = data.Samples([folder], cache).pixels([4, 5])[0]
    picture = folder / "image" / "000004.jpg"
    Image.new("RGB", (512, 424), (9, 9, 9)).save(picture)
    after = data.Samples([folder], cache).pixels([4, 5])[0]
    assert torch.equal(after[1], before[1])
    assert (after[0] * 255).round().eq(9).all() and not torch.equal(after[0], before[0])


@pytest.mark.parametrize("index", [b"", b'{"count": 4', b"7", b'{"count": 40}', b'{"count": "x", "digest": 1}', b"\xff"])
def test_an_unreadable_index_is_none(recording, tmp_path, monkeypatch, index):
    cache = tmp_path / "cache"
    before = data.Samples([recording], cache).pixels([4, 5])[0]
    decode, decoded = data._decode, []

    def count(folder, number, sample):
        decoded.append(number)
        return decode(folder, number, sample)

    monkeypatch.setattr(data, "_decode", count)
    data.Samples([recording], cache)
    assert not decoded
    path, = cache.glob("*.json")
    path.write_bytes(index)
    assert torch.equal(data.Samples([recording], cache).pixels([4, 5])[0], before)
    assert sorted(decoded) == list(range(1, 41))


def test_who_reads_the_cache_keeps_what_was_in_it(recording, tmp_path):
    folder = tmp_path / "redrawn"
    shutil.copytree(recording, folder)
    trained_on = data.Samples([folder], tmp_path / "cache")
    before = trained_on.pixels([4])[0]
    Image.new("RGB", (512, 424), (9, 9, 9)).save(folder / "image" / "000000.jpg")
    again = data.Samples([folder], tmp_path / "cache")
    assert torch.equal(trained_on.pixels([4])[0], before) and torch.equal(again.pixels([4])[0], before)
    assert not torch.equal(trained_on.pixels([0])[0], again.pixels([0])[0])


def test_only_the_robot_is_relit():
    torch.manual_seed(4)
    masks = torch.zeros(200, 1, 8, 8)
    masks[:, :, 2:5] = 1
    images = torch.full((200, 3, 8, 8), 0.5)
    relit = data.relight_robots(images, masks)
    behind = (1 - masks).bool().expand_as(images)
    assert torch.equal(relit[behind], images[behind])
    gain = relit[:, 0, 3, 3] / 0.5
    assert 0.29 < gain.min() < 0.4 and 1.15 < gain.max() < 1.31


def test_a_mask_s_parts_are_those_of_its_picture():
    torch.manual_seed(5)
    # Where the mask is, the picture is bright, whatever becomes of its colours.
    masks = torch.zeros(40, 1, 60, 80)
    for mask, x in zip(masks, range(5, 45), strict=True):
        mask[:, 20:40, x : x + 20] = 1
    images = (masks.permute(0, 2, 3, 1) * 150 + 50).byte().expand(-1, -1, -1, 3).contiguous()
    parts, truth = data.mixed_views(images, masks, 48, 64, (0.8, 1.25))
    assert parts.shape == (40, 3, 48, 64) and truth.shape == (40, 1, 48, 64)

    def agreeing(truth):
        shown = parts.mean(1, keepdim=True)
        middle = shown.amin((1, 2, 3), keepdim=True) / 2 + shown.amax((1, 2, 3), keepdim=True) / 2
        return ((shown > middle) == (truth > 0.5)).float().mean()

    assert agreeing(truth) > 0.95 > agreeing(truth.flip(3))
    plain = (parts * 255).round()
    as_they_are = ((plain == 50) | (plain == 200)).all((1, 2, 3)).float().mean()
    # Two in three keep their colours, and of these two in three their view.
    assert 0.2 < as_they_are < 0.7


def test_one_sample_in_five_is_for_testing():
    assert np.flatnonzero(data.is_test(np.arange(40))).tolist() == [0, 1, 5, 7, 9, 16, 23, 26, 31, 35]
    assert 0.19 < data.is_test(np.arange(10000)).mean() < 0.21


def test_an_arm_is_measured_from_the_shoulder_to_the_wrist():
    joints = np.zeros((3, 6, 3))
    joints[:, 2, 0], joints[:, 3:, 0] = 0.5, 0.9
    joints[2] = np.nan
    assert data.arm_length(joints) == pytest.approx(0.9)


@pytest.mark.parametrize(("line", "complaint"), [
    ("{\n", "line 3: "),
    ("[]\n", r"line 3: expected an object, found \[\]"),
    ("7\n", "line 3: expected an object, found 7"),
    ('{"mask": "m"}\n', "line 3: id: expected 2, found None"),
    ('{"id": 2, "mask": "m"}\n', "line 3: image: expected a path"),
])
def test_a_broken_line_is_named(recording, tmp_path, line, complaint):
    lines = (recording / "samples.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "samples.jsonl").write_text("".join([*lines[:2], line, *lines[3:]]))
    with pytest.raises(data.RecordingError, match=f"samples.jsonl: {complaint}"):
        data.read_samples(tmp_path)


@pytest.mark.parametrize(("changes", "complaint"), [
    ({}, None),
    # Two dots within a name lead nowhere else.
    ({"image": "a/b..c.png"}, None),
    ({"id": "2"}, "id: expected 2, found '2'"),
    ({"id": 2.0}, "id: expected 2, found 2.0"),
    ({"id": 1}, "id: expected 2, found 1"),
    ({"image": "../ok/image/000002.jpg"}, "image: expected a path inside the recording's folder"),
    ({"mask": "/ok/mask/000002.png"}, "mask: expected a path inside the recording's folder"),
    ({"mask": ""}, "mask: expected a path inside the recording's folder"),
    ({"intrinsics": None}, "intrinsics: expected the numbers fx, fy, cx, cy, found None"),
    ({"intrinsics": CAMERA | {"cx": "255.5"}}, "intrinsics: expected the numbers"),
    ({"intrinsics": CAMERA | {"fx": 500}}, "intrinsics: fx: expected 182.5 at half size, found 250"),
    ({"intrinsics": CAMERA | {"cx": math.nan}}, "intrinsics: cx: expected 127.5 at half size, found nan"),
    ({"joints_m": [[0.1, 0.2, 1.5]] * 5 + [[0.1, 0.2, 0.0]]}, "joints_m: expected 6 finite points before the camera"),
    ({"joints_m": [[0.1, 0.2, 1.5]] * 5 + [[0.1, math.nan, 1.5]]}, "joints_m: expected 6 finite points before the camera"),
])
def test_what_is_wrong_with_a_sample_is_named(recording, tmp_path, changes, complaint):
    lines = (recording / "samples.jsonl").read_text().splitlines(keepends=True)
    lines[2] = json.dumps(json.loads(lines[2]) | changes) + "\n"
    (tmp_path / "samples.jsonl").write_text("".join(lines))
    if complaint is None:
        assert len(data.read_samples(tmp_path)) == len(lines)
        return
    with pytest.raises(data.RecordingError, match=f"samples.jsonl: line 3: {complaint}"):
        data.read_samples(tmp_path)


@pytest.mark.parametrize(("changes", "complaint"), [
    ({}, None),
    ({"robot": None}, "robot: expected a name, found None"),
    ({"robot": 5}, "robot: expected a name, found 5"),
    ({"source": [1]}, r"source: expected an object, found \[1\]"),
    ({"version": 2}, "version: expected 1, found 2"),
])
def test_what_is_wrong_with_a_header_is_named(recording, tmp_path, changes, complaint):
    header = json.loads((recording / "recording.json").read_text()) | changes
    (tmp_path / "recording.json").write_text(json.dumps(header))
    if complaint is None:
        assert data.read_header(tmp_path) == header
        return
    with pytest.raises(data.RecordingError, match=f"recording.json: {complaint}"):
        data.read_header(tmp_path)


def test_a_header_is_an_object(tmp_path):
    (tmp_path / "recording.json").write_text("[]")
    with pytest.raises(data.RecordingError, match=r"recording.json: expected an object, found \[\]"):
        data.read_header(tmp_path)


def test_views_keep_image_and_mask_together():
    torch.manual_seed(0)
    mask = torch.zeros(8, 1, INPUT_HEIGHT, INPUT_WIDTH)
    mask[:, :, 60:150, 70:190] = 1
    images, masks = data.random_views(mask.expand(-1, 3, -1, -1), mask, 128, 160)
    assert images.shape == (8, 3, 128, 160)
    assert ((images[:, :1] >= 0.5).float() == masks).all()
    assert 0.1 < masks.mean() < 0.9


class _Left(torch.nn.Module):
    """Sees a robot left of the middle in any image."""

    def forward(self, images):
        mask = torch.zeros(len(images), 1, *images.shape[2:])
        mask[:, :, 80:130, 60:110] = 1
        return mask


def test_closer_views_are_of_the_picture_s_own_pixels_where_the_coarse_network_looks():
    torch.manual_seed(0)
    height, width = 2 * INPUT_HEIGHT, 2 * INPUT_WIDTH
    # Robot and background in columns of single pixels, but for a block where the coarse network looks.
    masks = torch.zeros(6, height, width, dtype=torch.uint8)
    masks[:, :, ::2] = 255
    masks[:, 150:270, 110:230] = 255
    images = masks[..., None].expand(-1, -1, -1, 3)
    seen, truth = data.closer_views(images, masks, _Left(), False, share=0)
    assert seen.shape == (6, 3, INPUT_HEIGHT, INPUT_WIDTH) and truth.shape == (6, 1, INPUT_HEIGHT, INPUT_WIDTH)
    assert ((seen[:, :1] >= 0.5).float() == truth).all()
    # It is in the middle, and twice as large as in the networks' own image, mirrored or not.
    assert truth[:, 0, 60:150, 80:175].all() and truth.mean() < 0.9
    # Columns that halving makes grey all over are told apart.
    assert seen[:, 0, :20].std() > 0.2 and zoom.canonical(masks[:, None].float() / 255)[0, 0, :20].std() < 1e-6
    # With cameras and light of their own, pictures and masks stay together.
    masks = torch.zeros_like(masks)
    masks[:, 150:270, 110:230] = 255
    varied, truth = data.closer_views(masks[..., None].expand(-1, -1, -1, 3), masks, _Left(), False, share=1)
    assert len({round(float(mask.mean()), 3) for mask in truth}) > 3
    assert torch.corrcoef(torch.stack([varied[:, 0].flatten(), truth.flatten()]))[0, 1] > 0.7


def test_crops_are_parts_of_the_image_as_they_are():
    torch.manual_seed(0)
    numbers = torch.arange(float(INPUT_HEIGHT * INPUT_WIDTH)).reshape(1, 1, INPUT_HEIGHT, INPUT_WIDTH)
    images, masks = data.random_crops(numbers.expand(8, 3, -1, -1), numbers.expand(8, 1, -1, -1), 20, 30)
    assert images.shape == (8, 3, 20, 30) and torch.equal(images[:, :1], masks)
    corners = masks[:, 0, 0, 0]
    inside = torch.arange(20)[:, None] * INPUT_WIDTH + torch.arange(30)
    assert torch.equal(masks[:, 0] - corners[:, None, None], inside.expand(8, -1, -1).float())
    # Not one place for all.
    assert len(corners.unique()) > 4


def test_colours_vary_about_the_image():
    torch.manual_seed(0)
    image = torch.randint(0, 256, (1, 32, 40, 3), dtype=torch.uint8)
    varied = data.jitter_colours(image.repeat(64, 1, 1, 1))
    assert varied.shape == (64, 3, 32, 40) and varied.min() >= 0 and varied.max() <= 1
    plain = image[0].permute(2, 0, 1) / 255
    assert (varied.mean(0) - plain).abs().mean() < 0.06
    assert (varied - plain).abs().mean((1, 2, 3)).min() > 0.005
    # Colours stay where they were.
    assert torch.corrcoef(torch.stack([varied[3].flatten(), plain.flatten()]))[0, 1] > 0.8


def test_negatives_fill_the_input(tmp_path):
    Image.new("RGB", (90, 30), (10, 200, 30)).save(tmp_path / "wide.png")
    Image.new("L", (30, 90), 7).save(tmp_path / "tall.jpg")
    for _ in range(2):
        photographs = data.read_negatives([tmp_path], tmp_path / "cache")
        assert photographs.shape == (2, 2 * INPUT_HEIGHT, 2 * INPUT_WIDTH, 3)
        assert photographs[1, 100, 100].tolist() == [10, 200, 30]
    (tmp_path / "broken.jpg").write_bytes(b"GIF89a and no more")
    with pytest.raises(data.RecordingError, match="broken.jpg: expected a photograph: cannot identify"):
        data.read_negatives([tmp_path], tmp_path / "cache")
    with pytest.raises(data.RecordingError, match="no photographs"):
        data.read_negatives([tmp_path / "cache"], tmp_path / "cache")


def test_jittered_masks_move_only_where_they_are_not_sure():
    torch.manual_seed(0)
    masks = torch.tensor([0.0, 0.02, 0.4, 0.6, 0.98, 1.0]).repeat(500, 1)[:, None, None]
    varied = data.jitter_masks(masks)[:, 0, 0]
    changed = ((varied >= 0.5) != (masks[:, 0, 0] >= 0.5)).float().mean(0)
    assert varied.min() >= 0 and varied.max() <= 1
    assert (changed[[0, 5]] == 0).all() and (changed[[1, 4]] < 0.01).all()
    assert (changed[[2, 3]] > 0.2).all()
