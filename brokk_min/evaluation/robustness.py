"""Robustness: other machines and encoders, and motion near singularities."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from brokk_min.actuator import Encoder
from brokk_min.evaluation import baselines, claims, metrics
from brokk_min.evaluation.sequences import Commands, shorten, singular_sequences
from brokk_min.jacobian import manipulability, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import Array, Machine, read_encoder, valve_opening

# Who drives changed machines.
ROBUST = ("rl", "rl_dither", "rl_paper", "jacobian_pid_k0.1", *baselines.WITH_INTEGRAL)
Sensor = Callable[[np.random.Generator], Encoder]  # makes the encoders of one rollout


def noisy_encoder(rng: np.random.Generator) -> Encoder:
    """Encoders with normal noise of one count."""

    def read(machine: Machine, q: Array) -> Array:
        noise = machine.encoder_step * rng.standard_normal(q.shape)
        return read_encoder(machine, q + noise)

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


def with_dead_zone(machine: Machine, dead_zone: float) -> Machine:
    """The machine with one dead zone for all joints, both ways."""
    none = {"dead_zone_up": None, "dead_zone_down": None}
    joints = tuple(replace(joint, **none) for joint in machine.joints)  # type: ignore[arg-type]
    return replace(machine, joints=joints, dead_zone=dead_zone, largest_dead_zone=0.0)


def scale_valves(machine: Machine, positive: float, negative: float) -> Machine:
    """The machine with other cylinder speeds in the positive and the negative direction."""
    joints = []
    for joint in machine.joints:
        up, down = positive * joint.speed_positive, negative * joint.speed_negative
        joints.append(replace(joint, speed_positive=up, speed_negative=down))
    return replace(machine, joints=tuple(joints))


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


def pump_flow_ratio(machine: Machine, u: Array) -> Array:
    """Flow that commands (..., n) demand, over the pump's flow, (...). Paper: Sec. 4.2"""
    opening = valve_opening(u, machine.dead_zones)
    K = np.where(opening > 0, machine.column("speed_positive"), machine.column("speed_negative"))
    flow = np.abs(machine.column("cylinder_area") * K * opening).sum(axis=-1)  # sum |A v*|
    return np.asarray(flow / machine.pump_flow)


def robustness(
    machine: Machine,
    controllers: metrics.Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Mean velocity error [m/s] with its interval, by variation and controller. Paper: Sec. 4.2

    Also "supply_demand", the largest `pump_flow_ratio`; "supply_limits", the fraction of ticks
    at which it is above 1; "rl_less", the policy's error less a baseline's on the same starts.
    """
    error = "velocity_error_mean"
    result: dict[str, dict[str, dict[str, Any]]] = {}
    for name, (plant, sensor) in variations(machine).items():
        runs, traces = metrics.evaluate(plant, controllers, sequences, starts, seed, sensor=sensor)
        result[name] = {}
        for controller in controllers:
            u = np.array([traces[controller, sequence.name].u for sequence in sequences])
            ratio = pump_flow_ratio(plant, u)
            row: dict[str, Any] = dict(
                metrics.mean_interval(metrics.by_start(runs, controller, "all", error))
            )
            row["supply_demand"] = float(ratio.max())
            row["supply_limits"] = float((ratio > 1).mean())
            if "rl" in controllers and controller != "rl":
                row["rl_less"] = metrics.paired_difference(runs, "rl", controller, error)["all"]
            result[name][controller] = row
    return result


def near_singularities(
    machine: Machine, controllers: metrics.Controllers, starts: Array, seconds: float, seed: int
) -> tuple[dict[str, Any], dict[str, list[claims.Claim]], metrics.Traces]:
    """Runs of `claims.singular_controllers` from extended starts: JSON, claims and traces.

    The JSON has the "manipulability" and the "least" singular value [m/rad] at each start. All are
    empty without starts. Paper: Fig. 6a, 6e, 6f
    """
    if not len(starts):
        return {"summary": {}, "claims": {}}, {}, {}
    commands = shorten(machine, singular_sequences(machine, starts), seconds)
    runs, traces = metrics.evaluate(machine, controllers, commands, starts, seed)
    w0 = manipulability_threshold(machine)
    J = jacobian(forward_kinematics(machine, starts))[..., machine.driven]
    goals = {s.name: s.for_starts(machine, starts) for s in commands}
    speed = {}
    for name in controllers:
        fractions = np.array(
            [claims.speed_fraction(machine, w0, traces[name, s], goals[s]) for s in goals]
        )
        speed[name] = metrics.mean_where(np.isfinite(fractions), fractions)
    policies: list[str] = [name for name in ("rl", "rl_paper") if name in speed]
    singular = {name: claims.singular_claims(name, runs, speed) for name in policies}
    results = {
        "summary": metrics.summary(runs),
        "claims": {name: [c.to_json() for c in every] for name, every in singular.items()},
        "w0": w0,
        "manipulability": manipulability(J).tolist(),
        "least": np.linalg.svd(J, compute_uv=False)[:, -1].tolist(),
    }
    return results, singular, traces
