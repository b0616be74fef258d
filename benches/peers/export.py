"""A whereabot model file as one ONNX graph: `image` [1, 3, H, W] in [0, 1] to `mask` [1, 1, H, W] and `joints` [1, J, 3] in
metres, camera optical frame. The graph is built from the layer list in the file, as the engine builds its kernels, so that
nothing of a network is known here.
"""

import json
import math
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from safetensors import safe_open
from safetensors.numpy import save_file

# Old enough for every importer here.
OPSET, IR_VERSION = 17, 8


def read_model(path):
    """(description, tensors in f32) of a model file."""
    with safe_open(path, framework="numpy") as file:
        description = json.loads(file.metadata()["whereabot"])
        return description, {key: file.get_tensor(key).astype(np.float32) for key in file.keys()}


def networks_alone(path, copy):
    """Copies a model file, but for what turns the networks' cameras and fits joints to an arm: peers run the mask network and the joint
    network."""
    with safe_open(path, framework="numpy") as file:
        metadata, tensors = file.metadata(), {
            key: file.get_tensor(key) for key in file.keys() if not key.startswith("coarse.")}
    description = json.loads(metadata["whereabot"])
    for part in ("coarse", "zoom", "arm"):
        description.pop(part, None)
    save_file(tensors, copy, metadata | {"whereabot": json.dumps(description)})


