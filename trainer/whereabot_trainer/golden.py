"""Golden files: small cascades, and what PyTorch makes of them layer by layer, for the engine's tests.

`NAME.safetensors` is a complete model file. `NAME.activations.safetensors` holds, in f32 and without a batch
dimension, the input `mask.image`, every layer's output as `mask.{layer}` and `joint.{layer}`, the joint network's
input `joint.overlay`, and the cascade's result `joints` [18], in the canonical camera's frame. Where a coarse network turns the
mask network's camera, the input is `coarse.image`, made of the picture `source` of twice its size, its layers `coarse.{layer}`, and the
mask of both networks `merged`.
"""

from pathlib import Path

import torch
from safetensors.torch import save_file

from . import kinematic_fit, zoom
from .evaluate import overlays
from .model import describe, read_model, write_model
from .networks import JOINT_INPUT, JOINTS, MASK_INPUT, Network

WIDTH, HEIGHT = 20, 14
CONTEXT_WIDTH, CONTEXT_HEIGHT = 24, 12
# Odd channel counts, a dilation beyond the image's height, and kernels of 1 and 5 find layout and padding errors.
MASK_LAYERS = [
    {"name": "conv1", "op": "conv2d", "inputs": ["image"], "out_channels": 5, "kernel": 3, "dilation": 1,
     "activation": "relu"},
    {"name": "conv2", "op": "conv2d", "inputs": ["conv1"], "out_channels": 3, "kernel": 3, "dilation": 17,
     "activation": "none"},
    {"name": "conv3", "op": "conv2d", "inputs": ["conv2"], "out_channels": 6, "kernel": 5, "dilation": 2,
     "activation": "sigmoid"},
    {"name": "conv4", "op": "conv2d", "inputs": ["conv3"], "out_channels": 1, "kernel": 1, "dilation": 1,
     "activation": "none"},
    {"name": "mask", "op": "sigmoid", "inputs": ["conv4"]},
]
# 14 x 20 pools by 2 to 7 x 10, and by 3 to 2 x 3: a row and a column are left over.
JOINT_LAYERS = [
    {"name": "conv1", "op": "conv2d", "inputs": ["overlay"], "out_channels": 5, "kernel": 3, "dilation": 2,
     "activation": "relu"},
    {"name": "pool1", "op": "max_pool2d", "inputs": ["conv1"], "size": 2},
    {"name": "conv2", "op": "conv2d", "inputs": ["pool1"], "out_channels": 7, "kernel": 3, "dilation": 1,
     "activation": "none"},
    {"name": "pool2", "op": "max_pool2d", "inputs": ["conv2"], "size": 3},
    {"name": "conv3", "op": "conv2d", "inputs": ["pool2"], "out_channels": 9, "kernel": 3, "dilation": 5,
     "activation": "relu"},
    {"name": "dense", "op": "dense", "inputs": ["conv3"], "out_features": 3 * len(JOINTS), "activation": "none"},
]
# Skips: what is pooled by 2 and by 3 is enlarged by as much and meets what was there before.
CONTEXT_LAYERS = [
    {"name": "conv1", "op": "conv2d", "inputs": ["image"], "out_channels": 5, "kernel": 3, "dilation": 1,
     "activation": "relu"},
    {"name": "pool1", "op": "max_pool2d", "inputs": ["conv1"], "size": 2},
    {"name": "conv2", "op": "conv2d", "inputs": ["pool1"], "out_channels": 7, "kernel": 3, "dilation": 2,
     "activation": "relu"},
    {"name": "pool2", "op": "max_pool2d", "inputs": ["conv2"], "size": 3},
    {"name": "conv3", "op": "conv2d", "inputs": ["pool2"], "out_channels": 6, "kernel": 3, "dilation": 1,
     "activation": "relu"},
    {"name": "up1", "op": "upsample2d", "inputs": ["conv3"], "scale": 3},
    {"name": "skip1", "op": "concat", "inputs": ["up1", "conv2"]},
    {"name": "conv4", "op": "conv2d", "inputs": ["skip1"], "out_channels": 3, "kernel": 1, "dilation": 1,
     "activation": "none"},
    {"name": "up2", "op": "upsample2d", "inputs": ["conv4"], "scale": 2},
    {"name": "skip2", "op": "concat", "inputs": ["up2", "conv1", "image"]},
    {"name": "logit", "op": "conv2d", "inputs": ["skip2"], "out_channels": 1, "kernel": 3, "dilation": 1,
     "activation": "none"},
    {"name": "mask", "op": "sigmoid", "inputs": ["logit"]},
]
COARSE_LAYERS = [
    *CONTEXT_LAYERS[:2],
    {"name": "conv2", "op": "conv2d", "inputs": ["pool1"], "out_channels": 7, "kernel": 3, "dilation": 3,
     "activation": "relu"},
    {"name": "conv3", "op": "conv2d", "inputs": ["conv2"], "out_channels": 1, "kernel": 1, "dilation": 1,
     "activation": "none"},
    {"name": "up1", "op": "upsample2d", "inputs": ["conv3"], "scale": 2},
    {"name": "mask", "op": "sigmoid", "inputs": ["up1"]},
]
# 7 rows and 10 columns of cells, sharp enough for a place to show; joints and hidden features share a block of four.
HEATMAP_LAYERS = [
    {"name": "conv1", "op": "conv2d", "inputs": ["overlay"], "out_channels": 5, "kernel": 3, "dilation": 2,
     "activation": "relu"},
    {"name": "pool1", "op": "max_pool2d", "inputs": ["conv1"], "size": 2},
    {"name": "conv2", "op": "conv2d", "inputs": ["pool1"], "out_channels": 7, "kernel": 3, "dilation": 1,
     "activation": "relu"},
    {"name": "heat", "op": "conv2d", "inputs": ["conv2"], "out_channels": len(JOINTS), "kernel": 3, "dilation": 1,
     "activation": "none"},
    {"name": "votes", "op": "conv2d", "inputs": ["conv2"], "out_channels": 3 * len(JOINTS), "kernel": 1, "dilation": 1,
     "activation": "none"},
    {"name": "place", "op": "soft_argmax2d", "inputs": ["heat", "votes"], "origin": [-0.625, -0.4],
     "step": [0.14, 0.13]},
    {"name": "hidden", "op": "dense", "inputs": ["place"], "out_features": 9, "activation": "relu"},
    {"name": "places", "op": "concat", "inputs": ["place", "hidden"]},
    {"name": "dense", "op": "dense", "inputs": ["places"], "out_features": 3 * len(JOINTS), "activation": "none"},
    {"name": "joints", "op": "back_project", "inputs": ["dense"]},
]
# A UR5 and a UR5e, and the joints of the first, a little off, in metres.
ARM = {
    "bodies": [dict(zip(kinematic_fit.LINKS, links, strict=True)) for links in (
        (0.1358, 0.425, -0.1197, 0.3922, 0.093, 0.0946), (0.138, 0.425, -0.131, 0.3922, 0.1263, 0.0997))],
    "across": [[80.0 if i == j else -12.0 if i < j else 0.0 for j in range(6)] for i in range(6)],
    "along": [[60.0 if i == j else 5.0 * (j - i) if i < j else 0.0 for j in range(6)] for i in range(6)],
}
ARM_JOINTS = [0.02, 0.4, 1.5, 0.147, 0.389, 1.52, 0.031, 0.021, 1.37, 0.12, -0.352, 1.488, 0.222, -0.342, 1.49, 0.208, -0.37, 1.4]
CARD = {"data": "none: random weights", "purpose": "golden files of whereabot's tests"}


