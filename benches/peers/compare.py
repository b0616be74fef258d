"""Times whereabot and other engines side by side on this machine: the same pictures, the same networks, in rounds.

Each engine first answers all pictures. Its answers are compared with ONNX Runtime's; one that answers something else is
called wrong and not timed. The table goes to stdout, everything else to stderr.
"""

import argparse
import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import select
import statistics
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import onnx
from PIL import Image
from tqdm import tqdm

import export

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", REPOSITORY / "target"))

OURS, REFERENCE, TRUTH = "whereabot", "whereabot --adapter cpu", "onnxruntime"
LINES = {
    OURS: "whereabot", REFERENCE: "whereabot, plain Rust", TRUTH: "ONNX Runtime CPU", "openvino": "OpenVINO CPU",
    "openvino-bf16": "OpenVINO CPU, bf16", "ncnn": "ncnn CPU", "ncnn-vulkan": "ncnn Vulkan", "tract": "tract CPU",
    "burn": "burn wgpu", "torch": "PyTorch CPU", "torch-cuda": "PyTorch CUDA", "torch-cuda-f16": "PyTorch CUDA, f16",
    "torch-cuda-compile": "PyTorch CUDA, f16, compiled", "torch-cuda-graph": "PyTorch CUDA, f16, graph",
}
TORCH = [name for name in LINES if name.startswith("torch")]
HALF = {"openvino-bf16", *TORCH[2:]}
PROGRAMS = {"tract": "whereabot-peer-tract", "burn": "whereabot-peer-burn"}

# How far answers may be from ONNX Runtime's: of a mask's probabilities the largest difference, of thresholded masks the
# smallest IoU, of joints the largest distance.
LIMITS = {"mask": 1e-3, "iou": 0.999, "joints_mm": 5.0}
# In halves, where the joints are seen through a mask that may differ in some pixels.
HALF_LIMITS = {"mask": 0.1, "iou": 0.99, "joints_mm": 5.0}
# Our mask comes as a picture of 0 to 255.
OURS_LIMITS = LIMITS | {"mask": LIMITS["mask"] + 0.5 / 255}

# The first answer may wait for a compiler, and one that tunes itself.
PATIENCE_S = 300


class Failed(Exception):
    """An engine that cannot be had, does not start or breaks; its text is for the table."""


class Case:
    """A model, its pictures as every engine wants them, and how its answers are judged."""

    def __init__(self, weights, images, folder):
        folder.mkdir(parents=True, exist_ok=True)
        self.weights, self.folder = folder / weights.name, folder
        export.networks_alone(weights, self.weights)
        self.onnx = folder / "cascade.onnx"
        self.description = export.export(self.weights, self.onnx)
        size = self.description["input"]
        self.width, self.height = size["width"], size["height"]
        self.joints = len(self.description["joints"])
        # As pictures of the canonical camera: our own rectification then changes nothing.
        self.pngs = []
        for number, image in enumerate(images):
            self.pngs.append(folder / f"{number:02}.png")
            Image.open(image).convert("RGB").resize((self.width, self.height), Image.Resampling.BOX).save(self.pngs[-1])
        values = np.stack([np.asarray(Image.open(png)) for png in self.pngs]).transpose(0, 3, 1, 2)
        self.values = np.ascontiguousarray(values / np.float32(255), "<f4")
        self.pictures = folder / "pictures.f32"
        self.values.tofile(self.pictures)
        camera = self.description["camera"]
        self.camera = folder / "camera_info.yaml"
        self.camera.write_text(
            f"image_width: {self.width}\nimage_height: {self.height}\ndistortion_model: plumb_bob\ncamera_matrix: "
            f"[{camera['fx']}, 0, {camera['cx']}, 0, {camera['fy']}, {camera['cy']}, 0, 0, 1]\n")

    def answers(self, path):
        """(masks, joints) that a worker wrote."""
        pixels = self.height * self.width
        found = np.fromfile(path, "<f4")
        if found.size != len(self.pngs) * (pixels + 3 * self.joints):
            raise Failed("answers of another size")
        found = found.reshape(len(self.pngs), -1)
        return (found[:, :pixels].reshape(-1, self.height, self.width), found[:, pixels:].reshape(-1, self.joints, 3))

    def judge(self, answers, truth, limits):
        """How far answers are from the true ones over all pictures, and whether that is `right`. Joints count where the
        true mask shows a robot: elsewhere nobody is told any. Nor are they where one is behind the camera: whereabot calls
        that invalid, and its answer is NaN.
        """
        (masks, joints), (true_masks, true_joints) = answers, truth
        presence = self.description["presence"]
        robots, true_robots = masks >= presence["mask_threshold"], true_masks >= presence["mask_threshold"]
        found = (true_masks >= presence["sure_threshold"]).mean((1, 2)) >= presence["min_sure"]
        found &= ~(np.isnan(joints).all((1, 2)) & (true_joints[:, :, 2] <= 0).any(1))
        distances = np.linalg.norm(joints[found] - true_joints[found], axis=2) * 1e3
        # What is not a number is infinitely far off. Without a robot in any picture, joints would go unseen: so far off too.
        off = {"mask": np.abs(masks - true_masks).max(), "joints_mm": distances.max(initial=0) if found.any() else np.inf}
        off = {key: float(value) if np.isfinite(value) else None for key, value in off.items()}
        iou = float((robots & true_robots).sum() / max((robots | true_robots).sum(), 1))
        right = iou >= limits["iou"] and all(value is not None and value <= limits[key] for key, value in off.items())
        return off | {"iou": iou, "robots": int(found.sum()), "right": right}


