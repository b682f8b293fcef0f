"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.actuator import INDICATOR_SCALE, REST_AFTER
from brokk_min.env import COMPENSATION, observation_scale
from brokk_min.identification.files import require, whole_file
from brokk_min.learning.policy import Policy, contract
from brokk_min.machine import Array, Machine


def export_onnx(path: Path, policy: Policy, machine: Machine) -> None:
    """Write a policy as one ONNX file: `observation` (batch, obs) in, `action` out.

    The other program does the rest, with the numbers in the metadata: `env.features`, whose open
    indicator is tanh(|opening| / `indicator_scale`), `env.action_to_pwm` (`dead_zone`,
    `pwm_limit`, `ramp`), and after `rest_s` of a zero goal (null: never) the rule of
    `actuator.command_at_rest`: valves alternate by `rest_opening` beyond `rest_zones`, up and down
    by joint; 0 for closed ones.
    ValueError: the package onnx is not installed.
    """
    helper = require("onnx.helper", "export")
    info = helper.make_tensor_value_info
    float32 = require("onnx", "export").TensorProto.FLOAT
    obs = info("observation", float32, ["batch", len(policy.weights[0])])
    action = info("action", float32, ["batch", len(policy.weights[-1])])
    nodes, arrays = layers(policy.weights)
    graph = helper.make_graph(nodes, "policy", [obs], [action], arrays)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    mean, scale = observation_scale(machine, policy.paper)
    metadata = {
        **contract(machine, policy.paper),
        "mean": mean.tolist(),
        "scale": scale.tolist(),
        "indicator_scale": INDICATOR_SCALE,
        "ramp": COMPENSATION,
        "rest_s": None if policy.valves == "open" else REST_AFTER[policy.valves],
        "rest_zones": machine.dead_zones.tolist(),
        "rest_opening": machine.dither if policy.valves == "dither" else 0.0,
    }
    helper.set_model_props(model, {name: json.dumps(value) for name, value in metadata.items()})
    require("onnx.checker", "export").check_model(model, full_check=True)
    with whole_file(path) as file:
        file.write(model.SerializeToString())


def layers(weights: Sequence[Array]) -> tuple[list[Any], list[Any]]:
    """Nodes and weights of x W + b, with ELU between layers, from w, b of each layer."""
    make_node = require("onnx.helper", "export").make_node
    from_array = require("onnx.numpy_helper", "export").from_array
    nodes = []
    arrays = []
    source = "observation"
    for i, (w, b) in enumerate(zip(weights[::2], weights[1::2], strict=True)):
        arrays += [from_array(w.astype(np.float32), f"w{i}")]
        arrays += [from_array(b.astype(np.float32), f"b{i}")]
        nodes.append(make_node("Gemm", [source, f"w{i}", f"b{i}"], [f"x{i}"]))
        nodes.append(make_node("Elu", [f"x{i}"], [f"y{i}"]))
        source = f"y{i}"
    nodes.pop()  # no ELU after the last layer
    nodes[-1].output[0] = "action"
    return nodes, arrays
