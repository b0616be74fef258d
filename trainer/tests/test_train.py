import csv
import json
import math
import re
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from arms import BODY
from conftest import draw_recording
from whereabot_trainer import data, evaluate, export, golden, losses, pipeline, zoom
from whereabot_trainer.__main__ import main
from whereabot_trainer.export import SURE_THRESHOLDS, choose_presence
from whereabot_trainer.model import read_model, write_model
from whereabot_trainer.networks import (
    JOINT_INPUT, MASK_INPUT, OVERLAYS, Network, back_project, coarse_mask_layers, context_mask_layers, heatmap_joint_layers, paper_joint_layers,
    paper_mask_layers, soft_argmax2d)
from whereabot_trainer.train import heat_loss, load_network, output_unit, start_from


@pytest.fixture
def train(recording, tmp_path):
    def run(command, out, *flags):
        main([command, "--recording", str(recording), "--out", str(tmp_path / out), "--cache", str(tmp_path / "cache"),
              "--batch", "4", "--threads", "2", *flags])
        return tmp_path / out
    return run


def _weights(run):
    return torch.load(run / "last.pt", weights_only=False)["network"]


def _log(run):
    with open(run / "log.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_resumed_run_goes_on_as_if_never_stopped(train, tmp_path, monkeypatch):
    flags = ("--iterations", "6", "--evaluate-every", "3", "--precision", "f32", "--crop", "32", "24",
             "--validation-samples", "2")
    whole = train("train-mask", "whole", *flags)

    score, calls = evaluate.score_mask, []

    def stop_at_the_second(*args):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return score(*args)

    monkeypatch.setattr(evaluate, "score_mask", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        train("train-mask", "parts", *flags)
    half = {key: value.clone() for key, value in _weights(whole.parent / "parts").items()}
    monkeypatch.setattr(evaluate, "score_mask", score)
    # As if the second evaluation had been logged, a third half, and neither saved.
    log = tmp_path / "parts" / "log.csv"
    header, row = log.read_text().splitlines()
    log.write_text(f"{header}\n{row}\n6{row[1:]}\n9,0,1")
    parts = train("train-mask", "parts", *flags, "--resume")

    for key, value in _weights(whole).items():
        assert torch.equal(value, _weights(parts)[key]), key
        # The average over batches stands still by then.
        assert "_norm.running" in key or "tracked" in key or not torch.equal(value, half[key]), f"{key} was not trained"
    logs = [[row | {"seconds": None} for row in _log(run)] for run in (parts, whole)]
    assert logs[0] == logs[1] and [row["iteration"] for row in logs[0]] == ["3", "6"]


def test_a_longer_run_does_not_thaw_the_normalisation(train):
    flags = ("--precision", "f32", "--crop", "32", "24", "--validation-samples", "2", "--iterations")

    def averages(run):
        return {key: value.clone() for key, value in _weights(run).items() if "_norm.running" in key}

    first = averages(train("train-mask", "run", *flags, "1"))
    thawed = averages(train("train-mask", "run", *flags, "6", "--resume"))
    assert any(not torch.equal(thawed[key], first[key]) for key in first)
    # Six of forty are less than a quarter again.
    frozen = averages(train("train-mask", "run", *flags, "40", "--resume"))
    assert all(torch.equal(frozen[key], thawed[key]) for key in thawed)


@pytest.mark.parametrize(("spoilt", "gradient"), [(3, "inf"), (4, "nan")])
def test_weights_that_are_not_finite_are_not_kept(train, tmp_path, monkeypatch, spoilt, gradient):
    flags = ("--iterations", "6", "--evaluate-every", "2", "--precision", "f32", "--crop", "32", "24",
             "--validation-samples", "2")
    mask_loss, calls = losses.mask_loss, []

    def spoil(masks, *rest):
        calls.append(None)
        loss = mask_loss(masks, *rest)
        if len(calls) != spoilt:
            return loss
        if gradient == "nan":
            # A finite loss, whose gradient is not: only the weights tell, and only after this step.
            loss = loss + (masks.sum() * 0).abs().sqrt()
            assert loss.isfinite()
            return loss
        return loss * math.inf

    monkeypatch.setattr(losses, "mask_loss", spoil)
    with pytest.raises(SystemExit, match="run: iteration 4: expected finite .* as it was"):
        train("train-mask", "run", *flags)
    monkeypatch.setattr(losses, "mask_loss", mask_loss)
    run = tmp_path / "run"
    assert all(value.isfinite().all() for value in _weights(run).values())
    assert [row["iteration"] for row in _log(run)] == ["2"]
    # What was kept goes on.
    train("train-mask", "run", *flags, "--resume")
    assert [row["iteration"] for row in _log(run)] == ["2", "4", "6"]


def test_a_run_is_not_overwritten(train):
    flags = ("--iterations", "1", "--crop", "32", "24", "--validation-samples", "1")
    settings = train("train-mask", "run", *flags) / "settings.json"
    before = settings.read_text()
    with pytest.raises(SystemExit, match="--resume"):
        train("train-mask", "run", *flags, "--batch", "3")
    assert settings.read_text() == before


@pytest.mark.parametrize("command", ["train-mask", "train-joint"])
def test_what_cannot_be_done_ends_in_one_line(tmp_path, command):
    words = [sys.executable, "-m", "whereabot_trainer", command, "--recording", str(tmp_path / "none"), "--out", str(tmp_path / "run")]
    for more, complaint in ((["--resume"], f"--resume: expected {tmp_path / 'run' / 'last.pt'}, found none"),
                            ([], f"{tmp_path / 'none' / 'recording.json'}: ")):
        ended = subprocess.run([*words, *more], capture_output=True, text=True, check=False)
        assert ended.returncode == 1
        assert ended.stderr.startswith(complaint) and ended.stderr.count("\n") == 1, ended.stderr


@pytest.mark.parametrize("family", ["paper", "context"])
def test_export_folds_calibration_and_unit(train, recording, held_out, tmp_path, monkeypatch, family):
    # What a network of three batches is best at may be no shift at all.
    monkeypatch.setattr(evaluate, "calibrate", lambda *_: 0.7)
    mask_run = train("train-mask", "mask", "--iterations", "3", "--crop", "32", "24", "--validation-samples", "4")
    joint_run = train("train-joint", "joint", "--family", family, "--iterations", "3", "--pool", "4", "--validation-samples", "4",
                      "--mask-run", str(mask_run), "--estimated-masks", "0.5")
    path = tmp_path / "model.safetensors"
    main(["export", "--mask", str(mask_run), "--joint", str(joint_run), "--validation", str(held_out),
          "--validation-samples", "10", "--cache", str(tmp_path / "cache"), "--out", str(path)])
    networks, description = read_model(path)
    mask, joint = networks["mask"], networks["joint"]
    assert [len(description["card"]["curves"][name]) for name in ("mask_accuracy", "estimated_mask_cm")] == [1, 1]
    assert description["card"]["figures"]["estimated_mask_mean_cm"] > 0

    trained_mask, _ = load_network(mask_run)
    trained_joint, joint_state = load_network(joint_run)
    images, _ = data.Samples([recording], tmp_path / "cache").pixels([0, 1])
    shift = description["card"]["calibration"]["logit_shift"]
    assert shift == 0.7
    assert torch.allclose(mask(images), torch.sigmoid(torch.logit(trained_mask(images)) + shift), atol=1e-5)
    assert not torch.allclose(mask(images), trained_mask(images), atol=1e-2)
    arms = torch.full((2,), float(data.Samples([recording], tmp_path / "cache").arms[0]))
    metres = output_unit(joint_state["card"]).metres(trained_joint(images), arms)
    assert torch.allclose(joint(images).reshape(-1, 6, 3), metres, atol=1e-4)
    assert not torch.allclose(joint(images), trained_joint(images), atol=1e-2)


def _enlarge(recording, factor):
    """Makes the arm of a recording so much longer."""
    samples = [json.loads(line) for line in (recording / "samples.jsonl").read_text().splitlines()]
    for sample in samples:
        if "joints_m" in sample:
            sample["joints_m"] = (factor * np.array(sample["joints_m"])).tolist()
    (recording / "samples.jsonl").write_text("".join(json.dumps(sample) + "\n" for sample in samples))


def test_arms_are_as_long_as_they_were_for_training(recording, tmp_path, monkeypatch):
    training, validation, cache = tmp_path / "training", tmp_path / "validation", tmp_path / "cache"
    for folder in (training, validation):
        shutil.copytree(recording, folder)
    _enlarge(validation, 1.1)
    length, other = (data.Samples([folder], cache).arm_lengths["ur5"] for folder in (training, validation))
    assert other == pytest.approx(1.1 * length)
    score, scored_in = evaluate.score_joints, []

    def spy(network, metres, samples, *rest):
        scored_in.append(samples.arms[0])
        return score(network, metres, samples, *rest)

    monkeypatch.setattr(evaluate, "score_joints", spy)
    given = ["--cache", str(cache), "--validation-samples", "20"]
    run, mask = tmp_path / "run", tmp_path / "mask"

    def train(command, out, *flags):
        main([command, "--recording", str(training), "--validation", str(validation), "--out", str(out), "--batch", "4",
              *given, *flags])

    def exported_length():
        main(["export", "--mask", str(mask), "--joint", str(run), "--validation", str(validation), *given,
              "--out", str(tmp_path / "model.safetensors")])
        networks, description = read_model(tmp_path / "model.safetensors")
        added = networks["joint"].dense2.bias[2] - load_network(run)[0].dense2.bias[2]
        assert added.item() == pytest.approx(math.log(description["card"]["arm_length_m"]), abs=1e-6)
        return description["card"]["arm_length_m"]

    train("train-mask", mask, "--iterations", "1", "--crop", "32", "24")
    train("train-joint", run, "--iterations", "1", "--family", "context")
    assert exported_length() == pytest.approx(length)
    # What the training recording has become since is another unit.
    _enlarge(training, 1.2)
    train("train-joint", run, "--iterations", "2", "--family", "context", "--resume")
    assert exported_length() == pytest.approx(length)
    assert len(scored_in) >= 4 and scored_in == pytest.approx([length] * len(scored_in))
    # A run whose card says nothing has the length that is measured.
    state = torch.load(run / "last.pt", weights_only=False)
    del state["card"]["arm_lengths_m"]
    torch.save(state, run / "last.pt")
    assert exported_length() == pytest.approx(other)
    train("train-joint", run, "--iterations", "3", "--family", "context", "--resume")
    assert exported_length() == pytest.approx(1.2 * length)


def test_presence_rejects_images_without_a_robot_and_finds_the_most_robots():
    robots = {threshold: [0.05, 0.1, 0.2] for threshold in SURE_THRESHOLDS}
    without = {threshold: [0.0] * 19 + [0.3] + [0.08] * 19 + [0.3] for threshold in SURE_THRESHOLDS}
    without[0.9] = [0.0] * 38 + [0.3, 0.4]
    assert choose_presence(robots, without) == (0.9, 0.001)
    robots[0.9], without[0.9] = [0.07, 0.1, 0.2], [0.0] * 37 + [0.06, 0.3, 0.4]
    threshold, least = choose_presence(robots, without)
    assert threshold == 0.9 and 0.06 < least < 0.061
    # All are found at both; there, they are farther from being missed.
    robots[0.95] = [0.12, 0.13, 0.2]
    threshold, least = choose_presence(robots, without)
    assert threshold == 0.95 and 0.08 < least < 0.081
    robots[0.95] = [0.09, 0.13, 0.2]
    assert choose_presence(robots, without)[0] == 0.9


def test_calibration_finds_the_best_threshold():
    class Fixed(torch.nn.Module):
        def forward(self, images):
            # Robot pixels have a logit of 1 or 3, the background up to 1.9: 0.5 (logit 0) is not the best threshold.
            return torch.sigmoid(images[:, :1])

    class Made:
        def pictures(self, numbers):
            mask = torch.zeros(len(numbers), 1, 10, 10)
            mask[..., :5] = 1
            image = torch.where(mask > 0, 3.0, 1.9)
            image[..., 0, 0] = 1.0
            return image.repeat_interleave(2, 2).repeat_interleave(2, 3).expand(-1, 3, -1, -1), mask

    assert evaluate.score_mask(Fixed(), Made(), [0, 1], "cpu")["iou"] == 0.5
    shift = evaluate.calibrate(Fixed(), Made(), [0, 1], "cpu")
    assert evaluate.score_mask(Fixed(), Made(), [0, 1], "cpu", shift)["iou"] == pytest.approx(0.98, abs=1e-3)
    assert -3.001 <= shift < -1.9


def _before_cameras(kept):
    """The names of the values that no mask has turned a camera for."""
    first = "coarse." if "merged" in kept else "mask."
    return [name for name in kept if name.startswith(first)]


def _unlike(made, kept, zoomed):
    """The names of the values that are not what was `kept`."""
    assert made.keys() == kept.keys()
    names = []
    for name in made:
        # A convolution adds in another order on another CPU: what it rounds goes with its largest terms. What lies behind a
        # zoom sees more of it: the mask's roundings turn and zoom a camera, and ramp and bilinear samples are steep in that.
        # There it is what the engine is held to against PyTorch.
        bound = 1e-5 if zoomed and name not in _before_cameras(kept) else 1e-6
        largest = max(1.0, float(kept[name].float().abs().max()))
        if not torch.allclose(made[name].float(), kept[name].float(), atol=bound * largest):
            names.append(name)
    return names


def test_committed_golden_files_are_what_pytorch_computes(tmp_path, request):
    committed = request.config.rootpath.parent / "tests" / "data" / "golden"
    golden.write_golden(tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(path.name for path in committed.iterdir()) and len(names) == 16
    for name in names:
        made, kept = load_file(tmp_path / name), load_file(committed / name)
        zoomed = name in ("zoom.activations.safetensors", "coarse.activations.safetensors")
        assert not _unlike(made, kept, zoomed), name
        # Negative control: a value three bounds off, of those behind a zoom and of those before it.
        for part in ("mask.", "joint", *(["coarse.", "merged"] if "merged" in kept else [])):
            key = next(key for key in kept if key.startswith(part))
            off = 3e-5 if zoomed and key not in _before_cameras(kept) else 3e-6
            largest = max(1.0, float(kept[key].float().abs().max()))
            wrong = made[key].float().flatten().clone()
            wrong[wrong.abs().argmin()] += off * largest
            assert _unlike(made | {key: wrong.reshape(made[key].shape)}, kept, zoomed) == [key], name
    networks, description = read_model(committed / "tiny.safetensors")
    networks["mask"].conv2.weight.data[0, 0, 1, 1] += 0.01
    values = golden.cascade_activations(
        networks, description, load_file(committed / "tiny.activations.safetensors")["mask.image"])
    assert (values["joints"] - load_file(committed / "tiny.activations.safetensors")["joints"]).abs().max() > 1e-5


def _same(network, other):
    tensors = other.state_dict()
    return all(torch.equal(tensor, tensors[key]) for key, tensor in network.state_dict().items())


def test_joints_are_trained_on_beside_a_model_file_s_mask_network(train, held_out, tmp_path):
    cache, first, second = ["--cache", str(tmp_path / "cache")], tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    steps = ["--iterations", "2", "--validation-samples", "4"]
    mask_run = train("train-mask", "mask", *steps, "--crop", "32", "24")
    joint_run = train("train-joint", "joint", *steps)

    def export(mask, joint, out):
        main(["export", "--mask", str(mask), "--joint", str(joint), "--validation", str(held_out),
              "--validation-samples", "10", "--out", str(out), *cache])
        return read_model(out)

    networks, description = export(mask_run, joint_run, first)
    joint_run = train("train-joint", "joint-on", *steps, "--init-from", str(first), "--mask-run", str(first),
                      "--estimated-masks", "0.5")
    others, again = export(first, joint_run, second)
    assert _same(networks["mask"], others["mask"]) and not _same(networks["joint"], others["joint"])
    for key in ("mask_training", "calibration"):
        assert again["card"][key] == description["card"][key]
    assert again["presence"] == description["presence"]


@pytest.fixture
def context_runs(train):
    """Runs of the context family's coarse network, mask network and joint network."""
    steps = ["--iterations", "2", "--validation-samples", "4", "--family", "context"]
    mask = train("train-mask", "mask", *steps, "--crop", "32", "24")
    return (train("train-mask", "coarse", *steps, "--coarse", "--crop", "32", "24", "--init-from", str(mask)), mask,
            train("train-joint", "joint", *steps))


@pytest.fixture
def behind_coarse(monkeypatch):
    """Of each batch of masks that is made from here on, whether a coarse network turns the mask network's camera."""
    masks_of, seen = evaluate.masks_of, []

    def spy(network, pictures, coarse=None, bf16=False):
        seen.append(coarse is not None)
        return masks_of(network, pictures, coarse, bf16)

    monkeypatch.setattr(evaluate, "masks_of", spy)
    return seen


def test_a_model_file_is_exported_again_with_its_coarse_network_or_another(context_runs, small_recording, tmp_path, behind_coarse):
    seen = behind_coarse

    def exported(mask, joint, *flags):
        out = tmp_path / "out.safetensors"
        main(["export", "--mask", str(mask), "--joint", str(joint), "--validation", str(small_recording), "--out", str(out),
              "--validation-samples", "6", "--cache", str(tmp_path / "cache"), *flags])
        return read_model(out)

    def file(name, without=(), **changes):
        description = {key: value for key, value in {**first, **changes}.items() if key not in without}
        write_model(tmp_path / name, {key: network for key, network in networks.items() if key not in without}, description)
        return tmp_path / name

    coarse_run, mask_run, joint_run = context_runs
    networks, first = exported(mask_run, joint_run, "--coarse", str(coarse_run))
    assert list(networks) == ["coarse", "mask", "joint"] and first["coarse"]["zoom"] == zoom.MASK_ZOOM
    assert first["card"]["coarse_training"]["iterations"] == 2 and first["card"]["joint_training"]["min_coverage"] == 0.005
    seen.clear()
    others, again = exported(file("same"), tmp_path / "same")
    assert set(seen) == {True} and again == first and all(_same(networks[name], others[name]) for name in networks)

    # What presence was chosen by stays, or does not.
    other = {"mask_threshold": 0.5, "sure_threshold": 0.6, "min_sure": 0.6}
    assert exported(file("other", presence=other), tmp_path / "same")[1]["presence"] == other != first["presence"]
    alone = file("alone", ["coarse"], presence=other)
    seen.clear()
    others, without = exported(alone, tmp_path / "same")
    # What is measured is measured without it, too.
    assert set(seen) == {False} and list(others) == ["mask", "joint"] and "coarse" not in without and without["presence"] == other
    for source in (coarse_run, tmp_path / "same"):
        others, renewed = exported(alone, tmp_path / "same", "--coarse", str(source))
        assert _same(networks["coarse"], others["coarse"]) and renewed["presence"] == first["presence"]
        assert renewed["card"]["coarse_training"] == first["card"]["coarse_training"]
    assert without["card"]["figures"]["true_mask_mean_cm"] == first["card"]["figures"]["true_mask_mean_cm"]

    with pytest.raises(SystemExit, match="of ur10, not of ur5"):
        exported(mask_run, file("ur10", robot="ur10"))
    with pytest.raises(SystemExit, match="has no coarse network"):
        exported(mask_run, joint_run, "--coarse", str(alone))
    for given in ((mask_run, tmp_path / "none"), (tmp_path / "none", joint_run), (mask_run, joint_run, "--coarse", str(tmp_path / "none"))):
        with pytest.raises(SystemExit, match="a run or a model file, found .*none"):
            exported(*given)


def test_both_masks_are_calibrated_the_mask_network_s_behind_the_coarse_one(context_runs, held_out, tmp_path, monkeypatch):
    coarse, mask, joint = context_runs
    given = []

    def calibrate(*words):
        given.append(words[4])
        return -1.5

    monkeypatch.setattr(evaluate, "calibrate", calibrate)
    main(["export", "--mask", str(mask), "--coarse", str(coarse), "--joint", str(joint), "--validation", str(held_out),
          "--validation-samples", "10", "--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")])
    networks, description = read_model(tmp_path / "out")
    shift = load_network(coarse)[1]["figures"]["logit_shift"]
    card = description["card"]
    assert (card["calibration"]["logit_shift"], card["coarse_training"]["logit_shift"]) == (-1.5, shift)
    for name, run, layer, added in (("mask", mask, "conv11", -1.5), ("coarse", coarse, "logit", shift)):
        difference = getattr(networks[name], layer).bias - getattr(load_network(run)[0], layer).bias
        assert difference.item() == pytest.approx(added, abs=1e-6)
    assert len(given) == 1 and _same(given[0], networks["coarse"])


def test_a_coarse_network_goes_on_from_its_own_weights_and_begins_as_the_mask_network(context_runs, train):
    coarse, mask, _ = context_runs
    steps = ["--iterations", "1", "--validation-samples", "4", "--family", "context", "--coarse", "--crop", "32", "24",
             "--learning-rate", "1e-9", "1e-9"]
    for start, kept in ((coarse, ("conv1", "conv5", "wide", "logit")), (mask, ("conv1", "conv5"))):
        source = load_network(start)[0].state_dict()
        begun = load_network(train("train-mask", f"from-{start.name}", *steps, "--init-from", str(start)))[0].state_dict()
        for layer in ("conv1", "conv5", "wide", "logit"):
            # But for the normalisation, which has seen a batch.
            before, after = (tensors.get(f"{layer}.weight", torch.zeros(1)).flatten() for tensors in (source, begun))
            assert (len(before) == len(after) and torch.cosine_similarity(before, after, 0) > 0.99) == (layer in kept)
    with pytest.raises(SystemExit, match="--family context"):
        train("train-mask", "paper", "--coarse", "--family", "paper")


def test_a_mask_network_is_trained_on_what_its_camera_sees_and_scored_behind_it(context_runs, train, monkeypatch, behind_coarse):
    coarse, mask, _ = context_runs
    views, given = data.closer_views, []

    def spy(images, masks, network, bf16):
        given.append((tuple(images.shape[1:3]), network))
        return views(images, masks, network, bf16)

    monkeypatch.setattr(data, "closer_views", spy)
    steps = ["--iterations", "2", "--validation-samples", "4", "--family", "context", "--init-from", str(mask)]
    card = load_network(train("train-mask", "closer", *steps, "--coarse-run", str(coarse)))[1]["card"]
    assert [size for size, _ in given] == [(424, 512)] * 2 and behind_coarse and all(behind_coarse)
    last = load_network(coarse)[0].state_dict()["logit.bias"] + load_network(coarse)[1]["figures"]["logit_shift"]
    assert torch.allclose(given[0][1].state_dict()["logit.bias"], last)
    assert card["coarse_run"] == "coarse" and card["zoom"] == zoom.MASK_ZOOM and "crop" not in card
    del given[:], behind_coarse[:]
    train("train-mask", "alone", *steps, "--crop", "32", "24")
    assert not given and not any(behind_coarse)
    for flags in (["--coarse"], ["--camera", "fixed"]):
        with pytest.raises(SystemExit, match="neither --coarse nor --camera fixed"):
            train("train-mask", "neither", *steps, "--coarse-run", str(coarse), *flags)


@pytest.mark.parametrize("flags", [[], ["--coarse-run"]])
def test_joints_are_trained_behind_what_export_s_masks_will_be(context_runs, train, monkeypatch, flags):
    masks_of, seen = evaluate.masks_of, []
    coarse, mask, _ = context_runs

    def spy(network, pictures, coarse=None, bf16=False):
        seen.append((coarse is not None, bf16))
        return masks_of(network, pictures, coarse, bf16)

    monkeypatch.setattr(evaluate, "masks_of", spy)
    train("train-joint", "behind", "--iterations", "1", "--validation-samples", "4", "--mask-run", str(mask),
          "--estimated-masks", "1", "--family", "context", *flags, *[str(coarse)] * len(flags))
    # Those that are trained on in bfloat16, those that the log tells of not.
    assert set(seen) == {(bool(flags), True), (bool(flags), False)}


def test_several_runs_are_exported_as_the_mean_of_their_weights(train, held_out, tmp_path):
    steps = ["--iterations", "2", "--validation-samples", "4", "--family", "context"]
    runs = [train("train-joint", "first", *steps)]
    runs.append(train("train-joint", "second", *steps, "--init-from", str(runs[0])))
    tensors = [load_network(run)[0].state_dict() for run in runs]
    mean = export._mean_of(list(map(str, runs)))[0].state_dict()
    for key, tensor in mean.items():
        assert torch.allclose(tensor, (tensors[0][key] + tensors[1][key]) / 2)
    assert not torch.allclose(mean["conv1.weight"], tensors[1]["conv1.weight"])
    other = train("train-joint", "other", *steps[:4], "--family", "paper", "--pool", "4")
    with pytest.raises(SystemExit, match="one network"):
        export._mean_of([str(runs[0]), str(other)])

    masks = [train("train-mask", "first-mask", *steps, "--crop", "32", "24")]
    masks.append(train("train-mask", "second-mask", *steps, "--crop", "32", "24", "--init-from", str(masks[0])))
    out = tmp_path / "mean.safetensors"
    main(["export", "--mask", *map(str, masks), "--joint", *map(str, runs), "--validation", str(held_out), "--out", str(out),
          "--validation-samples", "10", "--cache", str(tmp_path / "cache")])
    networks, description = read_model(out)
    expected = export._mean_of(list(map(str, masks)))[0].state_dict()
    for key, tensor in networks["mask"].state_dict().items():
        shift = description["card"]["calibration"]["logit_shift"] if key == "conv11.bias" else 0.0
        assert torch.allclose(tensor, expected[key] + shift, atol=1e-6)
    assert torch.allclose(networks["joint"].state_dict()["conv1.weight"], mean["conv1.weight"])
    card = description["card"]
    assert [each["run"] for each in card["joint_training"]["mean_of"]] == [run.name for run in runs]
    assert [each["iterations"] for each in card["mask_training"]["mean_of"]] == [2, 2]
    with pytest.raises(SystemExit, match="folder of a run"):
        export._mean_of([str(masks[0]), str(out)])
    # The model file that a run started from is one of them.
    again = tmp_path / "again.safetensors"
    main(["export", "--mask", str(out), str(masks[1]), "--joint", str(out), "--validation", str(held_out), "--out", str(again),
          "--validation-samples", "10", "--cache", str(tmp_path / "cache")])
    half, before, last = (tensors["conv1.weight"] for tensors in (
        read_model(again)[0]["mask"].state_dict(), expected, load_network(masks[1])[0].state_dict()))
    assert torch.allclose(half, (before + last) / 2, atol=1e-6) and not torch.allclose(half, last)
    assert [list(each)[0] for each in read_model(again)[1]["card"]["mask_training"]["mean_of"]] == ["file", "run"]


@pytest.mark.parametrize("layers", [paper_mask_layers(), context_mask_layers(), coarse_mask_layers()])
def test_folding_normalisation_keeps_the_function(layers):
    torch.manual_seed(0)
    network, plain = Network(layers, MASK_INPUT, normalise=True), Network(layers, MASK_INPUT)
    for _ in range(3):
        network(torch.rand(4, 3, 212, 256))
    network.eval()
    images = torch.rand(2, 3, 212, 256)
    before = network(images)
    network.conv1_norm.weight.data *= 1.5
    changed = network(images)
    network.fold_normalisation()
    assert torch.allclose(network(images), changed, atol=1e-5) and not torch.allclose(before, changed, atol=1e-5)
    assert network.state_dict().keys() == plain.state_dict().keys()


def test_a_network_refuses_what_it_cannot_build():
    layers = paper_joint_layers()
    layers[1]["inputs"] = ["nowhere"]
    with pytest.raises(ValueError, match="nowhere"):
        Network(layers, JOINT_INPUT)
    assert json.dumps(paper_joint_layers())


def test_soft_argmax_finds_a_joint_between_cells_and_beyond_the_edge():
    heat = torch.full((1, 2, 3, 4), -50.0)
    votes = torch.zeros(1, 6, 3, 4)
    # The first joint lies between columns 1 and 2 of row 2; the second is voted for from the corner, far outside.
    heat[0, 0, 2, 1] = heat[0, 0, 2, 2] = heat[0, 1, 0, 0] = 50.0
    votes[0, 2] = 0.7
    votes[0, 3:5, 0, 0] = torch.tensor([-9.0, -8.0])
    found = soft_argmax2d(heat, votes, (10.0, 20.0), (2.0, 4.0)).flatten().tolist()
    assert found == pytest.approx([13.0, 28.0, 0.7, 1.0, 12.0, 0.0])
    points = back_project(torch.tensor([0.5, -0.25, 0.7]).reshape(1, 3, 1, 1)).flatten().tolist()
    assert points == pytest.approx([0.5 * math.exp(0.7), -0.25 * math.exp(0.7), math.exp(0.7)])


def test_the_heat_maps_are_drawn_to_the_joints_in_view():
    place = {"origin": [-1.0, -1.0], "step": [0.5, 0.5]}
    truth = torch.tensor([[[0.5, -0.5, 1.0], [9.0, 0.0, 1.0]]])
    right, wrong = torch.zeros(1, 2, 5, 5), torch.zeros(1, 2, 5, 5)
    right[0, 0, 1, 3] = wrong[0, 0, 3, 1] = 1.5
    assert heat_loss(right, place, truth) < heat_loss(torch.zeros(1, 2, 5, 5), place, truth)
    assert heat_loss(torch.zeros(1, 2, 5, 5), place, truth) < heat_loss(wrong, place, truth)
    beyond = right.clone()
    beyond[0, 1, 2, 2] = 30.0
    assert heat_loss(beyond, place, truth) == heat_loss(right, place, truth)


def test_one_command_trains_two_robots_and_goes_on(small_recording, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(small_recording, other)
    header = json.loads((other / "recording.json").read_text())
    (other / "recording.json").write_text(json.dumps(header | {"robot": "ur10"}))
    command = ["train", "--recording", str(small_recording), str(other), "--out", str(tmp_path / "out"), "--minutes", "0.02",
               "--cache", str(tmp_path / "cache")]
    main(command)
    for robot in ("ur5", "ur10"):
        networks, description = read_model(tmp_path / "out" / f"{robot}.safetensors")
        assert description["robot"] == robot and description["family"] == "context" and "coarse" in networks
    assert "--resume" not in capsys.readouterr().out
    before = (tmp_path / "out" / "mask" / "log.csv").read_text()
    main(command)
    assert capsys.readouterr().out.count("--resume") == 6
    assert (tmp_path / "out" / "mask" / "log.csv").read_text() == before
    with pytest.raises(SystemExit, match="is of ur10"):
        main([*command[:2], str(small_recording), "--validation", str(other), *command[4:]])
    third = tmp_path / "third"
    shutil.copytree(other, third)
    with pytest.raises(SystemExit, match="none of ur5"):
        main([*command, "--validation", str(third)])


def test_no_recording_is_trained_and_validated_on(recording, tmp_path):
    same, other = tmp_path / "same", tmp_path / "other"
    same.symlink_to(recording)
    shutil.copytree(recording, other)
    for command in ("train", "train-mask", "train-joint"):
        words = [command, "--recording", str(recording), "--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache"),
                 "--minutes", "0.001", "--validation"]
        with pytest.raises(SystemExit, match=f"{recording}: expected recordings of their own to validate on"):
            main([*words, str(other), str(same)])
    assert not (tmp_path / "out").exists()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "settings.json").write_text(json.dumps({"recording": [str(recording)]}))
    for runs in (["run", "none"], ["none", "run"]):
        mask, joint = (str(tmp_path / run) for run in runs)
        with pytest.raises(SystemExit, match=f"{recording}: expected recordings of their own to validate on"):
            main(["export", "--mask", mask, "--joint", joint, "--validation", str(other), str(same), "--out", "out"])
    data.refuse_common([recording], [other])
    data.refuse_common([recording], None)


def test_a_small_validation_recording_is_chosen_on_and_reported_on_by_halves(recording, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(recording, other)
    args = SimpleNamespace(recording=[recording], validation=[other], family="context", negatives=None, minutes=1.0, seed=7,
                           cache="c", dtype="f16", out=str(tmp_path / "out"))
    commands = pipeline.steps(args)
    assert [words[0] for words in commands] == ["train-mask", "train-mask", "train-mask", "train-joint", "export"]
    for words in commands:
        assert words[words.index("--validation-samples") + 1] == "20"
        assert words[words.index("--seed") + 1] == "7"


def test_what_robots_share_is_chosen_on_as_many_samples_of_each(recording, tmp_path, monkeypatch):
    folders = {}
    for robot in ("ur5", "ur10"):
        folders[robot] = [tmp_path / f"{robot}-{part}" for part in ("training", "validation")]
        for folder in folders[robot]:
            shutil.copytree(recording, folder)
            header = json.loads((folder / "recording.json").read_text())
            (folder / "recording.json").write_text(json.dumps(header | {"robot": robot}))

    def counts(family, robots=("ur5", "ur10")):
        args = SimpleNamespace(
            recording=[folders[robot][0] for robot in robots], validation=[folders[robot][1] for robot in robots],
            family=family, negatives=None, minutes=1.0, seed=1, cache="c", dtype="f16", out=str(tmp_path / "out"))
        return [(words[0], int(words[words.index("--validation-samples") + 1])) for words in pipeline.steps(args)]

    monkeypatch.setattr(pipeline, "VALIDATION_SAMPLES", 15)
    own = [("train-joint", 15)] * 2
    assert counts("context") == [*[("train-mask", 30)] * 3, ("train-joint", 30), *own, *[("export", 30)] * 2]
    assert {count for _, count in counts("paper") + counts("context", ["ur10"])} == {15}
    # Half of the samples are reported on.
    monkeypatch.setattr(pipeline, "VALIDATION_SAMPLES", 35)
    assert counts("context")[0] == ("train-mask", 40)


def test_export_fits_an_arm_and_says_when_it_does_not(train, tmp_path, capsys):
    mask = train("train-mask", "mask", "--iterations", "1", "--crop", "32", "24", "--validation-samples", "4")
    joint = train("train-joint", "joint", "--iterations", "1", "--pool", "4", "--validation-samples", "4")
    validation, bent, out = tmp_path / "validation", tmp_path / "bent", tmp_path / "model.safetensors"
    draw_recording(validation, 44, seed=1)
    shutil.copytree(validation, bent)
    samples = [json.loads(line) for line in (bent / "samples.jsonl").read_text().splitlines()]
    for sample in samples:
        if "joints_m" in sample:
            sample["joints_m"][5][0] += 0.02
    (bent / "samples.jsonl").write_text("".join(json.dumps(sample) + "\n" for sample in samples))

    def export(folder, count, *flags):
        main(["export", "--mask", str(mask), "--joint", str(joint), "--validation", str(folder), "--cache", str(tmp_path / "cache"),
              "--validation-samples", str(count), "--out", str(out), *flags])
        description = read_model(out)[1]
        assert description["card"]["fit"] == ("arm" in description)
        return description, capsys.readouterr().out

    description, said = export(validation, 38)
    assert description["arm"]["bodies"] == [pytest.approx(BODY, abs=1e-4)] and "no kinematic fit" not in said
    for folder, count, flags, why in ((validation, 38, ["--no-fit"], "--no-fit"), (validation, 12, [], r"\d+ of 30 samples with a ur5"),
                                      (bent, 38, [], "joints are not those")):
        description, said = export(folder, count, *flags)
        assert "arm" not in description and re.search(f"^no kinematic fit: {why}", said, re.MULTILINE)


def test_the_recordings_tell_whether_the_camera_stands_still(recording, tmp_path):
    def commands(*folders):
        args = SimpleNamespace(recording=folders, validation=None, family="paper", negatives=None, minutes=1.0, seed=1,
                               cache="c", dtype="f16", out=str(tmp_path / "out"))
        return [words for words in pipeline.steps(args) if words[0] != "export"]

    fixed = tmp_path / "fixed"
    fixed.mkdir()
    header = json.loads((recording / "recording.json").read_text())
    (fixed / "recording.json").write_text(json.dumps(header | {"source": {"protocol": "fixed_camera"}}))
    assert all("fixed" in words[words.index("--camera") + 1] for words in commands(fixed))
    # One camera that moves is enough.
    assert all("--camera" not in words for words in commands(fixed, recording))


def test_a_start_from_other_weights_is_the_same_function():
    torch.manual_seed(0)
    layers = context_mask_layers()
    trained, fresh = Network(layers, MASK_INPUT).eval(), Network(layers, MASK_INPUT, normalise=True)
    images = torch.rand(2, 3, 212, 256)
    assert not torch.allclose(fresh.eval()(images), trained(images), atol=1e-3)
    start_from(fresh, trained.state_dict(), images)
    assert torch.allclose(fresh.eval()(images), trained(images), atol=1e-4)
    with pytest.raises(SystemExit, match="conv1.weight"):
        start_from(fresh, Network(paper_mask_layers(), MASK_INPUT).state_dict(), images)
