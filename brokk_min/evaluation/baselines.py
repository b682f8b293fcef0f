"""The classical controllers that the policy is compared with: gains, tuning, and files of gains."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, OptimizeResult, differential_evolution
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation.feedforward import static_map
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import expect_same, read_json, write_json
from brokk_min.identification.formats import GAINS, check_fields
from brokk_min.identification.net_file import fingerprint
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.machine import Array, Machine

PAPER_BASELINES = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")
STRONGER = ("jacobian_pid_ff",)  # than the paper's: its claims are tested against this one, too
TUNING_RUNS = 12  # of the whole chain and of `evaluate`, assumed
GENERATIONS = 45
SEARCH: dict[str, Any] = {"mutation": (0.4, 0.9), "tol": 0, "polish": False}  # assumed
SEARCH |= {"vectorized": True, "updating": "deferred"}  # a whole generation at once
RANGES = {  # that `tune` searches (assumed); each driven joint has its own kp, ki and kd
    "kp": (0.0, 4.0),  # valve opening per rad/s
    "ki": (0.0, 12.0),  # valve opening per rad
    "kd": (0.0, 0.3),  # valve opening per rad/s^2
    "feedback": (0.0, 1.0),  # K = feedback * I of eq3
    "min_opening": (0.0, 0.04),  # least valve opening
}


def baselines(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The paper's two baselines and two with feed-forward, with gains set by hand. Paper: Sec. 4.2

    The last one keeps its valves open while the tool is to stand still.
    """
    w0 = manipulability_threshold(machine)
    pid = make_gains(machine, kp=1.0, ki=8.0, kd=0.05, feedback=0.4, min_opening=0.015)
    mild = make_gains(machine, kp=0.2, ki=0.5, kd=0.02, feedback=0.1, min_opening=0.015)
    feedforward = static_map(machine, net).command
    with_feedforward = JacobianController(machine, mild, 0.1, w0, feedforward)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": with_feedforward,
        "jacobian_pid_ff_awake": replace(with_feedforward, always_open=True),
    }


def make_gains(machine: Machine, **gains: ArrayLike) -> Gains:
    """Gains by the names of `RANGES`; one number stands for all joints.

    ValueError: another number of gains, or not finite ones.
    """
    arrays = {}
    for name in RANGES:
        size = 1 if name in ("feedback", "min_opening") else len(machine.driven)
        arrays[name] = np.broadcast_to(np.asarray(gains[name], float), size)
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name}: expected finite gains, got {arrays[name]}")
    return Gains(**arrays)


def gains_vector(gains: Gains) -> Array:
    """Gains as one vector (..., 3 n_driven + 2), in the order of `RANGES`."""
    return np.concatenate([getattr(gains, name) for name in RANGES], axis=-1)


def split_vector(vector: Array) -> Gains:
    """The inverse of `gains_vector`."""
    n = (vector.shape[-1] - 2) // 3
    return Gains(*np.split(vector, [n, 2 * n, 3 * n, 3 * n + 1], axis=-1))


def gain_bounds(machine: Machine) -> tuple[Array, Array]:
    """Smallest and largest gains of `RANGES` as vectors (3 n_driven + 2,)."""
    low = make_gains(machine, **{name: low for name, (low, _) in RANGES.items()})
    high = make_gains(machine, **{name: high for name, (_, high) in RANGES.items()})
    return gains_vector(low), gains_vector(high)


def gains_at_bound(controller: JacobianController) -> list[str]:
    """Names of gains within 1 % of an end of their range: there the range decided, not the cost."""
    m = controller.machine
    low, high = gain_bounds(m)
    names = [f"{kind} {m.names[i]}" for kind in ("kp", "ki", "kd") for i in m.driven]
    names += ["feedback", "min_opening"]
    fraction = (gains_vector(controller.gains) - low) / (high - low)
    return [name for name, x in zip(names, fraction, strict=True) if not 0.01 < x < 0.99]


