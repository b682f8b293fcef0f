"""The classical controllers that the policy is compared with: their settings, tuning and files of gains."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, OptimizeResult, differential_evolution
from tqdm import tqdm

from brokk_min import jacobian
from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation import feedforward
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import expected, write_json
from brokk_min.identification.net_file import fingerprint
from brokk_min.jacobian import Gains, JacobianController
from brokk_min.machine import Array, Machine

PAPER_BASELINES = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")  # the paper's two baselines
STRONGER = ("jacobian_pid_ff",)  # than the paper's: its sentences are put to it, too
ALWAYS_OPEN = (
    "jacobian_pid_ff_awake"  # the same, its valves never closed: what the policy learns to do
)
TUNING_RUNS = 12  # of the whole chain and of `evaluate`, assumed
GENERATIONS = 45
SEARCH: dict[str, Any] = {
    "mutation": (0.4, 0.9),
    "tol": 0,
    "polish": False,
}  # of SciPy's search, assumed


# Ranges that `tune` searches (assumed); of the first three each driven joint has its own.
RANGES = {
    "kp": (0.0, 4.0),  # valve opening per rad/s
    "ki": (0.0, 12.0),  # valve opening per rad
    "kd": (0.0, 0.3),  # valve opening per rad/s^2
    "feedback": (0.0, 1.0),  # K = feedback * I of eq3
    "min_opening": (0.0, 0.04),  # least valve opening
}


def make_gains(machine: Machine, named: Mapping[str, ArrayLike]) -> Gains:
    """Gains by name as in files; one number stands for all joints.

    ValueError: another number of gains, or not finite ones.
    """
    n = len(machine.driven)
    sizes = dict.fromkeys(RANGES, n) | {"feedback": 1, "min_opening": 1}
    arrays = {
        name: np.broadcast_to(np.asarray(named[name], float), size) for name, size in sizes.items()
    }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite gains, got {array}")
    return Gains(**arrays)


def gains_vector(gains: Gains) -> Array:
    """Gains as one vector (..., 3 n_driven + 2), in the order of `RANGES`."""
    return np.concatenate([getattr(gains, name) for name in RANGES], axis=-1)


def split_vector(vector: Array) -> Gains:
    """`gains_vector` undone."""
    n = (vector.shape[-1] - 2) // 3
    return Gains(*np.split(vector, [n, 2 * n, 3 * n, 3 * n + 1], axis=-1))


def baselines(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The paper's two baselines and two with feed-forward, with gains set by hand. Paper: Sec. 4.2

    The last keeps its valves open even while the tool is to stand still.
    """
    w0 = jacobian.manipulability_threshold(machine)
    pid = make_gains(
        machine, {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "min_opening": 0.015}
    )
    mild = make_gains(
        machine, {"kp": 0.2, "ki": 0.5, "kd": 0.02, "feedback": 0.1, "min_opening": 0.015}
    )
    static_map = feedforward.static_map(machine, net).command
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, mild, 0.1, w0, static_map),
        ALWAYS_OPEN: JacobianController(machine, mild, 0.1, w0, static_map, always_open=True),
    }


