"""The model file: both networks' tensors and, in the metadata key `whereabot`, the JSON that describes them."""

import json
import math
import os
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from . import __version__, data, evaluate, photos
from .networks import CAMERA, INPUT_HEIGHT, INPUT_WIDTH, JOINT_INPUT, JOINTS, MASK_INPUT, Network
from .train import load_network, output_unit

DTYPES = {"f32": torch.float32, "f16": torch.float16}


def describe(mask_layers, joint_layers, *, family, robot, overlay, presence, card,
             width=INPUT_WIDTH, height=INPUT_HEIGHT, camera=CAMERA):
    """The description that the engine reads from the model file."""
    return {
        "version": 1, "family": family, "robot": robot, "joints": JOINTS,
        "input": {"width": width, "height": height}, "camera": camera,
        "mask_network": {"layers": mask_layers}, "overlay": overlay,
        "joint_network": {"layers": joint_layers}, "presence": presence, "card": card,
    }


def write_model(path, mask, joint, description, dtype="f32"):
    """Writes both networks and their description as one safetensors file."""
    tensors = {}
    for prefix, network in (("mask", mask), ("joint", joint)):
        for key, tensor in network.state_dict().items():
            tensor = tensor.detach().cpu().to(DTYPES[dtype])
            if not torch.isfinite(tensor).all():
                raise ValueError(f"{prefix}.{key} is not finite in {dtype}")
            tensors[f"{prefix}.{key}"] = tensor.contiguous(memory_format=torch.contiguous_format)
    # A reader must never see half a file: write beside it, then rename.
    partial = f"{path}.partial"
    save_file(tensors, partial, metadata={"whereabot": json.dumps(description)})
    os.replace(partial, path)


def read_model(path):
    """(mask network, joint network, description) of a model file; weights in f32."""
    with safe_open(path, framework="pt") as file:
        description = json.loads(file.metadata()["whereabot"])
        tensors = {key: file.get_tensor(key).float() for key in file.keys()}
    shape = (3, description["input"]["height"], description["input"]["width"])
    networks = []
    for prefix, source in (("mask", MASK_INPUT), ("joint", JOINT_INPUT)):
        network = Network(description[f"{prefix}_network"]["layers"], source, shape)
        network.load_state_dict({
            key.removeprefix(f"{prefix}."): tensor for key, tensor in tensors.items() if key.startswith(f"{prefix}.")})
        networks.append(network.eval())
    return *networks, description


# --- from training runs to a model file ------------------------------------------------------------------------------

SURE_THRESHOLDS = (0.7, 0.8, 0.9, 0.95)


def choose_presence(robots, without, passing=0.05):
    """When a robot counts as seen: (T, S), at least the share S of pixels having at least the probability T.

    `robots` and `without` give, for each T of SURE_THRESHOLDS, the shares of images with a robot and without one. For
    each T, S lets at most the share `passing` of the images without a robot pass; of these pairs, it is the one that
    lets the most robots pass.
    """
    choices = []
    for threshold in SURE_THRESHOLDS:
        shares = np.sort(without[threshold])[::-1]
        highest = shares[int(passing * len(shares))] if len(shares) else 0.0
        # Below a thousandth of the image (54 pixels) nothing can be said about a robot's joints.
        least = max(0.001, math.ceil(highest * 1e4 + 0.5) / 1e4)
        choices.append((float((np.asarray(robots[threshold]) >= least).mean()), threshold, least))
    _, threshold, least = max(choices)
    return threshold, least


