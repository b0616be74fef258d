"""Networks built from the layer lists that travel in the model file.

A network is a list of layers. Each layer is a dict with a unique `name`, an `op`, and the names of its `inputs`;
the last layer is the network's output. The engine builds its kernels from the same list, so nothing about a
network is known here that the model file does not say.
"""

import math

import torch
from torch import nn

JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
INPUT_WIDTH, INPUT_HEIGHT = 256, 212
CAMERA = {"fx": 182.5, "fy": 182.5, "cx": 127.5, "cy": 105.5}

MASK_INPUT = "image"
JOINT_INPUT = "overlay"


def paper_mask_layers(dilations=(1, 2, 4, 8, 1), kernel=3):
    """The paper's mask network: four dilated convolutions of 32 filters and one of one filter."""
    layers, source = [], MASK_INPUT
    for number, dilation in enumerate(dilations, start=1):
        last = number == len(dilations)
        layers.append({
            "name": f"conv{number}", "op": "conv2d", "inputs": [source], "out_channels": 1 if last else 32,
            "kernel": kernel, "dilation": dilation, "activation": "sigmoid" if last else "relu",
        })
        source = layers[-1]["name"]
    return layers


def context_mask_layers():
    """The context mask network: a wide view at a quarter of the resolution, upsampled, with two skips.

    With a free camera the paper's mask network runs out of capacity: this one sees the whole image, for three fifths of
    the arithmetic.
    """
    def conv(name, source, channels, kernel=3, dilation=1, activation="relu"):
        return {"name": name, "op": "conv2d", "inputs": [source], "out_channels": channels, "kernel": kernel,
                "dilation": dilation, "activation": activation}

    layers = [
        conv("conv1", MASK_INPUT, 16),
        {"name": "pool1", "op": "max_pool2d", "inputs": ["conv1"], "size": 2},
        conv("conv2", "pool1", 32),
        {"name": "pool2", "op": "max_pool2d", "inputs": ["conv2"], "size": 2},
    ]
    source = "pool2"
    for number, dilation in enumerate((1, 2, 4, 8, 16, 1), start=3):
        layers.append(conv(f"conv{number}", source, 64, dilation=dilation))
        source = f"conv{number}"
    return layers + [
        conv("conv9", source, 32, kernel=1),
        {"name": "up1", "op": "upsample2d", "inputs": ["conv9"], "scale": 2},
        {"name": "skip1", "op": "concat", "inputs": ["up1", "conv2"]},
        # What is enlarged to the full resolution is kept thin: there, memory is what costs.
        conv("conv10", "skip1", 16),
        {"name": "up2", "op": "upsample2d", "inputs": ["conv10"], "scale": 2},
        {"name": "skip2", "op": "concat", "inputs": ["up2", "conv1"]},
        conv("conv11", "skip2", 1, activation="sigmoid"),
    ]


def coarse_mask_layers():
    """The context family's coarse network, which tells its mask network where to look: that one's first layers, and a mask at a
    quarter of the resolution."""
    layers = context_mask_layers()[:7]
    return layers + [
        {"name": "wide", "op": "conv2d", "inputs": [layers[-1]["name"]], "out_channels": 24, "kernel": 3, "dilation": 8,
         "activation": "relu"},
        {"name": "logit", "op": "conv2d", "inputs": ["wide"], "out_channels": 1, "kernel": 1, "dilation": 1,
         "activation": "none"},
        {"name": "up1", "op": "upsample2d", "inputs": ["logit"], "scale": 4},
        {"name": "mask", "op": "sigmoid", "inputs": ["up1"]},
    ]


def paper_joint_layers(dilations=(1, 1, 1), pool=2, outputs=18):
    """The paper's joint network: convolutions of 32, 64 and 128 filters, max-pooling between, and a dense layer."""
    layers, source = [], JOINT_INPUT
    for number, (filters, dilation) in enumerate(zip((32, 64, 128), dilations, strict=True), start=1):
        layers.append({
            "name": f"conv{number}", "op": "conv2d", "inputs": [source], "out_channels": filters,
            "kernel": 3, "dilation": dilation, "activation": "relu",
        })
        source = f"conv{number}"
        if number < 3:
            layers.append({"name": f"pool{number}", "op": "max_pool2d", "inputs": [source], "size": pool})
            source = f"pool{number}"
    layers.append({
        "name": "dense", "op": "dense", "inputs": [source], "out_features": outputs, "activation": "none",
    })
    return layers