def tune_baselines(
    machine: Machine, net: ActuatorNet, runs: int, generations: int, seed: int
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself, and how their tuning went, for JSON.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on the `tuning_set`. Tuning on the
    machine favours the baselines: the policy never sees it. The least of many noisy costs flatters, so
    "cost_anew" is the mean of 16 more of the gains that were found.
    """
    start, goals = tuning_set(machine, runs, seed)

    def cost(controller: JacobianController) -> Array:
        vectors = gains_vector(controller.gains)
        candidates = len(vectors)
        batch = replace(controller, gains=split_vector(np.repeat(vectors, runs, axis=0)))
        wanted, rng = np.tile(goals, (1, candidates, 1)), np.random.default_rng(seed)
        trace = rollout(machine, batch, np.tile(start, (candidates, 1)), wanted, TaskConfig(), rng)
        error = np.linalg.norm(wanted - trace.v_tool, axis=-1)
        return np.asarray(error.mean(0).reshape(candidates, runs).mean(1))

    tuned, how = {}, {}
    for name, controller in baselines(machine, net).items():
        tuned[name], costs = tune(controller, cost, seed, generations, name)
        rows = split_vector(np.tile(gains_vector(tuned[name].gains), (16, 1)))
        anew = float(cost(replace(tuned[name], gains=rows)).mean())
        at_bound = gains_at_bound(tuned[name])
        how[name] = {"seed": seed, "cost": costs, "cost_anew": anew, "at_bound": at_bound}
    return tuned, how


def tune(
    controller: JacobianController,
    cost: Callable[[JacobianController], Array],
    seed: int,
    generations: int,
    label: str,
) -> tuple[JacobianController, list[float]]:
    """The controller with the gains of least cost, and the least cost after each generation.

    SciPy's differential evolution with 32 candidates, the first of them about the controller's own gains.
    `cost` is that (candidates,) of a controller with a row of gains for each candidate.
    """
    low, high = gain_bounds(controller.machine)
    start = gains_vector(controller.gains)
    first = np.random.default_rng(seed).normal(start, 0.15 * (high - low), (32, len(low)))
    first[0] = start
    costs: list[float] = []

    def objective(vectors: Array) -> Any:  # (candidates,): SciPy's types know no vectorised search
        return cost(replace(controller, gains=split_vector(vectors.T)))

    with tqdm(total=generations, desc=f"tune {label}", unit="generation", disable=None) as bar:

        def note(intermediate_result: OptimizeResult) -> None:
            costs.append(float(intermediate_result.fun))
            bar.update()

        how = SEARCH | {"rng": seed, "maxiter": generations, "init": np.clip(first, low, high)}
        how |= {"callback": note, "vectorized": True, "updating": "deferred"}
        result = differential_evolution(objective, Bounds(low, high), **how)
    return replace(controller, gains=split_vector(result.x)), costs


def gain_bounds(machine: Machine) -> tuple[Array, Array]:
    """Smallest and largest gains of `RANGES` as vectors."""
    low = make_gains(machine, {name: ends[0] for name, ends in RANGES.items()})
    high = make_gains(machine, {name: ends[1] for name, ends in RANGES.items()})
    return gains_vector(low), gains_vector(high)


def gains_at_bound(controller: JacobianController) -> list[str]:
    """Gains within 1 % of an end of their range: there the range decided, not the cost."""
    m, (low, high) = controller.machine, gain_bounds(controller.machine)
    names = [f"{kind} {m.names[i]}" for kind in ("kp", "ki", "kd") for i in m.driven]
    names += ["feedback", "min_opening"]
    fraction = (gains_vector(controller.gains) - low) / (high - low)
    return [name for name, x in zip(names, fraction, strict=True) if not 0.01 < x < 0.99]


def gains_table(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    return {
        name: {key: array.tolist() for key, array in asdict(controller.gains).items()}
        for name, controller in controllers.items()
    }


def write_gains(
    path: Path, controllers: Mapping[str, JacobianController], about: Mapping[str, Any]
) -> None:
    """Write the baselines' gains as `read_gains` reads them; `about` is the `meta` of their tuning."""
    write_json(path, {"meta": about, "gains": gains_table(controllers)})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    ValueError: no such file, or gains of other controllers or joints, tuned for another machine or with
    other nets, whose feed-forward is another.
    """
    result, wanted = baselines(machine, net), gains_metadata(machine, net)
    with expected(path, f"gains for {machine.name} with nets {wanted['actuator']}"):
        table = json.loads(path.read_text())
        found = {name: table["meta"].get(name) for name in wanted}
        if found != wanted:
            raise ValueError(f"gains for {found}")
        for name, controller in result.items():
            named = table["gains"][name]
            if "ready" in named:  # its name in older files
                named["min_opening"] = named.pop("ready")
            result[name] = replace(controller, gains=make_gains(machine, named))
    return result


def gains_metadata(machine: Machine, net: ActuatorNet) -> dict[str, str]:
    """What gains and sweeps belong to: the machine's name and the fingerprint of its driven joints' nets."""
    return {"machine": machine.name, "actuator": fingerprint(net)}
