"""From training runs to a model file: calibration, presence, figures, the card."""

import csv
import json
import math
import os
from pathlib import Path

import numpy as np
import torch

from . import __version__, data, evaluate, kinematic_fit, zoom
from .model import describe, read_model, write_model
from .train import MIN_COVERAGE, kept_arm_lengths, load_coarse, load_network, output_unit

# From fewer samples the errors of six joints cannot be told.
LEAST_LEARNED = 30
SURE_THRESHOLDS = (0.7, 0.8, 0.9, 0.95, 0.97, 0.98)


def choose_presence(robots, without, passing=0.05):
    """When a robot counts as seen: (T, S), at least the share S of pixels having at least the probability T.

    `robots` and `without` give, for each T of SURE_THRESHOLDS, the shares of images with a robot and without one. For
    each T, S lets at most the share `passing` of the images without a robot pass; of these pairs, it is the one that
    lets the most robots pass and, where several do, the one whose S robots pass by most, but for one in a hundred.
    """
    choices = []
    for threshold in SURE_THRESHOLDS:
        shares = np.sort(without[threshold])[::-1]
        highest = shares[int(passing * len(shares))] if len(shares) else 0.0
        # Below a thousandth of the image (54 pixels) nothing can be said about a robot's joints.
        least = max(0.001, math.ceil(highest * 1e4 + 0.5) / 1e4)
        seen = np.asarray(robots[threshold])
        margin = float(np.quantile(seen, 0.01)) / least if len(seen) else 0.0
        choices.append((float((seen >= least).mean()), margin, threshold, least))
    *_, threshold, least = max(choices)
    return threshold, least


def _model_file(paths):
    """The model file that is given in place of runs; None where runs are."""
    if len(paths) > 1 or Path(paths[0]).is_dir():
        return None
    if not Path(paths[0]).exists():
        raise SystemExit(f"expected the folder of a run or a model file, found {paths[0]}")
    return paths[0]


def _trained_on(paths):
    """The recordings that the runs among `paths` were trained on; of model files, only names are known."""
    settings = [Path(path) / "settings.json" for path in paths if path]
    return [folder for file in settings if file.exists() for folder in json.loads(file.read_text())["recording"]]


def _mean_of(runs, masks_of=None):
    """(the network whose weights are the mean of the `runs`', the last one's checkpoint, what the card says of the mean). Of
    runs of which one started from the other, or all from the same, the mean often errs less than any (Wortsman et al., 2022).
    The mask network that all started from may be among them, as the model file `masks_of`: it counts as one."""
    for run in runs:
        if not Path(run).is_dir():
            raise SystemExit(f"expected the folder of a run, found {run}")
    networks, states = zip(*(load_network(run) for run in runs), strict=True)
    kinds = [[state["layers"], state["card"].get("mean"), state["card"].get("deviation")] for state in states]
    of = [{"run": Path(run).name, "minutes": round(state["seconds"] / 60, 1), "iterations": state["iteration"]}
          for run, state in zip(runs, states, strict=True)]
    if masks_of:
        networks = (read_model(masks_of)[0]["mask"], *networks)
        kinds, of = [[networks[0].layers, None, None], *kinds], [{"file": Path(masks_of).name}, *of]
    if len({json.dumps(kind, sort_keys=True) for kind in kinds}) > 1:
        raise SystemExit(f"expected runs of one network in one unit, found {' and '.join([*filter(None, [masks_of]), *runs])}")
    network, others = networks[-1], [each.state_dict() for each in networks]
    network.load_state_dict({key: torch.stack([other[key] for other in others]).mean(0) for key in others[0]})
    return network, states[-1], {"mean_of": of} if len(of) > 1 else {}


