"""The model file: its networks' tensors and, in the metadata key `whereabot`, the JSON that describes them."""

import json
import os
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from .networks import CAMERA, INPUT_HEIGHT, INPUT_WIDTH, JOINT_INPUT, JOINTS, MASK_INPUT, Network

DTYPES = {"f32": torch.float32, "f16": torch.float16}


# Of each network, by the prefix of its tensors.
INPUTS = {"coarse": MASK_INPUT, "mask": MASK_INPUT, "joint": JOINT_INPUT}


def describe(layers, *, family, robot, overlay, mask_zoom, zoom, arm, presence, card,
             width=INPUT_WIDTH, height=INPUT_HEIGHT, camera=CAMERA):
    """The description that the engine reads from the model file; `layers` are the networks', by their names: `mask`, `joint` and
    perhaps `coarse`, whose mask turns the mask network's camera as `mask_zoom` says."""
    coarse = {"coarse": {"network": {"layers": layers["coarse"]}, "zoom": mask_zoom}} if "coarse" in layers else {}
    return {
        "version": 1, "family": family, "robot": robot, "joints": JOINTS,
        "input": {"width": width, "height": height}, "camera": camera,
        **coarse, "mask_network": {"layers": layers["mask"]}, "overlay": overlay, **({"zoom": zoom} if zoom else {}),
        "joint_network": {"layers": layers["joint"]}, **({"arm": arm} if arm else {}), "presence": presence, "card": card,
    }


def write_model(path, networks, description, dtype="f32"):
    """Writes the networks, by their names, and their description as one safetensors file."""
    tensors = {}
    for prefix, network in networks.items():
        for key, tensor in network.state_dict().items():
            tensor = tensor.detach().cpu().to(DTYPES[dtype])
            if not torch.isfinite(tensor).all():
                raise ValueError(f"{prefix}.{key} is not finite in {dtype}")
            tensors[f"{prefix}.{key}"] = tensor.contiguous(memory_format=torch.contiguous_format)
    # A reader must never see half a file: write beside it, then rename.
    partial = f"{path}.partial"
    Path(partial).write_bytes(save(tensors, metadata={"whereabot": json.dumps(description)}))
    os.replace(partial, path)


def read_model(path):
    """(networks by their names, description) of a model file; weights in f32."""
    with safe_open(path, framework="pt") as file:
        description = json.loads(file.metadata()["whereabot"])
        tensors = {key: file.get_tensor(key).float() for key in file.keys()}
    shape = (3, description["input"]["height"], description["input"]["width"])
    networks = {}
    for prefix, source in INPUTS.items():
        if prefix == "coarse" and "coarse" not in description:
            continue
        described = description["coarse"]["network"] if prefix == "coarse" else description[f"{prefix}_network"]
        network = Network(described["layers"], source, shape)
        network.load_state_dict({
            key.removeprefix(f"{prefix}."): tensor for key, tensor in tensors.items() if key.startswith(f"{prefix}.")})
        networks[prefix] = network.eval()
    return networks, description
