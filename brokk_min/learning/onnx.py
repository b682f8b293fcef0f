"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from pathlib import Path

import torch

from brokk_min._files import require_package, whole_file
from brokk_min.learning.policy import INTERFACES, Policy, contract

TABLES = {"paper": "brokk_min/env.py", "beyond": "brokk_min/beyond/interface.py"}


def export_onnx(path: Path, policy: Policy) -> None:
    """Write a policy as one ONNX file: `observation` (batch, obs) in, `action` (batch, driven) out.

    The other program makes the observation and the command, as the policy's `env.Interface` does;
    see examples/run_onnx.py. What it must agree with is in the metadata, as JSON by name.
    ValueError: the package onnxscript is not installed.
    """
    require_package("onnxscript", "export")
    layers: list[torch.nn.Module] = []
    for w, b in zip(policy.weights[::2], policy.weights[1::2], strict=True):
        linear = torch.nn.Linear(*w.shape)
        linear.weight.data, linear.bias.data = torch.tensor(w.T), torch.tensor(b)
        layers += [linear, torch.nn.ELU()]
    program = torch.onnx.export(
        torch.nn.Sequential(*layers[:-1]).eval(),  # no ELU after the last layer
        (torch.zeros(2, len(policy.weights[0])),),
        input_names=["observation"],
        output_names=["action"],
        dynamic_shapes=({0: torch.export.Dim("batch")},),
        verbose=False,
    )
    assert program is not None
    mean, scale = INTERFACES[policy.interface].scale(policy.machine)
    told = contract(policy.machine) | {"interface": policy.interface}
    told |= {"mean": mean.tolist(), "scale": scale.tolist()}
    told["observation"] = f"less mean, over scale; {TABLES[policy.interface]} has its table"
    told["action"] = "of pwm_limit / 127 of each driven joint, cut at 1 and rounded to counts"
    told["geometry_columns"] = ["a", "alpha", "d", "theta", "q_min", "q_max", "kind"]  # m and rad
    program.model.metadata_props.update({name: json.dumps(value) for name, value in told.items()})
    with whole_file(path) as file:
        file.write(program.model_proto.SerializeToString())
