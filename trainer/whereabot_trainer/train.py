"""The training loop, and the two tasks it runs: the mask network and the joint network, trained separately."""

import csv
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from . import data, evaluate, losses, zoom
from .model import read_model
from .networks import (
    JOINT_INPUT, JOINTS, MASK_INPUT, OVERLAYS, Network, coarse_mask_layers, context_mask_layers, heatmap_joint_layers, overlay,
    paper_joint_layers, paper_mask_layers)


# --- the loop --------------------------------------------------------------------------------------------------------

class Schedule:
    """Learning rate and momentum over the progress (0 to 1) of a run: a cosine from start to end, after a short warm-up
    of the rate; momentum changes linearly. For AdamW, momentum is beta1."""

    WARM_UP = 0.01

    def __init__(self, learning_rate, momentum):
        self.learning_rate, self.momentum = learning_rate, momentum

    def apply(self, optimizer, progress):
        start, end = self.learning_rate
        rate = end + (start - end) * 0.5 * (1 + math.cos(math.pi * progress))
        rate *= min(1, (progress + 1e-3) / self.WARM_UP)
        momentum = self.momentum[0] + (self.momentum[1] - self.momentum[0]) * progress
        for group in optimizer.param_groups:
            group["lr"] = rate * group.get("scale", 1)
            if "betas" in group:
                group["betas"] = (momentum, group["betas"][1])
            else:
                group["momentum"] = momentum
        return rate