class Graph:
    """The nodes and constants of a graph, and the shape of each value in it."""

    def __init__(self):
        self.nodes, self.constants, self.shapes = [], [], {}

    def constant(self, name, values, dtype=np.float32):
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype), name))
        return name

    def node(self, op, inputs, name, shape, **attributes):
        self.nodes.append(helper.make_node(op, inputs, [name], name=name, **attributes))
        self.shapes[name] = tuple(shape)
        return name

    def reshape(self, value, name, shape):
        return self.node("Reshape", [value, self.constant(f"{name}.shape", shape, np.int64)], name, shape)

    def network(self, prefix, layers, source_name, source, tensors):
        """Adds a network's layers; says the name of the last one's value. Layers without extent are [1, features]."""
        values = {source_name: source}
        for layer in layers:
            op, name = layer["op"], f"{prefix}.{layer['name']}"
            inputs = [values[one] for one in layer["inputs"]]
            values[layer["name"]] = getattr(self, op)(name, layer, inputs, tensors)
        return values[layers[-1]["name"]]

    def activated(self, name, layer, op, inputs, shape, **attributes):
        activation = {"none": None, "relu": "Relu", "sigmoid": "Sigmoid"}[layer["activation"]]
        if activation is None:
            return self.node(op, inputs, name, shape, **attributes)
        self.node(op, inputs, f"{name}.linear", shape, **attributes)
        return self.node(activation, [f"{name}.linear"], name, shape)

    def conv2d(self, name, layer, inputs, tensors):
        _, _, height, width = self.shapes[inputs[0]]
        kernel, dilation = layer["kernel"], layer["dilation"]
        parameters = [self.constant(f"{name}.{kind}", tensors[f"{name}.{kind}"]) for kind in ("weight", "bias")]
        return self.activated(name, layer, "Conv", inputs + parameters, (1, layer["out_channels"], height, width),
                              kernel_shape=[kernel] * 2, dilations=[dilation] * 2, strides=[1, 1],
                              pads=[dilation * (kernel - 1) // 2] * 4)

    def max_pool2d(self, name, layer, inputs, tensors):
        _, channels, height, width = self.shapes[inputs[0]]
        size = layer["size"]
        return self.node("MaxPool", inputs, name, (1, channels, height // size, width // size),
                         kernel_shape=[size] * 2, strides=[size] * 2)

    def upsample2d(self, name, layer, inputs, tensors):
        _, channels, height, width = self.shapes[inputs[0]]
        scale = layer["scale"]
        scales = self.constant(f"{name}.scales", [1, 1, scale, scale])
        return self.node("Resize", [*inputs, "", scales], name, (1, channels, height * scale, width * scale),
                         mode="linear", coordinate_transformation_mode="half_pixel")

    def concat(self, name, layer, inputs, tensors):
        shapes = [self.shapes[one] for one in inputs]
        return self.node("Concat", inputs, name, (1, sum(shape[1] for shape in shapes), *shapes[0][2:]), axis=1)

    def sigmoid(self, name, layer, inputs, tensors):
        return self.node("Sigmoid", inputs, name, self.shapes[inputs[0]])

    def dense(self, name, layer, inputs, tensors):
        shape = self.shapes[inputs[0]]
        if len(shape) > 2:
            inputs = [self.reshape(inputs[0], f"{name}.flat", (1, math.prod(shape)))]
        parameters = [self.constant(f"{name}.{kind}", tensors[f"{name}.{kind}"]) for kind in ("weight", "bias")]
        return self.activated(name, layer, "Gemm", inputs + parameters, (1, layer["out_features"]), transB=1)

    def soft_argmax2d(self, name, layer, inputs, tensors):
        _, joints, height, width = self.shapes[inputs[0]]
        cells = height * width
        rows, columns = np.divmod(np.arange(cells), width)
        (x, y), (dx, dy) = layer["origin"], layer["step"]
        places = self.constant(f"{name}.cells", [[[x + dx * columns, y + dy * rows, 0 * rows]]])
        heat = self.reshape(inputs[0], f"{name}.heat", (1, joints, 1, cells))
        share = self.node("Softmax", [heat], f"{name}.share", (1, joints, 1, cells), axis=3)
        votes = self.reshape(inputs[1], f"{name}.votes", (1, joints, 3, cells))
        placed = self.node("Add", [votes, places], f"{name}.placed", (1, joints, 3, cells))
        # A product of matrices, not a sum of products: pnnx loses a sum's axis.
        weights = self.reshape(share, f"{name}.weights", (1, joints, cells, 1))
        mean = self.node("MatMul", [placed, weights], f"{name}.mean", (1, joints, 3, 1))
        return self.reshape(mean, name, (1, 3 * joints))

    def back_project(self, name, layer, inputs, tensors):
        joints = self.shapes[inputs[0]][1] // 3
        places = self.reshape(inputs[0], f"{name}.places", (1, joints, 3))
        slopes = self.slice(places, f"{name}.slopes", 0, 2)
        log_z = self.slice(places, f"{name}.log_z", 2, 3)
        z = self.node("Exp", [log_z], f"{name}.z", (1, joints, 1))
        xy = self.node("Mul", [slopes, z], f"{name}.xy", (1, joints, 2))
        points = self.node("Concat", [xy, z], f"{name}.points", (1, joints, 3), axis=2)
        return self.reshape(points, name, (1, 3 * joints))

    def slice(self, value, name, start, end):
        """Columns `start` to `end` of a table [1, rows, columns]."""
        bounds = [self.constant(f"{name}.{kind}", [at], np.int64)
                  for kind, at in (("start", start), ("end", end), ("axis", 2))]
        return self.node("Slice", [value, *bounds], name, (*self.shapes[value][:2], end - start))

    def overlay(self, image, mask, rule):
        """The joint network's input."""
        if rule["rule"] == "threshold":
            at = self.constant("overlay.threshold", rule["threshold"])
            self.node("GreaterOrEqual", [mask, at], "overlay.robot", self.shapes[mask])
            mask = self.node("Cast", ["overlay.robot"], "overlay.mask", self.shapes[mask], to=TensorProto.FLOAT)
        elif rule["rule"] == "ramp":
            slope = 1 / (rule["high"] - rule["low"])
            factor, summand = self.constant("overlay.slope", slope), self.constant("overlay.offset", -slope * rule["low"])
            scaled = self.node("Mul", [mask, factor], "overlay.scaled", self.shapes[mask])
            shifted = self.node("Add", [scaled, summand], "overlay.shifted", self.shapes[mask])
            bounds = [self.constant(f"overlay.{kind}", value) for kind, value in (("least", 0.0), ("most", 1.0))]
            mask = self.node("Clip", [shifted, *bounds], "overlay.share", self.shapes[mask])
        return self.node("Mul", [image, mask], "overlay", self.shapes[image])


def cascade(description, tensors):
    """The ONNX model of both networks, with the overlay between them."""
    graph = Graph()
    size = (description["input"]["height"], description["input"]["width"])
    image = "image"
    graph.shapes[image] = (1, 3, *size)
    mask = graph.network("mask", description["mask_network"]["layers"], "image", image, tensors)
    graph.node("Identity", [mask], "mask", graph.shapes[mask])
    overlay = graph.overlay(image, mask, description["overlay"])
    joints = graph.network("joint", description["joint_network"]["layers"], "overlay", overlay, tensors)
    graph.reshape(joints, "joints", (1, len(description["joints"]), 3))

    def info(name):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, graph.shapes[name])

    model = helper.make_model(
        helper.make_graph(graph.nodes, "whereabot", [info(image)], [info("mask"), info("joints")], graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="whereabot")
    onnx.checker.check_model(model, full_check=True)
    return model


def export(weights, path):
    """Writes the ONNX file of a model file; says the description."""
    description, tensors = read_model(weights)
    onnx.save(cascade(description, tensors), Path(path))
    return description