def export_runs(args):
    """Folds calibration and standardisation into the weights, measures the cascade, and writes the model file."""
    data.refuse_common(_trained_on([*args.mask, *args.joint, args.coarse]), args.validation)
    mask_file, joint_file = _model_file(args.mask), _model_file(args.joint)
    kept, kept_description = read_model(mask_file) if mask_file else ({}, {})
    if mask_file:
        mask, mask_mean = kept["mask"], {}
    else:
        started, runs = (None, args.mask) if Path(args.mask[0]).is_dir() else (args.mask[0], args.mask[1:])
        mask, _, mask_mean = _mean_of(runs, started)
    joint, joint_state, joint_mean = _mean_of(args.joint) if not joint_file else (read_model(joint_file)[0]["joint"], None, {})
    coarse = load_coarse(args.coarse) if args.coarse else kept.get("coarse")
    coarse_card = _coarse_card(args.coarse or mask_file) if coarse else {}
    mask_card, joint_card = _mask_card(args.mask[-1]), _joint_card(args.joint[-1])
    family, rules = mask_card["mask_training"]["family"], (joint_card["overlay"], joint_card["zoom"])

    samples = data.Samples(args.validation or args.recording, args.cache, joint_card["arm_lengths"])
    robots = sorted(set(samples.robots))
    robot = args.robot or robots[0]
    if robot not in robots or (len(robots) > 1 and not args.robot):
        raise SystemExit(f"--robot: expected one of {', '.join(robots)}, found {args.robot or 'none'}")
    own = samples.robots == robot
    arm = float(samples.arms[own][0])
    if not joint_file:
        output_unit(joint_state["card"]).fold(joint, arm)
    elif robot not in joint_card["arm_lengths"]:
        raise SystemExit(f"--joint: {joint_file} is of {', '.join(joint_card['arm_lengths'])}, not of {robot}")
    # What the mask's threshold and presence are chosen on is not reported on. How many images without a robot pass is
    # seen on all robots' recordings: one has few such images.
    if args.validation:
        order = np.random.default_rng(args.seed).permutation(len(samples))
        chosen, reported = order[: args.validation_samples], np.sort(order[args.validation_samples :])
        reported = reported[own[reported]]
        if not len(reported):
            raise SystemExit(f"expected more than {args.validation_samples} samples to validate on, found {len(samples)}:"
                             " give more, or a smaller --validation-samples")
    else:
        training, reported = data.split(samples)
        reported = reported[own[reported]]
        chosen = np.random.default_rng(args.seed).permutation(training)[: args.validation_samples]
    order = np.union1d(chosen, reported)

    if not mask_file:
        shift = evaluate.calibrate(mask, samples, chosen[own[chosen]], args.device, coarse)
        evaluate.shift_logits(mask, shift)
        mask_card["calibration"]["logit_shift"] = shift
    estimated = evaluate.estimate_masks(mask, samples, order, args.device, coarse)
    seen = samples.has_robot & (samples.coverage >= joint_card["min_coverage"])
    empty = samples.coverage == 0

    def shares(numbers, threshold):
        return [float((estimated[n] >= 255 * threshold).mean()) for n in numbers]

    if kept and not args.coarse:
        # It is the masks', which stay.
        sure, least = (kept_description["presence"][key] for key in ("sure_threshold", "min_sure"))
    else:
        sure, least = choose_presence(*(
            {threshold: shares(chosen[kind[chosen]], threshold) for threshold in SURE_THRESHOLDS}
            for kind in (seen & own, empty)))

    # How the joint network errs is measured where presence is chosen, on this robot.
    learned = chosen[own[chosen] & seen[chosen]]
    fitted_arm, unfitted = None, ""
    if args.no_fit:
        unfitted = "--no-fit"
    elif len(learned) < LEAST_LEARNED:
        unfitted = (f"{len(learned)} of {LEAST_LEARNED} samples with a {robot} among the {len(chosen)} chosen on:"
                    " give more, or a larger --validation-samples")
    else:
        estimates = evaluate.estimate_joints(
            joint, evaluate.identity_metres, samples, learned, estimated, rules, args.device)
        fitted_arm = kinematic_fit.arm_of(estimates.numpy(), samples.joints[learned])
        if fitted_arm is None:
            unfitted = "joints are not those of an arm of Universal Robots' kind"

    shown = reported[seen[reported]]
    measured = evaluate.score_mask(mask, samples, reported, args.device, coarse=coarse)
    figures = {name: measured[name] for name in ("accuracy", "iou", "precision", "recall")}
    for name, masks in (("true_mask", None), ("estimated_mask", estimated)):
        figures |= evaluate.score_joints(
            joint, evaluate.identity_metres, samples, shown, masks, rules, args.device, name, fitted_arm)
    found = shown[np.asarray(shares(shown, sure)) >= least]
    if len(found):
        figures |= evaluate.score_joints(
            joint, evaluate.identity_metres, samples, found, estimated, rules, args.device, "found_estimated_mask", fitted_arm)
    figures["presence"] = {}
    for part, numbers in (("chosen", chosen), ("reported", reported)):
        figures["presence"] |= {
            f"{part}_robots_found": _rate(value >= least for value in shares(numbers[(seen & own)[numbers]], sure)),
            f"{part}_without_robot_rejected": _rate(value < least for value in shares(numbers[empty[numbers]], sure))}
    figures["samples"] = {"chosen_on": len(chosen), "reported_on": len(reported), "with_robot": len(shown)}

    card = {
        "task": "mask and joints (metres, camera optical frame) of one robot arm in one colour image",
        "data": {"training": joint_card["training"], "validation": samples.sources, "protocol": joint_card["protocol"],
                 "note": args.note},
        "arm_length_m": arm, "fit": fitted_arm is not None, **coarse_card,
        "mask_training": mask_card["mask_training"] | mask_mean, "joint_training": joint_card["joint_training"] | joint_mean,
        "calibration": mask_card["calibration"], "figures": figures,
        "curves": {"mask_accuracy": mask_card["curves"]["mask_accuracy"], **joint_card["curves"]},
        "trainer": f"whereabot-trainer {__version__}, torch {torch.__version__.split('+')[0]}",
        "licence": args.licence,
    }
    networks = {**({"coarse": coarse} if coarse else {}), "mask": mask, "joint": joint}
    description = describe(
        {name: network.layers for name, network in networks.items()}, family=family, robot=robot, overlay=rules[0],
        mask_zoom=zoom.MASK_ZOOM, zoom=rules[1], arm=fitted_arm, presence={"mask_threshold": 0.5, "sure_threshold": sure, "min_sure": least}, card=card)
    write_model(args.out, networks, description, args.dtype)
    print(json.dumps({"chosen": description["presence"], "figures": figures}, indent=1))
    if unfitted:
        print(f"no kinematic fit: {unfitted}")
    print(f"{args.out}: {os.path.getsize(args.out) / 1e6:.2f} MB")


