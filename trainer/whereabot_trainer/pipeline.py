"""From recordings to model files in one command: the steps that the other commands do, one after the other.

Each step is a command of its own (printed before it runs) with a run's folder of its own, so that an interrupted
pipeline, called again, goes on where it stopped.
"""

import shlex
from pathlib import Path

from . import data

# Shares of the time. The mask network is the largest one, the coarse network, the context family's, the smallest, and what the mask
# network then sees through its camera takes the least learning; what robots have in common is most of what there is to learn.
MASK, COARSE, CLOSER, COMMON = 0.25, 0.1, 0.1, 0.6
JOINT = 1 - MASK - COARSE - CLOSER
VALIDATION_SAMPLES = 100


def steps(args):
    """The commands, as lists of words, for recordings of one robot or of several."""
    data.refuse_common(args.recording, args.validation)
    by_robot, fixed = {}, True
    for folder in args.recording:
        header = data.read_header(folder)
        by_robot.setdefault(header["robot"], ([], []))[0].append(folder)
        fixed &= header["source"].get("protocol") == "fixed_camera"
    camera = ["--camera", "fixed"] if fixed else []
    for folder in args.validation or []:
        robot = data.read_header(folder)["robot"]
        if robot not in by_robot:
            raise SystemExit(f"--validation: {folder} is of {robot}, of which there is no --recording")
        by_robot[robot][1].append(folder)
    without = sorted(robot for robot, (_, held_out) in by_robot.items() if not held_out)
    if args.validation and without:
        # The common networks would see the fifth of theirs that is kept for testing.
        raise SystemExit(f"--validation: expected recordings of all robots, found none of {', '.join(without)}")
    out, commands = Path(args.out), []

    def recordings(robots):
        words = ["--recording", *(folder for robot in robots for folder in by_robot[robot][0])]
        return [*words, *validation(robots)]

    def validation(robots):
        held_out = [folder for robot in robots for folder in by_robot[robot][1]]
        if not held_out:
            return []
        # What export reports on is not what it chooses on.
        half = sum(len(data.read_samples(folder)) for folder in held_out) // 2
        # What robots share is chosen on samples of all of them, the kinematic fit on each one's own.
        count = max(1, min(VALIDATION_SAMPLES * len(robots), half))
        return ["--validation", *held_out, "--validation-samples", str(count)]

    def step(command, run, robots, minutes, *flags):
        resume = ["--resume"] if (out / run / "last.pt").exists() else []
        commands.append([command, "--family", args.family, *recordings(robots), "--out", str(out / run), "--minutes",
                         f"{minutes:.4g}", "--cache", args.cache, "--seed", str(args.seed), *camera, *flags, *resume])

    context = args.family == "context"

    def masks(suffix, robots, minutes):
        negatives = ["--negatives", *args.negatives] if args.negatives else []
        if not context:
            step("train-mask", f"mask{suffix}", robots, (MASK + COARSE + CLOSER) * minutes, "--crop", "192", "160", *negatives)
            return
        step("train-mask", f"mask{suffix}", robots, MASK * minutes, "--crop", "224", "184", "--zoom", "0.4", "2.0", *negatives)
        # What it sees is not turned: whole images, nearly.
        step("train-mask", f"coarse{suffix}", robots, COARSE * minutes, "--coarse", "--init-from", str(out / f"mask{suffix}"),
             "--crop", "224", "184", "--zoom", "0.5", "1.8", *negatives)
        step("train-mask", f"closer{suffix}", robots, CLOSER * minutes, "--coarse-run", str(out / f"coarse{suffix}"), "--init-from",
             str(out / f"mask{suffix}"), "--learning-rate", "1.5e-4", "2e-6", "--no-normalise", *negatives)

    def seen_by(suffix):
        return str(out / f"{'closer' if context else 'mask'}{suffix}")

    def joint(run, suffix, robots, minutes, *flags):
        coarse = ["--coarse-run", str(out / f"coarse{suffix}")] if context else []
        step("train-joint", run, robots, minutes, "--mask-run", seen_by(suffix), *coarse, "--estimated-masks", "0.5",
             *flags)

    robots = list(by_robot)
    shared = context and len(robots) > 1
    if shared:
        # The arms look alike but for their size, which the network's unit takes out.
        masks("", robots, args.minutes)
        joint("joint", "", robots, JOINT * COMMON * args.minutes)
        for robot in robots:
            joint(f"joint-{robot}", "", [robot], JOINT * (1 - COMMON) * args.minutes / len(robots),
                  "--init-from", str(out / "joint"), "--learning-rate", "5e-4", "2e-5")
    else:
        for robot in robots:
            masks(f"-{robot}", [robot], args.minutes / len(robots))
            joint(f"joint-{robot}", f"-{robot}", [robot], JOINT * args.minutes / len(robots))
    for robot in robots:
        suffix, of = ("", robots) if shared else (f"-{robot}", [robot])
        source = validation(of) or ["--recording", *by_robot[robot][0]]
        coarse = ["--coarse", str(out / f"coarse{suffix}")] if context else []
        commands.append(["export", "--mask", seen_by(suffix), *coarse, "--joint", str(out / f"joint-{robot}"), *source,
                         "--robot", robot, "--cache", args.cache, "--seed", str(args.seed),
                         "--out", str(out / f"{robot}.safetensors"), "--dtype", args.dtype])
    return commands


def run(args, main):
    """Runs all steps; `main` is the command line's."""
    for words in steps(args):
        print("whereabot_trainer", shlex.join(words), flush=True)
        main(words)
