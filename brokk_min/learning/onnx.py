"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from pathlib import Path

import numpy as np

from brokk_min.env import COMPENSATION
from brokk_min.identification.files import require, whole_file
from brokk_min.learning.policy import STANDSTILL_TIMEOUT, Policy


def export_onnx(path: Path, policy: Policy) -> None:
    """Write a policy as one self-contained ONNX file: `observation` (batch, obs) in, `action` out.

    What follows is up to the other program: actions go through `action_to_pwm` (metadata `dead_zone`,
    `pwm_limit`, `ramp`), and valves close when the tool was to stand for `stand_s` (`policy.STANDSTILL_TIMEOUT`).

    ValueError: the package onnx is not there.
    """
    names = "onnx", "onnx.checker", "onnx.helper", "onnx.numpy_helper"
    onnx, checker, helper, numpy_helper = (require(name, "export") for name in names)
    layers = len(policy.weights) // 2
    arrays = {f"{'wb'[i % 2]}{i // 2}": weight for i, weight in enumerate(policy.weights)}
    nodes = []
    for i in range(layers):
        source = "observation" if i == 0 else f"y{i - 1}"
        target = "action" if i == layers - 1 else f"x{i}"
        nodes.append(helper.make_node("Gemm", [source, f"w{i}", f"b{i}"], [target]))
        if i < layers - 1:
            nodes.append(helper.make_node("Elu", [target], [f"y{i}"]))
    sizes = {"observation": len(policy.mean), "action": policy.weights[-1].shape[-1]}
    info = helper.make_tensor_value_info
    ends = [info(name, onnx.TensorProto.FLOAT, ["batch", size]) for name, size in sizes.items()]
    values = [
        numpy_helper.from_array(array.astype(np.float32), name) for name, array in arrays.items()
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    contract = {key: json.dumps(value) for key, value in policy.contract.items()}
    scales = {"mean": json.dumps(policy.mean.tolist()), "scale": json.dumps(policy.scale.tolist())}
    after = {
        "ramp": json.dumps(COMPENSATION),
        "stand_s": json.dumps(STANDSTILL_TIMEOUT),
    }  # see `action_to_pwm`, `PolicyController`
    helper.set_model_props(model, contract | scales | after)
    checker.check_model(model, full_check=True)
    with whole_file(path) as file:
        file.write(model.SerializeToString())
