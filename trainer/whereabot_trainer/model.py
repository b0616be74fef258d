"""The model file: both networks' tensors and, in the metadata key `whereabot`, the JSON that describes them."""

import json
import os
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from .networks import CAMERA, INPUT_HEIGHT, INPUT_WIDTH, JOINT_INPUT, JOINTS, MASK_INPUT, Network

DTYPES = {"f32": torch.float32, "f16": torch.float16}


def describe(mask_layers, joint_layers, *, family, robot, overlay, zoom, arm, presence, card,
             second_look=None, width=INPUT_WIDTH, height=INPUT_HEIGHT, camera=CAMERA):
    """The description that the engine reads from the model file."""
    return {
        "version": 1, "family": family, "robot": robot, "joints": JOINTS,
        "input": {"width": width, "height": height}, "camera": camera,
        "mask_network": {"layers": mask_layers}, "overlay": overlay,
        **({"zoom": zoom} if zoom else {}), **({"second_look": second_look} if second_look else {}),
        "joint_network": {"layers": joint_layers}, **({"arm": arm} if arm else {}), "presence": presence, "card": card,
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
    Path(partial).write_bytes(save(tensors, metadata={"whereabot": json.dumps(description)}))
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
