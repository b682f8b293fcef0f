"""Robustness: other machines and encoders, and motion near singularities."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from brokk_min.env import Encoder
from brokk_min.evaluation.baselines import PAPER_BASELINES
from brokk_min.evaluation.metrics import (
    Controllers,
    Mean,
    by_start,
    evaluate,
    finite,
    mean_interval,
)
from brokk_min.evaluation.rollout import Trace
from brokk_min.evaluation.sequences import Commands, along, goals_of, shorten
from brokk_min.jacobian import JacobianController, manipulability, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Array, Machine, read_encoder

Sensor = Callable[[np.random.Generator], Encoder]  # makes the encoders of one rollout
STEADY = 0.6  # s after a change of goal, assumed: as long as the policy's history


def noisy_encoder(rng: np.random.Generator) -> Encoder:
    """Encoders with normal noise of one count."""

    def read(machine: Machine, q: Array) -> Array:
        return read_encoder(machine, q + machine.encoder_step * rng.standard_normal(q.shape))

    return read


def lossy_encoder(rng: np.random.Generator) -> Encoder:
    """Encoders that lose one sample in 20 of all joints of a machine: the last one stays."""
    last: Array | None = None

    def read(machine: Machine, q: Array) -> Array:
        nonlocal last
        lost = rng.random((*q.shape[:-1], 1)) < 0.05
        angles = read_encoder(machine, q)
        last = angles if last is None else np.where(lost, last, angles)
        return last

    return read


def scale_valves(machine: Machine, up: float, down: float) -> Machine:
    """The machine with other cylinder speeds up and down."""
    speeds = machine.cylinder_speeds * [up, down]
    pairs = zip(machine.joints, speeds.tolist(), strict=True)
    return replace(machine, joints=tuple(replace(j, cylinder_speed=tuple(s)) for j, s in pairs))


def with_dead_zone(machine: Machine, zone: float) -> Machine:
    """The machine with one dead zone for all joints, both ways."""
    joints = tuple(replace(joint, dead_zone=(zone, zone)) for joint in machine.joints)
    return replace(machine, joints=joints)


def variations(machine: Machine) -> dict[str, tuple[Machine, Sensor]]:
    """Machines and encoders unknown to the controllers, by name; all numbers assumed."""
    machines = {
        "nominal": machine,
        "supply flow -20 %": replace(machine, pump_flow=0.8 * machine.pump_flow),
        "supply flow -70 %": replace(machine, pump_flow=0.3 * machine.pump_flow),
        "valve gain -20 %": scale_valves(machine, 0.8, 0.8),
        "valve gain +20 %": scale_valves(machine, 1.2, 1.2),
        "up -15 %, down +15 %": scale_valves(machine, 0.85, 1.15),
        "dead zone 5 %": with_dead_zone(machine, 0.05),
        "dead zone 10 %": with_dead_zone(machine, 0.10),
        "delay +25 ms": replace(machine, delay=machine.delay + 0.025),
        "delay +50 ms": replace(machine, delay=machine.delay + 0.050),
    }
    return {
        **{name: (varied, lambda rng: read_encoder) for name, varied in machines.items()},
        "encoder noise of a count": (machine, noisy_encoder),
        "one sample in 20 lost": (machine, lossy_encoder),
    }


def robustness(
    machine: Machine,
    controllers: Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
) -> dict[str, dict[str, Mean]]:
    """Mean velocity error [m/s] with its interval, by variation and controller. Paper: Sec. 4.2"""
    result: dict[str, dict[str, Mean]] = {}
    for name, (varied, sensor) in variations(machine).items():
        runs, _ = evaluate(varied, controllers, sequences, starts, seed, sensor=sensor)
        errors = {c: by_start(runs, c, "all", "velocity_error_mean") for c in controllers}
        result[name] = {c: mean_interval(error) for c, error in errors.items()}
    return result


def singular_sequence(machine: Machine, starts: Array) -> Commands:
    """The axis pattern along the direction in which the tool at each start can hardly move.

    It is the left singular vector of the Jacobian's least singular value, its largest component
    positive. Goals are half of the pattern's (assumed): at full speed the joints' own speed limits
    the tool near a singularity, and not damping. Paper: Fig. 6e, Fig. 6f
    """
    J = jacobian(forward_kinematics(machine, starts))[..., machine.driven]
    direction = np.linalg.svd(J).U[..., -1]  # (starts, 3)
    largest = np.abs(direction).argmax(axis=-1)[:, None]
    direction = direction * np.sign(np.take_along_axis(direction, largest, axis=-1))
    goals = np.stack([goals_of(machine, along(0.5 * vector)) for vector in direction], axis=1)
    return Commands("hardest", goals)


def near_singularities(
    machine: Machine,
    policies: Controllers,
    pids: Mapping[str, JacobianController],
    starts: Array,
    seconds: float,
    seed: int,
) -> dict[str, Any]:
    """Speed and jerk of policies and of the paper's two PIDs from extended starts, for JSON.

    By controller and start: "speed" is `speed_fraction`, "jerk" [m/s^3]. Empty without starts. The
    PIDs have the same gains, and damping with k = 0.1 and 0.05. Paper: Fig. 6a, 6e, 6f
    """
    if not len(starts):
        return {}
    controllers = {**policies, **{name: pids[name] for name in PAPER_BASELINES}}
    (commands,) = shorten(machine, [singular_sequence(machine, starts)], seconds)
    runs, traces = evaluate(machine, controllers, [commands], starts, seed)
    speed, jerk = {}, {}
    for name in controllers:
        fraction = speed_fraction(machine, traces[name, commands.name], commands.goals)
        speed[name] = [finite(x) for x in fraction]
        jerk[name] = by_start(runs, name, "all", "jerk_rms").tolist()
    return {"starts": starts.tolist(), "speed": speed, "jerk": jerk}


def speed_fraction(machine: Machine, trace: Trace, goals: Array) -> Array:
    """Speed along the goal over the goal's near singularities, (num,); NaN: never there.

    Of ticks at which Nakamura's damping acts and the goal [m/s] (T, num, 3) held for `STEADY`.
    """
    ticks = round(STEADY * machine.rate)
    changed = np.any(np.diff(goals, axis=0, prepend=0 * goals[:1]), axis=-1)
    since = [changed[max(0, t - ticks + 1) : t + 1].any(axis=0) for t in range(len(goals))]
    J = jacobian(forward_kinematics(machine, trace.q))[..., machine.driven]
    near = (
        ~np.array(since)
        & (manipulability(J) < manipulability_threshold(machine))
        & goals.any(axis=-1)
    )
    along_goal = np.sum(np.sum(trace.v_tool * goals, axis=-1) * near, axis=0)
    square = np.sum(np.sum(goals * goals, axis=-1) * near, axis=0)
    return np.where(near.any(axis=0), along_goal / np.maximum(square, 1e-12), np.nan)
