"""The classical controllers that the policy is compared with: gains, tuning, and files of gains."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from brokk_min import jacobian
from brokk_min._files import SHIPPED, constants, expect_same, expected, write_json
from brokk_min.actuator import PLANT, ActuatorNet, Plant
from brokk_min.beyond import interface, strong_pid
from brokk_min.beyond.strong_pid import StrongGains, StrongPID, static_map
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.net_file import fingerprint, select_nets
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.learning.policy import load_policy
from brokk_min.machine import Array, Controller, Machine, is_row, require
from brokk_min.settings import TaskConfig

BY_HAND, RAW = "pid_by_hand", "pid_by_hand_raw"
OPTIMISED = "jacobian_pid_k0.1"
STRONGEST = "jacobian_pid_ff_integral"
TUNED = {OPTIMISED: 1, STRONGEST: 2}  # by `tune`, with so many times the generations below
Baselines = dict[str, JacobianController]  # by name
Effort = tuple[int, int, float]  # of tuning: generations, runs of a candidate, their length [s]
EFFORT: Effort = (40, 30, 20.0)  # assumed
CANDIDATES = 24  # of each generation
SPREAD = 0.12  # of the first candidates, as a fraction of the roots of the ranges, assumed
OVERSHOOT = 0.2  # of a step of velocity, that tuning by hand allows
LOOK_RUNS, LOOK_SECONDS = 16, 10.0  # motions that a training looks at, and how long each is [s]
LOOK_SEED = 1  # of these motions; the PIDs are tuned on those of seed 0, and scored ones are others
RANGES = {  # that `tune` searches (assumed); each driven joint has its own kp, ki and kd
    "kp": (0.0, 4.0),  # valve opening per rad/s
    "ki": (0.0, 30.0),  # valve opening per rad
    "kd": (0.0, 0.3),  # valve opening per rad/s^2
    "feedback": (0.01, 1.0),  # K = feedback * I of eq3, positive definite
    "min_opening": (0.0, 0.06),  # least valve opening
    "integral_feedback": (0.0, 3.0),  # K_I of the error integral [1/s]
    "start_boost": (0.0, 4.0),  # of openings of valves that were closed
    "start_time": (0.0, 0.5),  # for which they are wider [s]
}


def baselines(
    machine: Machine, net: ActuatorNet, gains: Mapping[str, Any] | None = None
) -> Baselines:
    """PIDs with the paper's structure, and the strongest, by default with `first_gains`.

    The raw one does not compensate the dead zone. Of the paper's two k they have 0.1; by 0.05 every
    printed digit is the same, because damping acts near singularities alone. Paper: Sec. 4.2
    """
    w0 = manipulability_threshold(machine)
    gains = gains or first_gains(machine)
    feedforward = static_map(machine, select_nets(machine, net))
    return {
        RAW: JacobianController(with_dead_zones(machine, 0), gains[RAW], 0.1, w0),
        BY_HAND: JacobianController(machine, gains[BY_HAND], 0.1, w0),
        OPTIMISED: JacobianController(machine, gains[OPTIMISED], 0.1, w0),
        STRONGEST: StrongPID(machine, gains[STRONGEST], 0.1, w0, feedforward),
    }


def first_gains(machine: Machine, plant: Plant = PLANT) -> dict[str, Any]:
    """Gains by hand, and those from which `tune` begins."""
    one, n = np.ones(1), np.ones(len(machine.driven))
    pid = gains_by_hand(machine, machine, plant)
    few = {"kp": 0.2 * n, "ki": 0.5 * n, "kd": 0.02 * n, "feedback": 0.1 * one}
    few |= {"min_opening": 0.015 * one, "integral_feedback": 1.0 * one}
    return {
        RAW: gains_by_hand(machine, with_dead_zones(machine, 0), plant),
        BY_HAND: pid,
        OPTIMISED: replace(pid, kd=0.05 * n),
        STRONGEST: StrongGains(**few, start_boost=2.0 * one, start_time=0.26 * one),
    }


def with_dead_zones(machine: Machine, zone: float) -> Machine:
    """The machine with other dead zones, up and down of all joints, of full command."""
    joints = (replace(joint, dead_zone=(zone, zone)) for joint in machine.joints)
    return replace(machine, joints=tuple(joints))


@dataclass(frozen=True)
class JointStep(JacobianController):
    """The PIDs of the joints in a step trial: a joint is to move, and then to stand."""

    q_dot_goal: Array  # of the driven joints [rad/s], (num, n_driven)

    def joint_velocities(self, v: Array, q: Array, last: Array) -> Array:
        """The joint's velocity while the goal of the tool `v` is not zero."""
        return self.q_dot_goal * v.any(axis=-1, keepdims=True)