def _networks(seed, image, mask_layers, joint_layers):
    torch.manual_seed(seed)
    shape = tuple(image.shape)
    mask = Network(mask_layers, MASK_INPUT, shape)
    joint = Network(joint_layers, JOINT_INPUT, shape)
    # Default weights give a mask that is nearly the same all over, and a dead first layer behind it: spread the values
    # and centre the mask on 0.5, so that a wrong layer shows.
    with torch.no_grad():
        mask.conv1.weight *= 3
        mask.conv3.weight *= 3
        last = getattr(mask, mask_layers[-1]["inputs"][0])
        last.weight *= 8
        logits = mask.activations(image[None])[mask_layers[-1]["inputs"][0]].flatten().sort().values
        middle = logits[len(logits) // 4 : 3 * len(logits) // 4]
        # No pixel may lie near the threshold, where rounding could flip it: put 0.5 in the middle's widest gap.
        gap = middle.diff().argmax()
        last.bias -= (middle[gap] + middle[gap + 1]) / 2
        joint.conv1.weight *= 3
        joint.conv1.bias += 0.2
        joint.conv2.weight *= 3
        if hasattr(joint, "heat"):
            # A flat heat map would hide a wrong place.
            joint.heat.weight *= 20
        else:
            joint.conv3.weight *= 3
        joint.dense.bias[2::3] += 1.5
    return mask, joint


@torch.no_grad()
def cascade_activations(networks, description, image, source=None):
    """Every value of the cascade on one image [3, H, W], by `{network}.{layer}`; behind a coarse network, `image` is of the picture
    `source` [3, 2 H, 2 W]."""
    def activations(name, image):
        return {f"{name}.{layer}": value[0] for layer, value in networks[name].activations(image).items()}

    values, camera = {}, description["camera"]
    if "coarse" in networks:
        values |= activations("coarse", image[None])
        coarse = values["coarse.mask"][None]
        cameras = zoom.look_at(coarse, description["coarse"]["zoom"], zoom.LOOKED_AT, camera)
        values |= activations("mask", zoom.rectify(source[None], *cameras, camera))
        values["source"] = source
        estimate = zoom.merge(coarse, values["mask.mask"][None], *cameras, camera)
        values["merged"] = estimate[0]
    else:
        values |= activations("mask", image[None])
        estimate = values["mask.mask"][None]
    seen, cameras = overlays(image[None], estimate, description["overlay"], description.get("zoom"), camera)
    values |= activations("joint", seen)
    # A vector, not an image of one pixel.
    values = {name: value.flatten() if value.shape[1:] == (1, 1) else value for name, value in values.items()}
    joints = values[f"joint.{networks['joint'].layers[-1]['name']}"].clone()
    if cameras is not None:
        joints = zoom.joints_of(joints.reshape(1, -1, 3), *cameras).flatten()
    if "arm" in description:
        joints = kinematic_fit.fit(joints.reshape(1, -1, 3), description["arm"]).flatten()
    values["joints"] = joints
    return {name: value.contiguous() for name, value in values.items()}


def write_golden(folder, seed=1):
    """Writes the models `tiny`, `threshold`, `tiny_f16`, `context`, `heatmap`, `zoom`, `arm` and `coarse` with their
    activations."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    torch.use_deterministic_algorithms(True)
    torch.set_num_threads(1)
    multiply, threshold = {"rule": "multiply"}, {"rule": "threshold", "threshold": 0.5}
    ramp = {"rule": "ramp", "low": 0.25, "high": 0.75}
    paper = (MASK_LAYERS, JOINT_LAYERS, WIDTH, HEIGHT)
    context = (CONTEXT_LAYERS, JOINT_LAYERS, CONTEXT_WIDTH, CONTEXT_HEIGHT)
    heatmap = (MASK_LAYERS, HEATMAP_LAYERS, WIDTH, HEIGHT)
    # The mask is spread over the whole small image: this looks at the middle half of it.
    view = {"spread": 2.0, "least": 0.5, "most": 4.0}
    # Half of the image is beyond the mask network's view; the joint network's is beside the middle.
    closer, beside = {"spread": 2.0, "least": 1.0, "most": 4.0}, {"rule": "ramp", "low": 0.5, "high": 0.9}
    for name, family, (mask_layers, joint_layers, width, height), rule, mask_zoom, view, arm, dtype in (
        ("tiny", "paper", paper, multiply, None, None, None, "f32"),
        ("threshold", "paper", paper, threshold, None, None, None, "f32"),
        ("tiny_f16", "paper", paper, multiply, None, None, None, "f16"),
        ("context", "context", context, multiply, None, None, None, "f32"),
        ("heatmap", "context", heatmap, multiply, None, None, None, "f32"),
        ("zoom", "context", heatmap, ramp, None, view, None, "f32"), ("arm", "paper", paper, multiply, None, None, ARM, "f32"),
        ("coarse", "context", heatmap, beside, closer, view, None, "f32"),
    ):
        generator, source = torch.Generator().manual_seed(seed), None
        if mask_zoom:
            source = torch.randint(256, (3, 2 * height, 2 * width), generator=generator) / 255
            image = zoom.canonical(source[None])[0]
        else:
            image = torch.rand((3, height, width), generator=generator)
        mask, joint = _networks(seed, image, mask_layers, joint_layers)
        networks = {"mask": mask, "joint": joint}
        if mask_zoom:
            coarse = Network(COARSE_LAYERS, MASK_INPUT, tuple(image.shape))
            with torch.no_grad():
                # As of the mask network: a mask that is nearly the same all over would hide a wrong layer.
                coarse.conv3.weight *= 20
            networks = {"coarse": coarse, **networks}
        if arm:
            with torch.no_grad():
                joint.dense.weight *= 0.02
                joint.dense.bias[:] = torch.tensor(ARM_JOINTS)
        description = describe(
            {name: network.layers for name, network in networks.items()}, family=family, robot="golden", overlay=rule,
            mask_zoom=mask_zoom, zoom=view, arm=arm, width=width, height=height,
            camera={"fx": 14.25, "fy": 14.25, "cx": (width - 1) / 2, "cy": (height - 1) / 2},
            presence={"mask_threshold": 0.5, "sure_threshold": 0.7, "min_sure": 0.01}, card=CARD)
        path = folder / f"{name}.safetensors"
        write_model(path, networks, description, dtype)
        values = cascade_activations(*read_model(path), image, source)
        # Behind a coarse mask, nothing is told by a threshold.
        margin = 1.0 if mask_zoom else (values["mask.mask"] - 0.5).abs().min().item()
        if margin < 1e-3:
            raise ValueError(f"a pixel of the mask is {margin:.1e} from the threshold: take another seed")
        save_file(values, folder / f"{name}.activations.safetensors")