def tune_baselines(
    machine: Machine, net: ActuatorNet, runs: int, generations: int, seed: int
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself with `tuning_cost`; and a record for JSON.

    Tuning on the machine favours the baselines: the policy is trained on nets alone. The least of
    many noisy costs is too good, so "cost_anew" is the mean of 16 more of the gains found.
    """
    start, goals = tuning_set(machine, runs, seed)
    cost = partial(tuning_cost, start=start, goals=goals, seed=seed)
    tuned = {}
    record = {}
    for name, controller in baselines(machine, net).items():
        tuned[name], costs = tune(controller, cost, seed, generations, name)
        copies = np.tile(gains_vector(tuned[name].gains), (16, 1))
        anew = float(cost(replace(tuned[name], gains=split_vector(copies))).mean())
        at_bound = gains_at_bound(tuned[name])
        record[name] = {"seed": seed, "cost": costs, "cost_anew": anew, "at_bound": at_bound}
    return tuned, record


def tuning_cost(controller: JacobianController, start: Array, goals: Array, seed: int) -> Array:
    """Mean |v_goal - v_tool| [m/s] of each candidate, one row of the controller's gains: (rows,).

    `start` [rad] (runs, n) and `goals` [m/s] (T, runs, 3) are of `tuning_set`.
    """
    vectors = gains_vector(controller.gains)
    runs = len(start)
    candidates = len(vectors)
    batch = replace(controller, gains=split_vector(np.repeat(vectors, runs, axis=0)))
    start = np.tile(start, (candidates, 1))
    goals = np.tile(goals, (1, candidates, 1))
    rng = np.random.default_rng(seed)
    trace = rollout(controller.machine, batch, start, goals, TaskConfig(), rng)
    error = np.linalg.norm(goals - trace.v_tool, axis=-1)  # (T, candidates * runs)
    return np.asarray(error.mean(axis=0).reshape(candidates, runs).mean(axis=1))


def tune(
    controller: JacobianController,
    cost: Callable[[JacobianController], Array],
    seed: int,
    generations: int,
    label: str,
) -> tuple[JacobianController, list[float]]:
    """The controller with the gains of least cost, and the least cost after each generation.

    SciPy's differential evolution with 32 candidates, the first ones near the controller's own
    gains. `cost` is that (candidates,) of a controller with one row of gains per candidate.
    """
    low, high = gain_bounds(controller.machine)
    start = gains_vector(controller.gains)
    first = np.random.default_rng(seed).normal(start, 0.15 * (high - low), (32, len(low)))
    first[0] = start
    costs: list[float] = []

    def objective(vectors: Array) -> Any:  # (gains, candidates) -> (candidates,)
        return cost(replace(controller, gains=split_vector(vectors.T)))

    with tqdm(total=generations, desc=f"tune {label}", unit="generation", disable=None) as bar:

        def record(intermediate_result: OptimizeResult) -> None:
            costs.append(float(intermediate_result.fun))
            bar.update()

        options = SEARCH | {"init": np.clip(first, low, high), "maxiter": generations, "rng": seed}
        bounds = Bounds(low, high)
        result = differential_evolution(objective, bounds, callback=record, **options)
    return replace(controller, gains=split_vector(result.x)), costs


def gains_table(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    table = {}
    for name, controller in controllers.items():
        table[name] = {key: array.tolist() for key, array in asdict(controller.gains).items()}
    return table


def gains_metadata(machine: Machine, net: ActuatorNet) -> dict[str, str]:
    """Machine and nets to which gains belong: its name, and the nets' fingerprint."""
    return {"machine": machine.name, "actuator": fingerprint(net)}


def write_gains(
    path: Path, controllers: Mapping[str, JacobianController], meta: Mapping[str, Any]
) -> None:
    """Write gains as `read_gains` reads them; `meta` includes `gains_metadata`."""
    write_json(path, {"meta": meta, "gains": gains_table(controllers)})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    ValueError: no such file, or gains of other controllers, of another machine, or of other nets.
    """
    controllers = baselines(machine, net)
    file = read_json(path, "gains of `reproduce`")
    check_fields(path, file, {"meta": GAINS["meta"]}, {})
    expect_same(path, file["meta"], gains_metadata(machine, net))
    check_fields(path, file, {"gains": {name: {} for name in controllers}}, {})
    for name, controller in controllers.items():
        gains = dict(file["gains"][name])
        if "ready" in gains:  # its name in older files
            gains["min_opening"] = gains.pop("ready")
        sizes = {"driven": len(machine.driven)}
        check_fields(path, gains, GAINS["gains"]["*"], sizes, f"gains.{name}.")
        controllers[name] = replace(controller, gains=make_gains(machine, **gains))
    return controllers