def whereabot(program, case, adapter, *options):
    """The lines that `whereabot locate` says of all pictures, and the ms until it said the first."""
    command = [program, "locate", *case.pngs * options[0], "--weights", case.weights, "--camera", case.camera, "--json",
               *(["--adapter", adapter] if adapter else []), *options[1:]]
    clock = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        lines = [process.stdout.readline()]
        first_ms = (time.perf_counter() - clock) * 1e3
        lines += process.stdout.readlines()
        errors = process.stderr.read().strip()
    if process.returncode:
        raise Failed(errors.splitlines()[-1] if errors else f"exit code {process.returncode}")
    return [json.loads(line) for line in lines], first_ms


class Ours:
    """`whereabot locate`: each turn is a process of its own, whose first frames are not timed. A time is of an image in
    memory until its answer, rectification, upload and readback included.
    """

    WARM_UP = 3

    def __init__(self, program, case, adapter):
        self.program, self.case, self.adapter = program, case, adapter
        out = case.folder / f"whereabot-{adapter or 'best'}"
        for old in out.glob("*.png"):
            old.unlink()
        _, self.first_ms = whereabot(program, case, adapter, 1)
        lines, _ = whereabot(program, case, adapter, 1, "--out", out, "--soft-mask")
        self.device, self.ms = lines[0]["adapter"], lines[-1]["ms"]["locate"]
        masks = [np.asarray(Image.open(out / f"{png.stem}.mask.png"), np.float32) / 255 for png in case.pngs]
        absent = np.full((case.joints, 3), np.nan)
        joints = [np.array([joint["xyz_m"] for joint in line["joints"]]) if line["status"] == "found" else absent
                  for line in lines]
        self.answers = np.stack(masks), np.stack(joints)

    def turn(self, frames):
        lines, _ = whereabot(self.program, self.case, self.adapter, -(-(frames + self.WARM_UP) // len(self.case.pngs)))
        return [line["ms"]["locate"] for line in lines[self.WARM_UP:][:frames]]

    def stop(self):
        pass


class Worker:
    """An engine in a process of its own, which waits between its turns."""

    def __init__(self, command, case, name, environment):
        self.log = case.folder / f"{name}.log"
        answers = case.folder / f"{name}.f32"
        answers.unlink(missing_ok=True)
        clock = time.perf_counter()
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, bufsize=0,
                env=os.environ | environment)
        try:
            self.device = self.read()["device"]
            self.first_ms = (time.perf_counter() - clock) * 1e3
            self.ms = self.read()["ms"]
            self.answers = case.answers(answers)
        except BaseException:
            self.stop()
            raise

    def read(self):
        """The next line of the worker's own; libraries print others."""
        end = time.monotonic() + PATIENCE_S
        while True:
            ready, _, _ = select.select([self.process.stdout], [], [], max(end - time.monotonic(), 0))
            if not ready:
                raise Failed(f"no answer in {PATIENCE_S} s")
            line = self.process.stdout.readline()
            if not line:
                self.process.wait()
                said = self.log.read_text(errors="replace").strip().splitlines() or ["nothing"]
                raise Failed(f"exit code {self.process.returncode}: {said[-1]}")
            if line.startswith(b"> "):
                return json.loads(line[2:])

    def turn(self, frames):
        try:
            self.process.stdin.write(f"{frames}\n".encode())
        except BrokenPipeError:
            pass  # What it said last is in its log.
        return self.read()

    def stop(self):
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()


def tail(text):
    """The line that says why cargo failed."""
    lines = text.strip().splitlines()
    errors = [line for line in lines if line.lstrip().lower().startswith(("error", "thread"))]
    return (errors or lines[-1:] or ["it says nothing"])[0]


def cargo(folder):
    result = subprocess.run(
        ["cargo", "build", "--release", "--locked", "--target-dir", TARGET], cwd=folder, stderr=subprocess.PIPE, text=True)
    if result.returncode:
        raise Failed(f"does not build: {tail(result.stderr)}")


def ncnn_model(case):
    """Converts the ONNX file with pnnx, and what pnnx leaves: it knows no comparison."""
    param = case.onnx.with_suffix(".ncnn.param")
    param.unlink(missing_ok=True)
    folder = Path(importlib.util.find_spec("pnnx").submodule_search_locations[0])
    result = subprocess.run([folder / "pnnx", case.onnx.name, "fp16=0"], cwd=case.folder, capture_output=True, text=True)
    if result.returncode or not param.exists():
        raise Failed(f"pnnx: {tail(result.stderr)}")
    rule, text = case.description["overlay"], param.read_text()
    if rule["rule"] == "threshold":
        # A probability is at least t where the whole part of it plus 1 - t is one.
        text = re.sub(r"^torch\.ge(\s.*)$", rf"BinaryOp\1 0=0 1=1 2={1 - rule['threshold']}", text, flags=re.M)
        text = re.sub(r"^Tensor\.to(\s.*)$", r"UnaryOp\1 0=2", text, flags=re.M)
    param.write_text(text)
    return case.onnx.with_suffix(".ncnn")


def start(name, case, args):
    """The engine of that name, ready and with its answers."""
    if name in (OURS, REFERENCE):
        return Ours(args.whereabot, case, args.adapter if name == OURS else "cpu")
    shape = [case.pictures, case.folder / f"{name}.f32", case.height, case.width, args.threads]
    environment = {"OMP_NUM_THREADS": str(args.threads)}
    if name in PROGRAMS:
        cargo(HERE / name)
        model = case.weights if name == "burn" else case.onnx
        return Worker([TARGET / "release" / PROGRAMS[name], *shape, model], case, name, environment)
    python, model = sys.executable, case.onnx
    if name in TORCH:
        python, model = args.torch, case.weights
    elif name.startswith("ncnn"):
        model = ncnn_model(case)
    return Worker([python, HERE / "worker.py", name, *shape, model], case, name, environment)


def version(name, args):
    if name in (OURS, REFERENCE):
        return subprocess.run([args.whereabot, "--version"], capture_output=True, text=True, check=True).stdout.split()[-1]
    if name in PROGRAMS:
        crate = {"tract": "tract-onnx"}.get(name, name)
        packages = tomllib.loads((HERE / name / "Cargo.lock").read_text())["package"]
        return next(package["version"] for package in packages if package["name"] == crate)
    if name in TORCH:
        return subprocess.run([args.torch, "-c", "import torch; print(torch.__version__)"], capture_output=True,
                              text=True, check=True).stdout.strip()
    return importlib.metadata.version(name.split("-")[0])


def broken(case, truth):
    """Whether the comparison notices a model with one wrong bias, in either network."""
    import onnxruntime

    description, tensors = export.read_model(case.weights)
    noticed = []
    for network, part in (("mask", slice(0, 1)), ("joint", slice(1, 2))):
        last = [layer["name"] for layer in description[f"{network}_network"]["layers"]
                if f"{network}.{layer['name']}.bias" in tensors][-1]
        bias = tensors[f"{network}.{last}.bias"].copy()
        bias[0] += {"mask": 0.1, "joint": 0.01}[network]
        model = export.cascade(description, tensors | {f"{network}.{last}.bias": bias})
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        found = [session.run(["mask", "joints"], {"image": picture[None]}) for picture in case.values]
        answers = [np.concatenate([mask[0] for mask, _ in found]), np.concatenate([joints for _, joints in found])]
        # The other network's answers as they should be: this one's alone must be noticed.
        answers[1 - part.start] = truth[1 - part.start]
        noticed.append(not case.judge(answers, truth, OURS_LIMITS)["right"])
    return all(noticed)


def compare(case, names, args):
    """Starts, judges and times the engines; a dict an engine, as in the JSON."""
    found = {name: {"name": name, "line": LINES[name]} for name in names}
    running = {}
    with contextlib.ExitStack() as stack:
        for name in tqdm(names, "starting", disable=None):
            tqdm.write(f"{case.weights.name}: {LINES[name]}", sys.stderr)
            try:
                engine = start(name, case, args)
            except (Failed, OSError, subprocess.SubprocessError) as error:
                found[name]["failed"] = str(error)
                if name == TRUTH:
                    raise
                continue
            stack.callback(engine.stop)
            running[name] = engine
            limits = HALF_LIMITS if name in HALF else OURS_LIMITS if isinstance(engine, Ours) else LIMITS
            found[name] |= {"version": version(name, args), "device": engine.device, "first_ms": engine.first_ms,
                            "answers": case.judge(engine.answers, running[TRUTH].answers, limits), "rounds_ms": []}
            if not found[name]["answers"]["right"]:
                running.pop(name).stop()
        if not broken(case, running[TRUTH].answers):
            raise Failed("a broken model was not noticed: the comparison is worth nothing")
        if args.check:
            return list(found.values())

        turns = [name for _ in range(args.rounds) for name in running]
        for name in (bar := tqdm(turns, "timing", disable=None)):
            if name not in running:
                continue
            bar.set_postfix_str(LINES[name])
            # Threads of the one before may still spin.
            time.sleep(0.3)
            engine = running[name]
            times = found[name]["rounds_ms"]
            last = statistics.median(times[-1]) if times else engine.ms
            frames = max(3, min(args.frames, int(args.turn_seconds * 1e3 / last)))
            try:
                times.append(engine.turn(frames))
            except Failed as error:
                found[name]["failed"] = str(error)
                del running[name]

    for entry in found.values():
        rounds = entry.get("rounds_ms")
        if not rounds or "failed" in entry:
            continue
        times = [ms for each in rounds for ms in each]
        entry |= {"median_ms": statistics.median(times), "min_ms": min(times)}
        for base in (OURS, TRUTH):
            # Round by round, so that load that comes and goes weighs on both.
            if len(found.get(base, {}).get("rounds_ms", [])) == len(rounds):
                entry[f"to_{base}"] = statistics.median(
                    statistics.median(mine) / statistics.median(others)
                    for mine, others in zip(rounds, found[base]["rounds_ms"]))
    return list(found.values())


def table(entries):
    rows = [["", "version", "ms, median", "min", "x whereabot", "x ONNX Runtime", "first answer, s", "mask off by", "IoU",
             "joints off by, mm"]]
    for entry in entries:
        row = [entry["line"], entry.get("version", "")]
        answers = entry.get("answers")
        if "failed" in entry:
            rows.append([*row, f"failed: {entry['failed']}".replace("|", "/"), *[""] * 7])
            continue
        if not answers["right"]:
            row += ["**wrong**", "", "", ""]
        elif "median_ms" in entry:
            ratios = [entry.get(f"to_{base}") for base in (OURS, TRUTH)]
            row += [f"{entry['median_ms']:.1f}", f"{entry['min_ms']:.1f}"]
            row += ["" if one is None else f"{one:.2f}" for one in ratios]
        else:
            row += [""] * 4
        mask, joints = answers["mask"], answers["joints_mm"]
        rows.append([*row, f"{entry['first_ms'] / 1e3:.1f}", "no number" if mask is None else f"{mask:.1g}",
                     f"{answers['iou']:.4f}", "no number" if joints is None else f"{joints:.2f}"])
    rows.insert(1, ["---", "---", *["--:"] * 8])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def machine(args):
    names = [line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
             if line.startswith("model name")] if Path("/proc/cpuinfo").exists() else []
    return {"cpu": names[0] if names else platform.processor(), "cores": os.cpu_count(), "threads": args.threads,
            "system": platform.platform(), "nice": os.nice(0)}


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", nargs="+", type=Path, default=[REPOSITORY / "weights" / "ur5.safetensors"],
                        metavar="FILE", help="model files (default: weights/ur5.safetensors)")
    parser.add_argument("--images", nargs="+", type=Path, default=sorted((REPOSITORY / "examples/images").glob("*.jpg")),
                        metavar="FILE", help="pictures (default: the bundled ones)")
    parser.add_argument("--engines", nargs="+", choices=LINES, metavar="NAME", help=f"some of: {', '.join(LINES)}")
    parser.add_argument("--whereabot", type=Path, metavar="PROGRAM", help="default: built now")
    parser.add_argument("--adapter", help="the adapter for whereabot (default: its own choice)")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser.add_argument("--threads", type=int, default=cores, help="cores for every engine (default: all)")
    parser.add_argument("--torch", metavar="PYTHON", help="time PyTorch too: a Python that has torch, safetensors and tqdm")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=20, help="frames a turn, at most (default: 20)")
    parser.add_argument("--turn-seconds", type=float, default=4, help="a turn's length, about, if that is less (default: 4)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here (a new file)")
    parser.add_argument("--check", action="store_true",
                        help="time nothing: do ONNX Runtime and whereabot's plain Rust agree?")
    args = parser.parse_args()
    if args.json and args.json.exists():
        parser.error(f"{args.json} exists")
    if min(args.threads, args.rounds, args.frames) < 1 or args.turn_seconds <= 0:
        parser.error("threads, rounds, frames and seconds are positive")
    return args, cores