class Muon:
    """Muon for the hidden convolutions, AdamW for everything else (Jordan et al., 2024): what Muon adds to a kernel,
    as a matrix [out, all inputs], has equal singular values, so that rare directions are learnt as soon as common ones.
    """

    # Muon's updates are as large as AdamW's at the same rate; it bears larger ones.
    SCALE = 2

    def __init__(self, network, weight_decay):
        hidden = [layer["name"] for layer in network.layers if layer.get("activation") == "relu" and layer["op"] == "conv2d"]
        self.kernels = [getattr(network, name).weight for name in hidden[1:]]
        taken = {id(kernel) for kernel in self.kernels}
        self.others = torch.optim.AdamW((p for p in network.parameters() if id(p) not in taken), lr=0.0, betas=(0.9, 0.99),
                                        weight_decay=weight_decay)
        # The same memory as the kernels.
        self.matrices = [torch.nn.Parameter(self._matrix(kernel.data)) for kernel in self.kernels]
        self.muon = torch.optim.Muon(self.matrices, lr=0.0, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
        self.muon.param_groups[0]["scale"] = self.SCALE
        self.param_groups = self.others.param_groups + self.muon.param_groups

    @staticmethod
    def _matrix(kernel):
        return kernel.permute(0, 2, 3, 1).view(len(kernel), -1)

    def zero_grad(self, set_to_none=True):
        self.others.zero_grad(set_to_none)
        for kernel in self.kernels:
            kernel.grad = None

    def step(self):
        for matrix, kernel in zip(self.matrices, self.kernels, strict=True):
            matrix.grad = kernel.grad.permute(0, 2, 3, 1).reshape(matrix.shape)
        self.others.step()
        self.muon.step()

    def state_dict(self):
        return {"others": self.others.state_dict(), "muon": self.muon.state_dict()}

    def load_state_dict(self, state):
        self.others.load_state_dict(state["others"])
        self.muon.load_state_dict(state["muon"])
        self.param_groups = self.others.param_groups + self.muon.param_groups


def make_optimizer(name, network, weight_decay):
    if name == "sgd":
        return torch.optim.SGD(network.parameters(), lr=0.0, momentum=0.9, weight_decay=weight_decay)
    if name == "adamw":
        return torch.optim.AdamW(network.parameters(), lr=0.0, betas=(0.9, 0.99), weight_decay=weight_decay)
    return Muon(network, weight_decay)


class Order:
    """Batches of sample numbers in a random order, each sample once an epoch."""

    def __init__(self, numbers, batch):
        self.numbers, self.batch = np.asarray(numbers), batch
        self.state = {"epoch": 0, "position": 0, "count": len(self.numbers), "order": None}

    def __next__(self):
        state = self.state
        if state["order"] is None or state["count"] != len(self.numbers) or state["position"] >= len(self.numbers):
            state["epoch"] += state["order"] is not None
            state["order"] = torch.randperm(len(self.numbers), device="cpu").numpy()
            state["position"], state["count"] = 0, len(self.numbers)
        taken = state["order"][state["position"] : state["position"] + self.batch]
        state["position"] += self.batch
        return self.numbers[taken]


# Where little of an image is robot, a batch's statistics vary so much that a network trained on them errs three times as
# far with their average: from this progress on, it is trained with the average itself, as export folds it.
FREEZE_NORMALISATION = 0.25


def kept_state(args):
    """What to go on from with --resume; None at the start of a run, which overwrites none."""
    last = Path(args.out) / "last.pt"
    if args.resume:
        if not last.exists():
            raise SystemExit(f"--resume: expected {last}, found none: nothing is saved before a run's first evaluation")
        return torch.load(last, weights_only=False)
    if last.exists():
        raise SystemExit(f"{args.out} holds a run already: add --resume to go on with it, or choose another folder")
    return None


def fit(args, state, network, numbers, draw, batch_loss, score, card):
    """Trains `network` in the folder args.out, from its kept `state` on if there is one.

    `draw(numbers, progress)` gives a batch's inputs and truth, `batch_loss(inputs, truth)` its loss, `score()` the
    validation figures as a dict. `card` goes into the checkpoint. Rates decay to nearly nothing, so the last state is the one to use, and validation chooses nothing.
    """
    out = Path(args.out)
    optimizer = make_optimizer(args.optimizer, network, args.weight_decay)
    schedule = Schedule(args.learning_rate, args.momentum)
    order = Order(numbers, args.batch)
    iteration, before, frozen = 0, 0.0, False
    last = out / "last.pt"
    if state is not None:
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        order.state, iteration, before = state["order"], state["iteration"], state["seconds"]
        frozen = state["frozen"]
        _set_rng_state(state["rng"])
        _drop_rows_after(out / "log.csv", iteration)
    out.mkdir(parents=True, exist_ok=True)
    (out / "settings.json").write_text(json.dumps(vars(args), indent=1, default=str) + "\n")

    started, seconds, total, counted = time.monotonic(), before, 0.0, 0
    budget = args.iterations or 60 * args.minutes
    progress = (iteration if args.iterations else before) / budget
    with tqdm(total=1.0, initial=min(progress, 1), bar_format="{l_bar}{bar}| {elapsed} {postfix}", mininterval=10) as bar:
        while progress < 1:
            network.train()
            # Once for all: a longer budget than before takes progress back.
            frozen = frozen or progress >= FREEZE_NORMALISATION
            if frozen:
                for module in network.modules():
                    if isinstance(module, torch.nn.BatchNorm2d):
                        module.eval()
            rate = schedule.apply(optimizer, progress)
            inputs, truth = draw(next(order), progress)
            with torch.autocast(args.device, torch.bfloat16, enabled=args.precision == "bf16"):
                loss = batch_loss(inputs.contiguous(memory_format=torch.channels_last), truth)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), args.clip_gradient)
            optimizer.step()
            iteration += 1
            # Not read here: a GPU would have to be waited for.
            total, counted = total + loss.detach(), counted + 1
            seconds = before + time.monotonic() - started
            progress = (iteration if args.iterations else seconds) / budget
            if iteration % args.evaluate_every == 0 or progress >= 1:
                # The last step's weights have not met a loss yet.
                if not (torch.isfinite(total) and all(tensor.isfinite().all() for tensor in network.state_dict().values())):
                    kept = f"{last} is as it was" if last.exists() else "nothing was saved"
                    raise SystemExit(f"{out}: iteration {iteration}: expected finite loss and weights, found NaN or infinity: {kept};"
                                     " try a lower --learning-rate")
                network.eval()
                figures = {"iteration": iteration, "epoch": order.state["epoch"], "seconds": round(seconds, 1),
                           "learning_rate": f"{rate:.3g}", "train_loss": round(float(total) / counted, 5), **score()}
                total, counted = 0.0, 0
                _append_csv(out / "log.csv", figures)
                partial = last.with_suffix(".partial")
                torch.save({"layers": network.layers, "normalise": network.normalise, "network": network.state_dict(),
                            "card": card, "iteration": iteration, "seconds": seconds, "figures": figures,
                            "optimizer": optimizer.state_dict(), "order": order.state, "frozen": frozen,
                            "rng": _rng_state()}, partial)
                partial.replace(last)
                bar.set_postfix({key: figures[key] for key in list(figures)[4:]})
                seconds = before + time.monotonic() - started
                progress = max(progress, (iteration if args.iterations else seconds) / budget)
            bar.update(min(progress, 1) - bar.n)