def export_runs(args):
    """Folds calibration and standardisation into the weights, measures the cascade, and writes the model file."""
    mask, mask_state = load_network(args.mask)
    joint, joint_state = load_network(args.joint)
    shift = mask_state["figures"]["logit_shift"]
    evaluate.shift_logits(mask, shift)
    rule = joint_state["card"]["overlay"]

    samples = data.Samples(args.validation, args.cache)
    output_unit(joint_state["card"]).fold(joint, float(samples.arms[0]))
    # The first part chose the checkpoints and chooses the presence threshold; the rest is what the figures are about.
    order = np.random.default_rng(args.seed).permutation(len(samples))
    chosen, reported = order[: args.validation_samples], np.sort(order[args.validation_samples :])
    if len(reported) < args.validation_samples:
        chosen = reported = np.arange(len(samples))

    estimated = evaluate.estimate_masks(mask, samples, order, args.device)
    seen = samples.has_robot & (samples.coverage >= joint_state["card"]["min_coverage"])
    empty = samples.coverage == 0

    def shares(numbers, threshold):
        return [float((estimated[n] >= 255 * threshold).mean()) for n in numbers]

    sure, least = choose_presence(*(
        {threshold: shares(chosen[kind[chosen]], threshold) for threshold in SURE_THRESHOLDS}
        for kind in (seen, empty)))

    robots = reported[seen[reported]]
    measured = evaluate.score_mask(mask, samples, reported, args.device)
    figures = {name: measured[name] for name in ("accuracy", "iou", "precision", "recall")}
    for name, masks in (("true_mask", None), ("estimated_mask", estimated)):
        figures |= evaluate.score_joints(
            joint, evaluate.identity_metres, samples, robots, masks, rule, args.device, name)
    found = robots[np.asarray(shares(robots, sure)) >= least]
    if len(found):
        figures |= evaluate.score_joints(
            joint, evaluate.identity_metres, samples, found, estimated, rule, args.device, "found_estimated_mask")
    figures["presence"] = {}
    for part, numbers in (("chosen", chosen), ("reported", reported)):
        figures["presence"] |= {
            f"{part}_robots_found": _rate(value >= least for value in shares(numbers[seen[numbers]], sure)),
            f"{part}_without_robot_rejected": _rate(value < least for value in shares(numbers[empty[numbers]], sure))}
    for folder in args.photos_without:
        values = photos.coverages(mask, folder, sure).values()
        figures["presence"][f"photos_{Path(folder).name}_rejected"] = _rate(value < least for value in values)
    figures["samples"] = {"chosen_on": len(chosen), "reported_on": len(reported), "with_robot": len(robots)}
    if args.photos:
        scores = photos.score_annotated(mask, args.photos, args.annotations)
        figures["photos"] = {"mean_iou": round(float(np.mean(list(scores.values()))), 3),
                             "median_iou": round(float(np.median(list(scores.values()))), 3), "count": len(scores)}
        values = photos.coverages(mask, args.photos, sure)
        figures["photos"]["found"] = _rate(values[name] >= least for name in scores)
        print(json.dumps(scores, indent=1))

    card = {
        "task": "mask and joints (metres, camera optical frame) of one robot arm in one colour image",
        "data": {"training": joint_state["card"]["training_recordings"], "validation": samples.sources,
                 "note": args.note},
        "mask_training": _training(mask_state), "joint_training": _training(joint_state),
        "calibration": {"logit_shift": shift, "why": "inverse class weights bias the mask towards the robot; the shift"
                        " that gives the best validation IoU at 0.5 is added to the last bias"},
        "figures": figures, "trainer": f"whereabot-trainer {__version__}, torch {torch.__version__.split('+')[0]}",
        "licence": args.licence,
    }
    description = describe(
        mask.layers, joint.layers, family=mask_state["card"]["family"], robot=args.robot, overlay=rule,
        presence={"mask_threshold": 0.5, "sure_threshold": sure, "min_sure": least}, card=card)
    write_model(args.out, mask, joint, description, args.dtype)
    print(json.dumps({"chosen": description["presence"], "figures": figures}, indent=1))
    print(f"{args.out}: {os.path.getsize(args.out) / 1e6:.2f} MB")


def _rate(hits):
    hits = list(hits)
    return f"{sum(hits)} of {len(hits)}"


def _training(state):
    keep = ("family", "protocol", "seed", "precision", "optimizer", "learning_rate", "momentum", "batch", "normalise",
            "samples", "crop", "zoom", "negatives", "negative_share", "foreground_share", "w_fg", "w_bg",
            "estimated_masks", "estimated_after")
    return {key: state["card"][key] for key in keep if key in state["card"]} | {
        "minutes": round(state["seconds"] / 60, 1), "iterations": state["iteration"],
        "samples_available": sum(source["samples"] for source in state["card"]["training_recordings"])}