def main():
    args, cores = arguments()
    if args.threads < cores and hasattr(os, "sched_setaffinity"):
        # A software rasteriser takes all cores there are.
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:args.threads])
    if args.whereabot is None:
        cargo(REPOSITORY)
        args.whereabot = TARGET / "release" / "whereabot"
    args.whereabot = args.whereabot.resolve()
    names = args.engines or [name for name in LINES if name not in TORCH or args.torch]
    if args.torch and not args.engines:
        asked = "import torch; print(torch.cuda.is_available())"
        cuda = subprocess.run([args.torch, "-c", asked], capture_output=True, text=True, check=True).stdout.strip() == "True"
        names = [name for name in names if cuda or "cuda" not in name]
    if args.check:
        names = [TRUTH, REFERENCE]
    # All answers are compared with its.
    names = [TRUTH, *(name for name in names if name != TRUTH)]

    report = {"schema": 1, "machine": machine(args), "models": []}
    right = True
    for weights in args.weights:
        case = Case(weights, args.images, TARGET / "peers" / weights.stem)
        before = os.getloadavg()[0]
        entries = compare(case, names, args)
        entries.sort(key=lambda entry: list(LINES).index(entry["name"]))
        model = {"file": weights.name, "family": case.description["family"], "robot": case.description["robot"],
                 "pictures": len(case.pngs), "load": [before, os.getloadavg()[0]], "engines": entries}
        report["models"].append(model)
        device = next((entry["device"] for entry in entries if entry["name"] == OURS and "device" in entry), None)
        print(f"{weights.name} ({model['family']} family), {args.threads} threads, {report['machine']['cpu']}"
              + (f", whereabot on {device}" if device else "") + "\n")
        print(table(entries) + "\n", flush=True)
        ours = [entry for entry in entries if entry["name"] in (OURS, REFERENCE)]
        right &= all("failed" not in entry and entry["answers"]["right"] for entry in ours)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0 if right else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (Failed, OSError, subprocess.CalledProcessError, onnx.checker.ValidationError) as error:
        sys.exit(f"compare: {error}")