def _rng_state():
    """Of the processor's random numbers, which order samples, and of each GPU's, which vary them there."""
    return [torch.get_rng_state(), *torch.cuda.get_rng_state_all()]


def _set_rng_state(states):
    processor, *cards = states
    torch.set_rng_state(processor)
    torch.cuda.set_rng_state_all(cards)


def _append_csv(path, row):
    new = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def _drop_rows_after(path, iteration):
    """Leaves out of a log what was logged after the state that is gone on from: it will be logged again."""
    if not path.exists():
        return
    with open(path, newline="") as file:
        rows = list(csv.reader(file))
    partial = path.with_suffix(".partial")
    with open(partial, "w", newline="") as file:
        # The last row may be cut off.
        csv.writer(file).writerows(
            row for row in rows if row == rows[0] or (len(row) >= len(rows[0]) and int(row[0]) <= iteration))
    partial.replace(path)


# --- what both tasks share -------------------------------------------------------------------------------------------

def load_samples(args, state):
    """(training samples, their numbers, validation samples, their numbers, the card's account of both). Arms are as long as in
    the `state` that is gone on from."""
    data.refuse_common(args.recording, args.validation)
    samples = data.Samples(args.recording, args.cache, kept_arm_lengths(state) if state else None)
    if args.device != "cpu":
        samples.keep(args.device)
    if args.validation:
        held_out, numbers = data.Samples(args.validation, args.cache, samples.arm_lengths), np.arange(len(samples))
        validation = np.arange(len(held_out))
        protocol = "validated on recordings of their own"
    else:
        held_out = samples
        numbers, validation = data.split(samples)
        protocol = "80/20 split"
    if args.samples and args.samples < len(numbers):
        numbers = np.sort(np.random.default_rng(args.seed).permutation(numbers)[: args.samples])
    if len(validation) > args.validation_samples:
        validation = np.random.default_rng(args.seed).permutation(validation)[: args.validation_samples]
    card = {
        "training_recordings": samples.sources, "validation_recordings": held_out.sources if args.validation else [],
        "protocol": protocol, "seed": args.seed, "precision": args.precision, "optimizer": args.optimizer,
        "learning_rate": args.learning_rate, "momentum": args.momentum, "batch": args.batch,
        "minutes": args.minutes, "iterations": args.iterations, "normalise": args.normalise,
    }
    return samples, numbers, held_out, np.sort(validation), card


def initialise(network):
    """He initialisation: with PyTorch's own, a chain of ReLU layers without normalisation starts nearly silent."""
    for layer in network.layers:
        if layer.get("activation") == "relu":
            module = getattr(network, layer["name"])
            torch.nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            torch.nn.init.zeros_(module.bias)
    return network


def load_network(run):
    """(network in eval mode, without normalisation, checkpoint) of a run; its first layer tells the input's name."""
    state = torch.load(Path(run) / "last.pt", weights_only=False, map_location="cpu")
    network = Network(state["layers"], state["layers"][0]["inputs"][0], normalise=state["normalise"])
    network.load_state_dict(state["network"])
    return network.eval().fold_normalisation(), state


