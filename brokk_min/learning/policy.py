"""A trained policy as a file and a function; no torch, so that it runs wherever the machine is."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import ActuatorNet, Valves, command_at_rest
from brokk_min.env import Measured, action_to_pwm, features, observation_scale
from brokk_min.identification import files
from brokk_min.identification.formats import POLICY_ARRAYS, POLICY_HEADER, check_fields
from brokk_min.identification.net_file import LARGEST_NET, net_arrays, net_from_arrays, select_nets
from brokk_min.machine import Array, Machine

FORMAT = 4  # of policy files
# Files of `reproduce`: our policy and the paper's.
POLICIES = {"rl": "policy.npz", "rl_paper": "policy_paper.npz"}


@dataclass(frozen=True)
class Policy:
    """The actor: standardised observation in, mean action out. Paper: Sec. 3.4 (256-128-64, ELU)"""

    training: Mapping[str, Any]  # seed and settings that made it
    weights: tuple[Array, ...]  # w, b of each layer, w (inputs, outputs)
    net: ActuatorNet  # the simulation it was trained in, kept with it
    paper: bool = False  # does it take observation and actions of the paper's agent?
    valves: Valves = "closed"  # at rest, or "dither", "open": see `actuator.command_at_rest`

    def act(self, observation: Array) -> Array:
        """Actions (..., n_driven), not clipped, for observations (..., obs) of `env.features`.

        ValueError: a wrong shape, or an observation that is not finite.
        """
        x: Array = np.asarray(observation, np.float32)
        size = len(self.weights[0])
        if x.shape[-1:] != (size,):
            raise ValueError(f"observation: expected (..., {size}), got {x.shape}")
        if not np.isfinite(x).all():
            raise ValueError("observation: expected finite numbers, got nan or inf")
        layers = list(zip(self.weights[::2], self.weights[1::2], strict=True))
        for w, b in layers[:-1]:
            x = x @ w + b
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))  # ELU
        w, b = layers[-1]
        return np.asarray(x @ w + b)


@dataclass(frozen=True)
class PolicyController:
    """A policy as an `evaluation.rollout.Controller`.

    While the tool rests the rule of `actuator.command_at_rest` for its `valves` holds.
    """

    machine: Machine
    policy: Policy

    def start(self, num: int) -> NDArray[np.int64]:
        """Ticks for which the goal has been zero, (num,)."""
        return np.zeros(num, np.int64)

    def __call__(
        self, measured: Measured, ticks: NDArray[np.int64]
    ) -> tuple[Array, NDArray[np.int64]]:
        """Commands u (num, n), and the ticks of `start` one tick on."""
        machine, paper = self.machine, self.policy.paper
        action = self.policy.act(features(machine, measured, paper))
        u = action_to_pwm(machine, action, paper)
        u, _, ticks = command_at_rest(machine, self.policy.valves, u, measured.v_goal, ticks)
        return u, ticks


def policy_controllers(
    machine: Machine, policies: Mapping[str, Policy]
) -> dict[str, PolicyController]:
    """Controllers of `POLICIES` by name; "rl_dither" is "rl" with another rule for valves at rest.

    Training with that rule brings 1 % (docs/log.md), so one policy serves both classes.
    """
    rl = policies["rl"]
    closed = replace(rl, valves="closed") if rl.valves == "dither" else rl
    every = {"rl": closed, "rl_dither": replace(rl, valves="dither")}
    every |= {name: one for name, one in policies.items() if name != "rl"}
    return {name: PolicyController(machine, one) for name, one in every.items()}


def contract(machine: Machine, paper: bool) -> dict[str, Any]:
    """What training and deployment must agree on; kept in the file and checked by `load_policy`."""
    driven = machine.driven
    observed = {  # by our observation alone, beside what all have
        "dead_zones": machine.dead_zones[driven].tolist(),
        "weights": machine.column("weight")[driven].tolist(),
    }
    return {
        "paper": paper,
        "machine": machine.name,
        "joints": list(machine.names),
        "driven": [machine.names[i] for i in driven],
        "history": machine.history,
        "rate": machine.rate,
        "velocity_samples": machine.velocity_samples,
        "pwm_limit": machine.pwm_limit,
        "dead_zone": machine.dead_zone,
        "geometry": [
            [j.a, j.alpha, j.d, j.theta, j.q_min, j.q_max] + [j.kind] * (j.kind == "prismatic")
            for j in machine.joints
        ],
        **({} if paper else observed),
    }


def save_policy(path: Path, policy: Policy, machine: Machine) -> None:
    """Write a policy as one `.npz`: weights, normalisation and its nets, plus a JSON header."""
    header = {
        "format": FORMAT,
        "kind": "policy",
        "contract": contract(machine, policy.paper),
        "training": dict(policy.training),
        "valves": policy.valves,
    }
    mean, scale = observation_scale(machine, policy.paper)
    arrays = {"header": np.array(json.dumps(header)), "mean": mean, "scale": scale}
    arrays |= {f"weight_{i}": weight for i, weight in enumerate(policy.weights)}
    arrays |= {f"net_{name}": array for name, array in net_arrays(policy.net).items()}
    with files.whole_file(path) as file:
        np.savez(file, **dict[str, Any](arrays))


def load_policy(path: Path, machine: Machine) -> Policy:
    """Read a policy for `machine`.

    ValueError: not a policy file, or one for another machine, joint order, history, rate or scale,
    with what was expected and what was found.
    """
    arrays = files.load_arrays(path, largest=LARGEST_NET)
    header = files.load_header(path, arrays, "policy", FORMAT)
    check_fields(path, header, POLICY_HEADER, {})
    recorded = {"paper": False, **header["contract"]}
    paper = recorded["paper"]
    wanted = contract(machine, paper)
    older = {name: wanted.get(name) for name in ("dead_zones", "weights")}  # files without them
    files.expect_same(path, {**older, **recorded}, wanted)
    mean, scale = observation_scale(machine, paper)
    check_fields(path, arrays, POLICY_ARRAYS, {"obs": len(mean), "driven": len(machine.driven)})
    for name, value in {"mean": mean, "scale": scale}.items():
        if not np.array_equal(arrays[name], value):
            raise ValueError(f"{path}: {name}: expected the machine's normalisation, got another")
    net = {name[4:]: array for name, array in arrays.items() if name.startswith("net_")}
    with files.located(path):
        return Policy(
            training=header["training"],
            weights=tuple(arrays[f"weight_{i}"] for i in range(8)),
            net=select_nets(machine, net_from_arrays(path, net, "net_")),
            paper=paper,
            valves=header.get("valves", "closed"),
        )