def heatmap_joint_layers(camera=CAMERA):
    """The context family's joint network: heat maps and votes at an eighth of the resolution, instead of one dense layer
    over all pixels.

    For each joint, every cell has a weight (the softmax of the joint's heat map) and votes for the joint's place: an
    offset from the cell, so that joints beyond the image's edge or behind something can be voted for too, and the
    logarithm of the depth. Places are slopes x / z and y / z. Dense layers then correct all joints in the light of each
    other, as an arm's proportions ask for.
    """
    cell = 8
    layers, source = [], JOINT_INPUT

    def conv(channels, kernel=3, dilation=1, activation="relu", name=None, of=None):
        nonlocal source
        number = sum(layer["op"] == "conv2d" for layer in layers) + 1
        layers.append({"name": name or f"conv{number}", "op": "conv2d", "inputs": [of or source],
                       "out_channels": channels, "kernel": kernel, "dilation": dilation, "activation": activation})
        source = layers[-1]["name"]

    def pool(number):
        nonlocal source
        layers.append({"name": f"pool{number}", "op": "max_pool2d", "inputs": [source], "size": 2})
        source = layers[-1]["name"]

    conv(16)
    pool(1)
    conv(32)
    pool(2)
    conv(64)
    conv(64)
    pool(3)
    for dilation in (1, 2, 4, 8, 1):
        conv(128, dilation=dilation)
    trunk, joints = source, len(JOINTS)
    conv(joints, kernel=1, activation="none", name="heat", of=trunk)
    conv(3 * joints, kernel=1, activation="none", name="votes", of=trunk)
    slope = {axis: cell / camera[f"f{axis}"] for axis in "xy"}
    # The middle of the first cell, pixel (0, 0) being a pixel's centre.
    first = {axis: ((cell - 1) / 2 - camera[f"c{axis}"]) / camera[f"f{axis}"] for axis in "xy"}
    return layers + [
        {"name": "place", "op": "soft_argmax2d", "inputs": ["heat", "votes"],
         "origin": [first["x"], first["y"]], "step": [slope["x"], slope["y"]]},
        {"name": "dense1", "op": "dense", "inputs": ["place"], "out_features": 128, "activation": "relu"},
        {"name": "places", "op": "concat", "inputs": ["place", "dense1"]},
        {"name": "dense2", "op": "dense", "inputs": ["places"], "out_features": 3 * joints, "activation": "none"},
        {"name": "joints", "op": "back_project", "inputs": ["dense2"]},
    ]