def gains_by_hand(machine: Machine, known: Machine, plant: Plant = PLANT) -> Gains:
    """Gains by one rule of thumb, joint by joint, from step trials on the plant.

    P is raised until a velocity overshoots by more than `OVERSHOOT`, and halved; then I is raised
    as long as none does. There is no D. `known` is what the controller takes for the machine.
    """
    tried = np.geomspace(0.05, 50, 70)  # 10 % apart
    kp, ki = np.zeros((2, len(machine.driven)))
    for i in range(len(kp)):
        last = partial(last_before_overshoot, machine, known, plant, i)
        kp[i] = tried[last(tried, 0 * tried)] / 2
        ki[i] = tried[last(0 * tried + kp[i], tried)]
    return Gains(kp, ki, 0 * kp, np.full(1, 0.4))


def last_before_overshoot(
    machine: Machine, known: Machine, plant: Plant, index: int, kp: Array, ki: Array
) -> int:
    """Of rising gains (rows,) of one driven joint the last row before one overshoots too much.

    A step goes from rest amid all ranges to a third of the joint's fastest motion up, or down, for
    2 s, and back to rest.
    """
    joint, alone = machine.driven[index], np.eye(len(machine.driven))[index]
    fastest = machine.column("q_dot_up")[joint], -machine.column("q_dot_down")[joint]
    goal = np.repeat(fastest, len(kp)) / 3  # (2 rows,)
    p, i = (np.outer(np.tile(gain, 2), alone) for gain in (kp, ki))
    gains = Gains(p, i, 0 * p, np.zeros((len(p), 1)))
    step = JointStep(known, gains, 0.0, 1.0, np.outer(goal, alone))
    middle = np.tile((machine.column("q_min") + machine.column("q_max")) / 2, (len(p), 1))
    ticks = round(2 * machine.rate)
    goals = np.repeat([1.0, 0.0], ticks)[:, None, None] * np.ones((len(p), 3))  # move, stand
    trace = rollout(machine, step, middle, goals, 0.0, np.random.default_rng(0), plant)
    velocity = trace.q_dot[..., joint] / goal
    over = np.maximum(velocity.max(axis=0) - 1, -velocity[ticks:].min(axis=0))
    too_much = (over.reshape(2, -1) > OVERSHOOT).any(axis=0)
    return max(0, int(np.argmax([*too_much, True])) - 1)


def tuning_cost(
    controller: JacobianController, runs: tuple[Array, Array], seed: int, plant: Plant, gains: Gains
) -> Array:
    """Mean |v_goal - v_tool| [m/s] with each row of gains (rows, ...): (rows,).

    `runs` are starts [rad] (num, n) and goals [m/s] (T, num, 3) of `tuning_set`.
    """
    rows, num = len(gains.kp), len(runs[0])
    repeated = {name: np.repeat(array, num, axis=0) for name, array in vars(gains).items()}
    batch = replace(controller, gains=replace(gains, **repeated))
    start, goals = np.tile(runs[0], (rows, 1)), np.tile(runs[1], (1, rows, 1))
    rng = np.random.default_rng(seed)
    trace = rollout(controller.machine, batch, start, goals, TaskConfig.noise, rng, plant)
    error = np.linalg.norm(goals - trace.v_tool, axis=-1)  # (T, rows * num)
    return np.asarray(error.mean(axis=0).reshape(rows, num).mean(axis=1))


def tune(gains: Gains, cost: Callable[[Any], Array], seed: int, generations: int) -> Any:
    """Gains of the kind of `gains` of least `cost`, which is that (rows,) of rows of gains.

    SciPy's differential evolution over x in gain = low + x^2 (high - low), so that small gains of a
    wide range are searched as finely as large ones. The first candidates are near `gains`.
    """
    from scipy.optimize import Bounds, differential_evolution  # slow to import

    sizes = [array.size for array in vars(gains).values()]
    low, high = np.repeat([RANGES[name] for name in vars(gains)], sizes, axis=0).T
    start = np.sqrt(np.clip((np.concatenate([*vars(gains).values()]) - low) / (high - low), 0, 1))
    rng = np.random.default_rng(seed)
    candidates = np.clip(rng.normal(start, SPREAD, (CANDIDATES, len(start))), 0, 1)
    candidates[0] = start

    def gains_of(x: Array) -> Any:
        rows = low + x.T**2 * (high - low)
        return type(gains)(*np.split(rows, np.cumsum(sizes)[:-1], axis=-1))

    with tqdm(total=generations + 1, desc="tune", unit="generation", disable=None) as bar:

        def objective(x: Any) -> Any:
            bar.update()
            return cost(gains_of(x))

        result = differential_evolution(
            objective, Bounds(0 * start, 0 * start + 1), init=candidates, rng=seed,
            maxiter=generations, mutation=(0.4, 0.9), tol=0, polish=False,
            vectorized=True, updating="deferred",
        )  # fmt: skip
    return gains_of(result.x)


