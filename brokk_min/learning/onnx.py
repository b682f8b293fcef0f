"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from pathlib import Path

import torch

from brokk_min._files import require_package, whole_file
from brokk_min.learning.policy import INTERFACES, Policy, contract
from brokk_min.machine import Machine


def export_onnx(path: Path, policy: Policy, machine: Machine) -> None:
    """Write a policy as one ONNX file: `observation` (batch, obs) in, `action` (batch, driven) out.

    The other program makes the observation and the command, as the policy's `env.Interface` does;
    the machine, mean and deviation that it must agree with are in the metadata, as JSON.
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
    mean, scale = INTERFACES[policy.interface].scale(machine)
    metadata = contract(machine) | {"interface": policy.interface}
    metadata |= {"mean": mean.tolist(), "scale": scale.tolist()}
    program.model.metadata_props.update({k: json.dumps(v) for k, v in metadata.items()})
    with whole_file(path) as file:
        file.write(program.model_proto.SerializeToString())
