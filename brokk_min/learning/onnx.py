"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from pathlib import Path

import torch

from brokk_min import env
from brokk_min._files import whole_file
from brokk_min.beyond import interface
from brokk_min.learning.policy import INTERFACES, Policy, contract
from brokk_min.ppo import mlp


def export_onnx(path: Path, policy: Policy) -> None:
    """Write a policy as one ONNX file: `observation` (batch, obs) in, `action` (batch, driven) out.

    The other program makes the observation and the command, as the policy's `env.Interface` does.
    What it must agree with is in the metadata, as JSON by name; examples/run_onnx.py reads it.
    """
    size = len(policy.weights[0])
    actor = mlp(size, len(policy.weights[-1]), 1.0).eval()
    for parameter, weight in zip(actor.parameters(), policy.weights, strict=True):
        parameter.data = torch.tensor(weight.T)
    program = torch.onnx.export(
        actor,
        (torch.zeros(2, size),),
        input_names=["observation"],
        output_names=["action"],
        dynamic_shapes=({0: torch.export.Dim("batch")},),
        verbose=False,
    )
    assert program is not None
    mean, scale = INTERFACES[policy.interface].scale(policy.machine)
    told = contract(policy.machine, policy.interface) | {"interface": policy.interface}
    tables = (env if policy.interface == "paper" else interface).__doc__  # of the observation
    told |= {"mean": mean.tolist(), "scale": scale.tolist(), "observation": tables}
    told["action"] = "of pwm_limit / 127 of each driven joint, cut at 1 and rounded to counts"
    told["geometry_columns"] = ["a", "alpha", "d", "theta", "q_min", "q_max", "kind"]  # m and rad
    program.model.metadata_props.update({name: json.dumps(value) for name, value in told.items()})
    with whole_file(path) as file:
        file.write(program.model_proto.SerializeToString())