def tuned_baselines(
    machine: Machine, net: ActuatorNet, effort: Effort, seed: int, plant: Plant = PLANT
) -> Baselines:
    """The `baselines`, tuned on the `plant` itself, which favours them: policies learn on nets."""
    generations, num, seconds = effort
    runs = tuning_set(machine, num, seed, seconds)
    gains = first_gains(machine, plant)
    first = baselines(machine, net, gains)
    for name, factor in TUNED.items():
        cost = partial(tuning_cost, first[name], runs, seed, plant)
        gains[name] = tune(gains[name], cost, seed, factor * generations)
    return baselines(machine, net, gains)


def beside_pids(machine: Machine, pids: Baselines) -> Callable[[Controller], str]:
    """A function that says a policy's mean |v_goal - v_tool| [m/s] beside those of three PIDs.

    All drive the analytic plant along the same motions, which are neither tuned on nor scored.
    """
    start, goals = tuning_set(machine, LOOK_RUNS, LOOK_SEED, LOOK_SECONDS)

    def error(controller: Controller) -> str:
        rng = np.random.default_rng(LOOK_SEED)
        trace = rollout(machine, controller, start, goals, TaskConfig.noise, rng)
        return f"{np.linalg.norm(goals - trace.v_tool, axis=-1).mean():.4f}"

    by_hand, optimised, strongest = (error(pids[name]) for name in (BY_HAND, OPTIMISED, STRONGEST))
    pid = f"the PID tuned by hand has {by_hand}, the optimised one {optimised}"
    return lambda policy: f"{error(policy)} m/s; {pid}, the strongest {strongest}"


def gains_metadata(machine: Machine, net: ActuatorNet) -> dict[str, Any]:
    """What gains belong to: a machine, by its name, nets, by their fingerprint, and constants."""
    about = {"machine": machine.name, "actuator": fingerprint(net)}
    return about | {"constants": constants(interface, jacobian, strong_pid)}


def write_gains(path: Path, pids: Baselines, meta: Mapping[str, Any]) -> None:
    """Write gains as `read_gains` reads them; `meta` includes `gains_metadata`."""
    every = {name: vars(pid.gains) for name, pid in pids.items()}
    gains = {name: {k: array.tolist() for k, array in of.items()} for name, of in every.items()}
    write_json(path, {"meta": meta, "gains": gains})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> Baselines:
    """The baselines with gains of a file; ValueError: those of another machine or other nets."""
    with expected(path, "gains of `reproduce` or `evaluate --save-gains`"):
        file = json.loads(path.read_text("utf-8"))
        expect_same(path, file["meta"], gains_metadata(machine, net))
        gains, every = {}, (RAW, BY_HAND, *TUNED)
        missing = [name for name in every if name not in file["gains"]]
        require(not missing, str(path), f"gains of {', '.join(every)}", f"none of {missing}")
        for name, row in file["gains"].items():
            kind = StrongGains if name == STRONGEST else Gains
            gains[name] = kind(**{key: np.array(values) for key, values in row.items()})
            for key, values in row.items():
                numbers = len(machine.driven) if key in ("kp", "ki", "kd") else 1
                fits = is_row(values, numbers) and min(values) >= 0
                require(fits, f"{path}: {name}: {key}", f"{numbers} numbers from 0 on", values)
        return baselines(machine, net, gains)


def load_pids(machine: Machine, gains: Path, net: ActuatorNet) -> Baselines:
    """The PIDs with the gains of a file for these nets; the package's keep the package's nets."""
    if gains.resolve().parent == (SHIPPED / machine.name).resolve():
        net = load_policy(gains.with_name("policy.npz"), machine).net
    return read_gains(gains, machine, net)
