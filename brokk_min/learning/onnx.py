"""A policy as an ONNX file, for those who run it elsewhere."""

import json
from pathlib import Path

import torch

from brokk_min._files import require_package, whole_file
from brokk_min.learning.policy import INTERFACES, Policy, contract
from brokk_min.machine import Machine


def named_blocks(machine: Machine) -> list[tuple[str, str, int]]:
    """Name, unit and size of what `env.features` reads, in its order; the newest sample is last.

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> named_blocks(BROKK_170)[1:4]
        [('v_tool', 'm/s', 3), ('q q2', 'rad', 1), ('q q1', 'rad', 13)]
    """
    H = machine.history
    unit = {joint.name: "rad" if joint.kind == "revolute" else "m" for joint in machine.joints}
    driven, locked = ([machine.names[i] for i in part] for part in (machine.driven, machine.locked))
    blocks = [("v_goal", "m/s", 3), ("v_tool", "m/s", 3)]
    blocks += [(f"q {name}", unit[name], 1) for name in locked]
    for name in driven:
        blocks += [(f"q {name}", unit[name], H), (f"q_dot {name}", f"{unit[name]}/s", H)]
    return blocks + [(f"u {name}", "of full command", H) for name in driven]


def export_onnx(path: Path, policy: Policy, machine: Machine) -> None:
    """Write a policy as one ONNX file: `observation` (batch, obs) in, `action` (batch, driven) out.

    The other program makes the observation and the command, as the policy's `env.Interface` does;
    see examples/run_onnx.py. The machine, mean and deviation that it must agree with are in the
    metadata, as JSON; so are the blocks of the paper's observation.
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
    program.model.metadata_props.update(metadata(policy, machine))
    with whole_file(path) as file:
        file.write(program.model_proto.SerializeToString())


def metadata(policy: Policy, machine: Machine) -> dict[str, str]:
    """What the other program must agree on, as JSON by name."""
    mean, scale = INTERFACES[policy.interface].scale(machine)
    told = contract(machine) | {"interface": policy.interface}
    told |= {"mean": mean.tolist(), "scale": scale.tolist()}
    told["action"] = "of pwm_limit / 127 of each driven joint, cut at 1 and rounded to counts"
    told["geometry_columns"] = ["a", "alpha", "d", "theta", "q_min", "q_max", "kind"]  # m and rad
    if policy.interface == "paper":
        told["observation"] = named_blocks(machine)
    return {name: json.dumps(value) for name, value in told.items()}