def load_masks(mask, coarse):
    """(the mask network, the coarse network or None) of the runs' folders, calibrated, or of model files, which are; in eval mode.
    Without `coarse`, a model file's own."""
    found = {"mask": _calibrated(mask)} if Path(mask).is_dir() else read_model(mask)[0]
    return found["mask"], load_coarse(coarse) if coarse else found.get("coarse")


def load_coarse(path):
    """The coarse network of a run's folder, calibrated, or of a model file, which is; in eval mode."""
    if Path(path).is_dir():
        return _calibrated(path)
    if not Path(path).exists():
        raise SystemExit(f"expected the folder of a run or a model file, found {path}")
    networks = read_model(path)[0]
    if "coarse" not in networks:
        raise SystemExit(f"{path} has no coarse network")
    return networks["coarse"]


def _calibrated(run):
    network, state = load_network(run)
    evaluate.shift_logits(network, state["figures"]["logit_shift"])
    return network


@torch.no_grad()
def start_from(network, tensors, images):
    """Gives the untrained `network` another one's weights, whose normalisation is folded away, in place.

    With normalisation, each layer's is set to undo itself on `images`: training goes on from the very same function.
    """
    own = network.state_dict()
    for key, tensor in tensors.items():
        if key not in own or own[key].shape != tensor.shape:
            found = tuple(own[key].shape) if key in own else "none"
            raise SystemExit(f"--init-from: {key}: expected {found}, found {tuple(tensor.shape)}: another family?")
    network.load_state_dict(tensors, strict=False)

    def undo(norm, inputs):
        norm.running_mean.copy_(inputs[0].mean((0, 2, 3)))
        norm.running_var.copy_(inputs[0].var((0, 2, 3)))
        norm.weight.copy_(torch.sqrt(norm.running_var + norm.eps))
        norm.bias.copy_(norm.running_mean)

    hooks = [module.register_forward_pre_hook(undo) for module in network.modules()
             if isinstance(module, torch.nn.BatchNorm2d)]
    network.eval()(images)
    for hook in hooks:
        hook.remove()


def starting_tensors(path, part):
    """(the state dict of the `part`, coarse, mask or joint, card) of a run's folder or of a model file; of one without a coarse network,
    the mask network's."""
    if Path(path).is_dir():
        network, state = load_network(path)
        return network.state_dict(), state["card"]
    networks, description = read_model(path)
    return networks[part if part in networks else "mask"].state_dict(), description["card"]


# --- the mask network ------------------------------------------------------------------------------------------------

def mask_layers(args):
    """Of the network that the command's flags ask for."""
    if args.coarse:
        if args.family != "context":
            raise SystemExit("--coarse: expected --family context: the paper's has one mask network")
        return coarse_mask_layers()
    return context_mask_layers() if args.family == "context" else paper_mask_layers(args.dilations, args.kernel)