def _rate(hits):
    hits = list(hits)
    return f"{sum(hits)} of {len(hits)}"


MASK_CURVES = {"accuracy": "mask_accuracy"}
JOINT_CURVES = {"true_mask_mean_cm": "true_mask_cm", "estimated_mask_mean_cm": "estimated_mask_cm"}


def _coarse_card(path):
    """What the card says of the coarse network of a run's folder or, as it stands there, of a model file; {} where there is none."""
    if not Path(path).is_dir():
        return {key: value for key, value in read_model(path)[1]["card"].items() if key == "coarse_training"}
    state = load_network(path)[1]
    return {"coarse_training": _training(state) | {"logit_shift": state["figures"]["logit_shift"]}}


def _mask_card(path):
    """What the card says of the mask network of a run's folder or, as it stands there, of a model file."""
    if not Path(path).is_dir():
        return read_model(path)[1]["card"]
    state = load_network(path)[1]
    return {
        "mask_training": _training(state), "curves": _curves(path, MASK_CURVES),
        "calibration": {"logit_shift": state["figures"]["logit_shift"], "why": "inverse class weights bias the mask towards the"
                        " robot; the shift that gives the best validation IoU at 0.5 is added to the last bias"},
    }


def _joint_card(path):
    """What there is to know of the joint network of a run's folder or, as it stands there, of a model file."""
    if not Path(path).is_dir():
        description = read_model(path)[1]
        card = description["card"]
        return {
            "overlay": description["overlay"], "zoom": description.get("zoom"),
            "arm_lengths": {description["robot"]: card["arm_length_m"]},
            "min_coverage": card["joint_training"].get("min_coverage", MIN_COVERAGE),
            "training": card["data"]["training"], "protocol": card["data"]["protocol"],
            "joint_training": card["joint_training"],
            "curves": {name: curve for name, curve in card["curves"].items() if name in JOINT_CURVES.values()}}
    state = load_network(path)[1]
    card = state["card"]
    return {
        "overlay": card["overlay"], "zoom": card.get("zoom"), "arm_lengths": kept_arm_lengths(state),
        "min_coverage": card["min_coverage"], "training": card["training_recordings"], "protocol": card["protocol"],
        "joint_training": _training(state), "curves": _curves(path, JOINT_CURVES)}


def _curves(run, columns):
    """Validation figures over iterations (the paper's three plots), as lists of [iteration, value]."""
    with open(Path(run) / "log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [[int(row["iteration"]), float(row[column])] for row in rows]
            for column, name in columns.items() if rows and column in rows[0]}


def _training(state):
    keep = ("family", "protocol", "seed", "precision", "optimizer", "learning_rate", "momentum", "batch", "normalise",
            "samples", "crop", "zoom", "coarse_run", "negatives", "negative_share", "foreground_share", "w_fg", "w_bg",
            "min_coverage", "estimated_masks", "estimated_after", "init_from", "heat_weight")
    return {key: state["card"][key] for key in keep if key in state["card"]} | {
        "minutes": round(state["seconds"] / 60, 1), "iterations": state["iteration"],
        "samples_available": sum(source["samples"] for source in state["card"]["training_recordings"])}
