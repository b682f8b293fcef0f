"""A trained policy as a file and a function; no torch, so that it runs wherever the machine is."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min import env
from brokk_min._files import brief, constants, expect_same, expected, load_arrays, save_arrays
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond import interface, valve_nets
from brokk_min.identification.net_file import net_arrays, net_from_arrays, select_nets
from brokk_min.machine import Array, Machine, Measured, require

KIND = "policy 10"
INTERFACES = {"paper": env.PAPER, "beyond": interface.INTERFACE}  # by their names in files
POLICIES = {  # files of `reproduce`: ours, with the paper's observation, and as printed
    "rl": "policy.npz",
    "rl_paper": "policy_paper.npz",
    "rl_critic": "policy_critic.npz",
}


@dataclass(frozen=True)
class Policy:
    """The actor. It is also a `Controller` of its machine, with the agent's memory as its state."""

    machine: Machine
    training: Mapping[str, Any]  # seed and settings that made it
    weights: tuple[Array, ...]  # w, b of each layer, w (inputs, outputs)
    net: ActuatorNet  # the simulation it was trained in, kept with it
    interface: str  # its name in `INTERFACES`

    def act(self, observation: Array) -> Array:
        """Mean actions (..., n_driven), not clipped, for standardised observations (..., obs).

        Paper: Sec. 3.4 (256-128-64, ELU)
        """
        x: Array = np.asarray(observation, np.float32)
        *hidden, w_out, b_out = self.weights
        wanted = f"{len(hidden[0])} numbers of the interface {self.interface!r}"
        require(x.shape[-1:] == hidden[0].shape[:1], "observation", wanted, x.shape)
        for w, b in zip(hidden[::2], hidden[1::2], strict=True):
            x = x @ w + b
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))  # ELU
        return np.asarray(x @ w_out + b_out)

    @property
    def name(self) -> str:
        """Its name in tables, by its interface and its learner: see `evaluation.rollout.TITLES`."""
        if self.interface == "beyond":
            return "rl"
        return "rl_critic_nets" if self.training.get("recipe", {}).get("critic") else "rl_paper"

    def start(self, num: int) -> None:
        """The agent remembers nothing yet."""

    def __call__(self, measured: Measured, memory: Any) -> tuple[Array, Any]:
        """Commands u (num, n), and the memory of this tick."""
        machine, its = self.machine, INTERFACES[self.interface]
        memory = its.remember(machine, memory, measured)
        action = self.act(its.observe(machine, measured, memory))
        return its.command(machine, action, memory), memory


def contract(machine: Machine, interface_name: str) -> dict[str, Any]:
    """What training and deployment must agree on; kept in the file and checked by `load_policy`."""
    joints = machine.joints
    modules = (env,) if interface_name == "paper" else (env, interface, valve_nets)
    return {
        "machine": machine.name,
        "joints": list(machine.names),
        "driven": [machine.names[i] for i in machine.driven],
        "history": machine.history,
        "rate": machine.rate,
        "velocity_samples": machine.velocity_samples,
        "pwm_limit": machine.pwm_limit,
        "dead_zones": machine.dead_zones.tolist(),
        "geometry": [[j.a, j.alpha, j.d, j.theta, j.q_min, j.q_max, j.kind] for j in joints],
        "constants": constants(*modules),
    }


def save_policy(path: Path, policy: Policy) -> None:
    """Write a policy as one `.npz`: weights, normalisation and its nets, plus a JSON header."""
    net_header, arrays = net_arrays(policy.net)
    header = {
        "interface": policy.interface,
        "contract": contract(policy.machine, policy.interface),
        "training": dict(policy.training),
        "net": net_header,
    }
    mean, scale = INTERFACES[policy.interface].scale(policy.machine)
    weights = {f"layer_{i}": weight for i, weight in enumerate(policy.weights)}
    save_arrays(path, KIND, header, mean=mean, scale=scale, **weights, **arrays)


def load_policy(path: Path, machine: Machine) -> Policy:
    """Read a policy for `machine`; ValueError: its first difference from the machine."""
    header, arrays = load_arrays(path, KIND)
    with expected(path, "a complete policy"):
        expect_same(path, header["contract"], contract(machine, header["interface"]))
        training = header["training"]
        told = isinstance(training, dict) and isinstance(training.get("recipe", {}), dict)
        require(told, "training", "its seed and recipe", brief(training))
        mean, scale = INTERFACES[header["interface"]].scale(machine)
        fits = np.array_equal(arrays["mean"], mean) and np.array_equal(arrays["scale"], scale)
        require(fits, str(path), "the machine's tool_speed, q_dot_up and q_dot_down", "others")
        own = {"mean", "scale", *(f"layer_{i}" for i in range(8))}
        weights = tuple(arrays[f"layer_{i}"] for i in range(8))
        sizes = [len(mean), *(b.size for b in weights[1:7:2]), len(machine.driven)]
        shapes = [shape for a, b in pairwise(sizes) for shape in ((a, b), (b,))]
        for i, (shape, weight) in enumerate(zip(shapes, weights, strict=True)):
            fits = weight.shape == shape and weight.dtype == np.float32
            got = f"{weight.dtype} {weight.shape}"
            require(fits, f"layer_{i}", f"an array float32 {shape}", got)
        of_net = {name: array for name, array in arrays.items() if name not in own}
        net = select_nets(machine, net_from_arrays(path, header["net"], of_net))
        return Policy(machine, training, weights, net, header["interface"])