def train_mask(args):
    state = kept_state(args)
    samples, numbers, held_out, validation, card = load_samples(args, state)
    share = float(samples.coverage[numbers].mean())
    w_fg, w_bg = losses.class_weights(share)
    height, width = args.crop[1], args.crop[0]
    card |= {"family": args.family, "foreground_share": share, "w_fg": w_fg, "w_bg": w_bg,
             "crop": args.crop, "camera": args.camera, **({"zoom": args.zoom} if args.camera == "free" else {})}
    network = initialise(Network(mask_layers(args), MASK_INPUT, normalise=args.normalise))
    if args.init_from:
        tensors = starting_tensors(args.init_from, "coarse" if args.coarse else "mask")[0]
        if args.coarse:
            # A mask network's first layers are like its own.
            own = network.state_dict()
            tensors = {key: tensor for key, tensor in tensors.items() if key in own and own[key].shape == tensor.shape}
        start_from(network, tensors, samples.pixels(numbers[:: len(numbers) // 64 + 1])[0])
        card |= {"init_from": Path(args.init_from).name}
    network = network.to(args.device, memory_format=torch.channels_last)

    coarse = None
    if args.coarse_run:
        if args.coarse or args.camera == "fixed":
            raise SystemExit("--coarse-run: expected neither --coarse nor --camera fixed")
        coarse = load_coarse(args.coarse_run).to(args.device, memory_format=torch.channels_last)
        card |= {"coarse_run": Path(args.coarse_run).name, "zoom": zoom.MASK_ZOOM}
        del card["crop"]
    negatives = data.read_negatives(args.negatives, args.cache) if args.negatives else None
    if negatives is not None:
        card |= {"negatives": len(negatives), "negative_share": args.negative_share}

    def draw(batch, _progress):
        images, masks = samples.bytes(batch)
        if negatives is not None:
            rows = torch.rand(len(batch), device="cpu") < args.negative_share
            drawn = torch.randint(len(negatives), (int(rows.sum()),), device="cpu")
            images[rows], masks[rows] = torch.from_numpy(negatives[drawn.numpy()]).to(images.device), 0
        images, masks = images.to(args.device), masks.to(args.device)
        if coarse is not None:
            return data.closer_views(images, masks, coarse, args.precision == "bf16")
        images, masks = data.halve(images), data.truth_of(masks)
        if args.camera == "fixed":
            return data.random_crops(data.jitter_some_colours(images), masks, height, width)
        share = data.COARSE_VARIED if args.coarse else data.VARIED
        return data.mixed_views(images, masks, height, width, args.zoom, share)

    def batch_loss(images, masks):
        return losses.mask_loss(network(images), masks, w_fg, w_bg)

    # With recordings of their own to validate on, the log's IoU is at the threshold that suits the very samples it is measured
    # on; what export reports on is not chosen on. With a random split, training samples tell the threshold.
    some = np.sort(np.random.default_rng(args.seed).permutation(numbers)[: args.validation_samples])
    calibration = (held_out, validation) if args.validation else (samples, some)

    def score():
        shift = evaluate.calibrate(network, *calibration, args.device, coarse)
        return evaluate.score_mask(network, held_out, validation, args.device, shift, coarse) | {"logit_shift": shift}

    fit(args, state, network, numbers, draw, batch_loss, score, card)


# --- the joint network -----------------------------------------------------------------------------------------------

class Standardised:
    """Joints [N, 6, 3] in metres and the network's 18 outputs, which have mean 0 and deviation 1 over the training set.

    Export folds this into the dense layer, so the engine never meets it.
    """

    def __init__(self, mean, deviation):
        self.mean, self.deviation = torch.as_tensor(mean), torch.as_tensor(deviation)

    @classmethod
    def of(cls, joints):
        flat = joints.reshape(len(joints), -1)
        return cls(flat.mean(0), flat.std(0).clip(min=1e-3))

    def metres(self, outputs, _arms):
        outputs = outputs.float().flatten(1)
        return (outputs * self.deviation.to(outputs.device) + self.mean.to(outputs.device)).reshape(-1, len(JOINTS), 3)

    def fold(self, network, _arm):
        """Changes the last layer in place so that its outputs are metres."""
        with torch.no_grad():
            network.dense.weight *= self.deviation[:, None]
            network.dense.bias.copy_(network.dense.bias * self.deviation + self.mean)

    def unfold(self, tensors, origin):
        """Brings another network's tensors into this unit, in place; `origin` is its card."""
        if "mean" in origin:
            mean, deviation = (torch.as_tensor(origin[key]) for key in ("mean", "deviation"))
            tensors["dense.weight"] = tensors["dense.weight"] * deviation[:, None]
            tensors["dense.bias"] = tensors["dense.bias"] * deviation + mean
        tensors["dense.weight"] = tensors["dense.weight"] / self.deviation[:, None]
        tensors["dense.bias"] = (tensors["dense.bias"] - self.mean) / self.deviation

    def card(self):
        return {"mean": self.mean.tolist(), "deviation": self.deviation.tolist()}


class ArmLengths:
    """Joints [N, 6, 3] in metres and outputs in arm lengths, for networks that end in slopes and logarithms of depth:
    the unit in which one network can learn from robots of several sizes, and a new robot starts from another's.

    A robot with two bodies has an arm of either's length, by a sample more or less: the run's card keeps that of its training
    samples. Export folds it into the last dense layer, exactly: it is a summand of the logarithm.
    """

    def metres(self, outputs, arms):
        return outputs.float().reshape(-1, len(JOINTS), 3) * arms[:, None, None]

    def fold(self, network, arm):
        with torch.no_grad():
            network.dense2.bias[2::3] += math.log(arm)

    def unfold(self, tensors, origin):
        # A run's network is in arm lengths already; a model file's is in metres and says how long its arm is.
        tensors["dense2.bias"] = tensors["dense2.bias"].clone()
        tensors["dense2.bias"][2::3] -= math.log(origin.get("arm_length_m", 1.0))

    def card(self):
        return {}


def kept_arm_lengths(state):
    """Robots' arm lengths by which a run was trained; {} of an older run, whose are measured again."""
    return state["card"].get("arm_lengths_m", {})


def output_unit(card):
    return Standardised(card["mean"], card["deviation"]) if "mean" in card else ArmLengths()


def _prepare_heatmaps(network, joints):
    """Sets the untrained network to a plain guess: everywhere alike, at the mean depth, and no correction."""
    with torch.no_grad():
        for name in ("heat", "votes", "dense2"):
            getattr(network, name).weight.mul_(0.1)
            getattr(network, name).bias.zero_()
        network.votes.bias[2::3] = float(np.log(joints[..., 2]).mean())
        outputs = network.dense2.out_features
        network.dense2.weight[:, :outputs] = torch.eye(outputs)


def heat_loss(heat, place, truth):
    """How far the heat maps [N, J, h, w] are from the cells where the joints are: the cross-entropy with a bump of one
    cell's width, over the joints [N, J, 3] that are in the image.

    Without it the expectation alone would have to tell the heat maps where to look.
    """
    count, joints, height, width = heat.shape
    device = heat.device
    x = place["origin"][0] + place["step"][0] * torch.arange(width, device=device)
    y = place["origin"][1] + place["step"][1] * torch.arange(height, device=device)
    slope_x, slope_y = (truth[..., axis] / truth[..., 2] for axis in (0, 1))
    bump_x = torch.exp(-0.5 * ((x - slope_x[..., None]) / place["step"][0]) ** 2)
    bump_y = torch.exp(-0.5 * ((y - slope_y[..., None]) / place["step"][1]) ** 2)
    target = (bump_y[..., :, None] * bump_x[..., None, :]).flatten(2)
    mass = target.sum(2, keepdim=True)
    inside = (mass > 1)[..., 0]
    logs = torch.log_softmax(heat.float().flatten(2), 2)
    entropies = -(target / mass.clamp(min=1) * logs).sum(2)
    return (entropies * inside).sum() / inside.sum().clamp(min=1)


# Less of a robot in view does not tell where its joints are.
MIN_COVERAGE = 0.005


def train_joint(args):
    state = kept_state(args)
    samples, numbers, held_out, validation, card = load_samples(args, state)
    numbers, validation = (
        chosen[part.has_robot[chosen] & (part.coverage[chosen] >= args.min_coverage)]
        for part, chosen in ((samples, numbers), (held_out, validation)))
    joints, arms = torch.from_numpy(samples.joints), torch.from_numpy(samples.arms)
    rule = OVERLAYS[args.overlay or {"paper": "threshold", "context": "ramp"}[args.family]]
    if args.family == "context":
        unit, layers, view = ArmLengths(), heatmap_joint_layers(), zoom.ZOOM
    else:
        view = None
        layers = paper_joint_layers(args.dilations, args.pool)
        # A recording may have grown since: what is resumed keeps its unit.
        unit = output_unit(state["card"]) if state else Standardised.of(samples.joints[numbers])
    card |= {"family": args.family, "samples": len(numbers), "camera": args.camera, "overlay": rule, "zoom": view, "min_coverage": args.min_coverage,
             "estimated_masks": args.estimated_masks, "estimated_after": args.estimated_after,
             "arm_lengths_m": samples.arm_lengths, **unit.card()}
    network = initialise(Network(layers, JOINT_INPUT, normalise=args.normalise))
    if args.family == "context":
        card |= {"heat_weight": args.heat_weight}
        _prepare_heatmaps(network, samples.joints[numbers] / samples.arms[numbers, None, None])
    if args.init_from:
        tensors, origin = starting_tensors(args.init_from, "joint")
        unit.unfold(tensors, origin)
        images, masks = samples.pixels(numbers[:: len(numbers) // 64 + 1])
        start_from(network, tensors, evaluate.overlays(images, masks, rule, view)[0])
        card |= {"init_from": Path(args.init_from).name}
    network = network.to(args.device, memory_format=torch.channels_last)

    mask_network = coarse = held_out_estimated = None
    if args.mask_run:
        mask_network, coarse = (network and network.to(args.device, memory_format=torch.channels_last)
                                for network in load_masks(args.mask_run, args.coarse_run))
        held_out_estimated = evaluate.estimate_masks(mask_network, held_out, validation, args.device, coarse)
    elif args.estimated_masks > 0:
        raise SystemExit("--estimated-masks needs --mask-run")

    def draw(batch, progress):
        images, masks = samples.bytes(batch)
        pictures = data.jitter_some_colours(images.to(args.device))
        images, masks = zoom.canonical(pictures), data.truth_of(masks.to(args.device))
        rows = torch.rand(len(batch)) < (args.estimated_masks if progress >= args.estimated_after else 0)
        if rows.any():
            estimates = evaluate.masks_of(mask_network, pictures[rows], coarse, args.precision == "bf16")
            moved = torch.rand(len(estimates)) < data.VARIED
            if moved.any():
                estimates[moved] = data.jitter_masks(estimates[moved])
            masks[rows] = estimates
        truth, zooms = joints[batch].to(args.device), torch.ones(len(batch))
        if view or args.camera == "free":
            if view:
                rotations, zooms = zoom.vary(*zoom.look_at(masks, view, rule))
            else:
                rotations = zoom.turns(*(torch.deg2rad(torch.empty(len(batch)).uniform_(-most, most)) for most in (8, 8, 10)))
            seen = zoom.see(torch.cat([images, masks], 1), rotations, zooms)
            images, masks, truth = seen[:, :3], seen[:, 3:], zoom.joints_seen(truth, rotations, zooms)
        overlays = overlay(images, masks, rule)
        if args.camera == "free":
            overlays = data.erase_rectangles(overlays)
        return overlays, (truth, arms[batch].to(args.device), zooms)

    def batch_loss(overlays, joints_and_arms):
        truth, size, zooms = joints_and_arms
        values = network.activations(overlays)
        estimate = unit.metres(values[network.layers[-1]["name"]], size)
        # In arm lengths, so that a large robot does not count for more than a small one; what is seen is nearer than it is.
        scale = torch.stack([torch.ones_like(zooms), torch.ones_like(zooms), zooms], 1)[:, None] / size[:, None, None]
        loss = losses.joint_loss(estimate * scale, truth * scale)
        if args.family == "context":
            place = next(layer for layer in network.layers if layer["op"] == "soft_argmax2d")
            loss = loss + args.heat_weight * heat_loss(values["heat"], place, truth)
        return loss

    def score():
        figures = {}
        for name, masks in (("true_mask", None), ("estimated_mask", held_out_estimated)):
            if name == "true_mask" or masks is not None:
                figures |= evaluate.score_joints(
                    network, unit.metres, held_out, validation, masks, (rule, view), args.device, name)
        return figures

    fit(args, state, network, numbers, draw, batch_loss, score, card)