class Network(nn.Module):
    """A layer list as a PyTorch module; its state_dict keys are `{layer}.weight` and `{layer}.bias`.

    `shape` is the input's (channels, height, width). Tensors are NCHW. With `normalise`, batch normalisation stands
    between each convolution and its ReLU; it trains far sooner, and `fold_normalisation` takes it away again.
    """

    def __init__(self, layers, input_name, shape=(3, INPUT_HEIGHT, INPUT_WIDTH), normalise=False):
        super().__init__()
        self.normalise = normalise
        self.layers = layers
        self.input_name = input_name
        shapes = {input_name: tuple(shape)}
        for layer in layers:
            name, op = layer["name"], layer["op"]
            if name in shapes or hasattr(self, name):
                raise ValueError(f"layer name {name!r} is taken")
            for source in layer["inputs"]:
                if source not in shapes:
                    raise ValueError(f"layer {name!r} reads {source!r}, which no earlier layer makes")
            sources = [shapes[source] for source in layer["inputs"]]
            counts = {"concat": len(sources) > 1, "soft_argmax2d": len(sources) == 2}
            if len({tuple(shape[1:]) for shape in sources}) != 1 or not counts.get(op, len(sources) == 1):
                raise ValueError(f"layer {name!r}: {op} cannot read inputs of shapes {sources}")
            channels, *size = sources[0]
            if op == "conv2d":
                kernel, dilation = layer["kernel"], layer["dilation"]
                self.add_module(name, nn.Conv2d(
                    channels, layer["out_channels"], kernel, dilation=dilation, padding=dilation * (kernel - 1) // 2))
                if normalise and layer["activation"] == "relu":
                    self.add_module(f"{name}_norm", nn.BatchNorm2d(layer["out_channels"], momentum=0.03))
                shapes[name] = (layer["out_channels"], *size)
            elif op == "max_pool2d":
                shapes[name] = (channels, *(extent // layer["size"] for extent in size))
            elif op == "dense":
                self.add_module(name, nn.Linear(math.prod(sources[0]), layer["out_features"]))
                shapes[name] = (layer["out_features"], 1, 1)
            elif op == "sigmoid":
                shapes[name] = sources[0]
            elif op == "upsample2d":
                shapes[name] = (channels, *(extent * layer["scale"] for extent in size))
            elif op == "concat":
                shapes[name] = (sum(shape[0] for shape in sources), *size)
            elif op == "soft_argmax2d":
                if sources[1][0] != 3 * channels:
                    raise ValueError(f"layer {name!r}: expected {3 * channels} channels of votes, found {sources[1][0]}")
                shapes[name] = (3 * channels, 1, 1)
            elif op == "back_project":
                if channels % 3 or size != [1, 1]:
                    raise ValueError(f"layer {name!r}: expected triples without extent, found {sources[0]}")
                shapes[name] = sources[0]
            else:
                raise ValueError(f"layer {name!r} has the unknown op {op!r}")
        self.shapes = shapes

    def activations(self, x):
        """Every layer's output by the layer's name, and the input by its own."""
        values = {self.input_name: x}
        for layer in self.layers:
            name, op = layer["name"], layer["op"]
            value = values[layer["inputs"][0]]
            if op == "conv2d":
                value = getattr(self, name)(value)
                if self.normalise and layer["activation"] == "relu":
                    value = getattr(self, f"{name}_norm")(value)
            elif op == "max_pool2d":
                value = nn.functional.max_pool2d(value, layer["size"])
            elif op == "dense":
                # In bfloat16 the rounding of coordinates alone would cost millimetres.
                with torch.autocast(value.device.type, enabled=False):
                    value = getattr(self, name)(value.float().flatten(1))[:, :, None, None]
            elif op == "sigmoid":
                value = torch.sigmoid(value.float())
            elif op == "upsample2d":
                value = nn.functional.interpolate(
                    value, scale_factor=layer["scale"], mode="bilinear", align_corners=False)
            elif op == "concat":
                value = Concat.apply(*(values[source] for source in layer["inputs"]))
            elif op == "soft_argmax2d":
                value = soft_argmax2d(value, values[layer["inputs"][1]], layer["origin"], layer["step"])
            elif op == "back_project":
                value = back_project(value)
            activation = layer.get("activation", "none")
            if activation == "relu":
                value = torch.relu(value)
            elif activation == "sigmoid":
                # In bfloat16 the sigmoid is exactly 1 from a logit of 6 on.
                value = torch.sigmoid(value.float())
            elif activation != "none":
                raise ValueError(f"layer {name!r} has the unknown activation {activation!r}")
            values[name] = value
        return values

    def forward(self, x):
        return self.activations(x)[self.layers[-1]["name"]]

    @torch.no_grad()
    def fold_normalisation(self):
        """Multiplies each batch normalisation, as it is in eval mode, into its convolution."""
        for layer in self.layers if self.normalise else []:
            norm = self._modules.pop(f"{layer['name']}_norm", None)
            if norm is not None:
                convolution = getattr(self, layer["name"])
                scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
                convolution.weight *= scale[:, None, None, None]
                convolution.bias.copy_((convolution.bias - norm.running_mean) * scale + norm.bias)
        self.normalise = False
        return self


class Concat(torch.autograd.Function):
    """The inputs' channels one after the other. PyTorch's own gives back slices of one gradient, which layers before it
    take for the other memory format: eight times as long for an upsampling, a fifth of the mask network's step."""

    @staticmethod
    def forward(context, *inputs):
        context.channels = [value.shape[1] for value in inputs]
        return torch.cat(inputs, 1)

    @staticmethod
    def backward(context, gradient):
        return tuple(part.contiguous(memory_format=torch.channels_last) for part in gradient.split(context.channels, 1))


def soft_argmax2d(heat, votes, origin, step):
    """(x, y, value) of each joint, [N, 3 J, 1, 1]: the expectation, under the softmax of its heat map [N, J, h, w], of
    what the cells vote for [N, 3 J, h, w]. Cell (column, row) is at origin + step (column, row); its first two votes
    are an offset from there.

    Integral regression (Sun et al., 2018, "Integral human pose regression"), with offsets.
    """
    count, joints, height, width = heat.shape
    share = torch.softmax(heat.float().flatten(2), 2)
    votes = votes.float().reshape(count, joints, 3, height * width)
    columns = torch.arange(width, dtype=torch.float32, device=heat.device)
    rows = torch.arange(height, dtype=torch.float32, device=heat.device)
    x = (origin[0] + step[0] * columns).expand(height, width).reshape(-1)
    y = (origin[1] + step[1] * rows)[:, None].expand(height, width).reshape(-1)
    cells = torch.stack([x, y, torch.zeros_like(x)])
    return ((votes + cells) * share[:, :, None]).sum(3).reshape(count, 3 * joints, 1, 1)


def back_project(places):
    """Points (x, y, z) from slopes and logarithms of depth (x / z, y / z, log z), as triples in [N, 3 J, 1, 1]."""
    slopes_x, slopes_y, log_z = places.float().unflatten(1, (-1, 3)).unbind(2)
    z = torch.exp(log_z)
    return torch.stack([slopes_x * z, slopes_y * z, z], 2).flatten(1, 2)


# By name, as the model file has them.
OVERLAYS = {
    "multiply": {"rule": "multiply"},
    "threshold": {"rule": "threshold", "threshold": 0.5},
    "ramp": {"rule": "ramp", "low": 0.4, "high": 0.6},
}


def share(mask, rule):
    """How much of the colour shows through where the mask has these probabilities."""
    match rule["rule"]:
        case "multiply":
            return mask
        case "threshold":
            return (mask >= rule["threshold"]).to(mask.dtype)
        case "ramp":
            return ((mask - rule["low"]) / (rule["high"] - rule["low"])).clamp(0, 1)
        case unknown:
            raise ValueError(f"unknown overlay rule {unknown!r}")


def overlay(image, mask, rule):
    """The joint network's input: colour [N, 3, H, W] as far as the mask [N, 1, H, W] lets it through."""
    return image * share(mask, rule)


def run(network, images, bf16=False):
    """A network's answer to `images`, as f32."""
    with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
        return network(images.contiguous(memory_format=torch.channels_last)).float()
