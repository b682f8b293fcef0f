"""The classical controllers that the policy is compared with: gains, tuning, and files of gains."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from brokk_min._files import expect_same, expected, read_json, write_json
from brokk_min.actuator import PLANT, ActuatorNet, Plant
from brokk_min.beyond.strong_pid import StrongGains, StrongPID, static_map
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.net_file import fingerprint
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.machine import Array, Machine
from brokk_min.settings import TaskConfig

PAPER_BASELINES = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")
STRONGEST = "jacobian_pid_ff_integral"
TUNED = ("jacobian_pid_k0.1", "jacobian_pid_ff", STRONGEST)  # the second gets the first one's gains
TUNING_RUNS = 10  # of the whole chain and of `evaluate`, assumed
TUNING_SECONDS = 20.0  # of each run
FRESH_RUNS = 4  # times as many, on which the better of the gains found are chosen
GENERATIONS = 10
CANDIDATES = 24
SPREAD = 0.12  # of the first candidates, as a fraction of the roots of the ranges, assumed
RANGES = {  # that `tune` searches (assumed); each driven joint has its own kp, ki and kd
    "kp": (0.0, 4.0),  # valve opening per rad/s
    "ki": (0.0, 12.0),  # valve opening per rad
    "kd": (0.0, 0.3),  # valve opening per rad/s^2
    "feedback": (0.01, 1.0),  # K = feedback * I of eq3, positive definite
    "min_opening": (0.0, 0.06),  # least valve opening
    "integral_feedback": (0.0, 3.0),  # K_I of the error integral [1/s]
    "start_boost": (0.0, 4.0),  # of openings of valves that were closed
    "start_time": (0.0, 0.5),  # for which they are wider [s]
}


def baselines(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The paper's two baselines and two stronger ones, with gains by hand. Paper: Sec. 4.2"""
    w0 = manipulability_threshold(machine)
    one, n = np.ones(1), np.ones(len(machine.driven))
    pid = Gains(1.0 * n, 8.0 * n, 0.05 * n, 0.4 * one)
    mild = StrongGains(0.2 * n, 0.5 * n, 0.02 * n, 0.1 * one, 0.015 * one, *[0.0 * one] * 3)
    more = {"integral_feedback": 1.0 * one, "start_boost": 2.0 * one, "start_time": 0.26 * one}
    feedforward = static_map(machine, net)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": StrongPID(machine, mild, 0.1, w0, feedforward),
        STRONGEST: StrongPID(machine, replace(mild, **more), 0.1, w0, feedforward),
    }


def gains_vector(gains: Gains) -> Array:
    """Gains as one vector (..., size), in the order of their fields."""
    return np.concatenate([getattr(gains, field.name) for field in fields(gains)], axis=-1)


def gains_of(like: Gains, vector: Array) -> Any:
    """Gains of the kind of `like` from a vector (..., size): the inverse of `gains_vector`."""
    sizes = [getattr(like, field.name).shape[-1] for field in fields(like)]
    return type(like)(*np.split(vector, np.cumsum(sizes)[:-1], axis=-1))


def gain_bounds(gains: Gains) -> Array:
    """Smallest and largest gains of `RANGES` as vectors, (2, size)."""
    sizes = [getattr(gains, field.name).shape[-1] for field in fields(gains)]
    return np.repeat([RANGES[field.name] for field in fields(gains)], sizes, axis=0).T


def tuning_cost(
    controller: JacobianController,
    vectors: Array,
    runs: tuple[Array, Array],
    seed: int,
    noise: float,
    plant: Plant = PLANT,
) -> Array:
    """Mean |v_goal - v_tool| [m/s] with each row of gains, `vectors` (rows, size): (rows,).

    `runs` are starts [rad] (num, n) and goals [m/s] (T, num, 3) of `tuning_set`.
    """
    start, goals = runs
    rows, num = len(vectors), len(start)
    every = gains_of(controller.gains, np.repeat(vectors, num, axis=0))
    start, goals = np.tile(start, (rows, 1)), np.tile(goals, (1, rows, 1))
    rng = np.random.default_rng(seed)
    batch = replace(controller, gains=every)
    trace = rollout(controller.machine, batch, start, goals, noise, rng, plant)
    error = np.linalg.norm(goals - trace.v_tool, axis=-1)  # (T, rows * num)
    return np.asarray(error.mean(axis=0).reshape(rows, num).mean(axis=1))


def tune(
    gains: Gains, cost: Callable[[Array], Array], seed: int, generations: int, label: str
) -> tuple[Array, list[float]]:
    """The vector of gains of least cost, and the least cost after each generation.

    SciPy's differential evolution over fractions x of the roots of the ranges, so that small gains
    of a wide range are searched as finely as large ones: gain = low + x^2 (high - low). The first
    candidates are near `gains`; gains that are 0 stay so. `cost` is that (rows,) of rows of gains.
    """
    from scipy.optimize import Bounds, differential_evolution  # slow to import

    low, high = gain_bounds(gains)
    given = gains_vector(gains)
    searched = given > 0
    start = np.sqrt(np.clip((given - low) / (high - low), 0, 1))[searched]
    rng = np.random.default_rng(seed)
    first = np.clip(rng.normal(start, SPREAD, (CANDIDATES, len(start))), 0, 1)
    first[0] = start

    def at(x: Array) -> Array:
        vectors = np.zeros((*x.shape[:-1], len(given)))
        vectors[..., searched] = low[searched] + x**2 * (high - low)[searched]
        return vectors

    def objective(x: Any) -> Any:
        return cost(at(x.T))

    costs: list[float] = []
    with tqdm(total=generations, desc=f"tune {label}", unit="generation", disable=None) as bar:

        def record(intermediate_result: Any) -> None:
            costs.append(float(intermediate_result.fun))
            bar.update()

        result = differential_evolution(
            objective, Bounds(0 * start, 0 * start + 1), init=first, rng=seed,
            maxiter=generations, mutation=(0.4, 0.9), tol=0, polish=False, callback=record,
            vectorized=True, updating="deferred",
        )  # fmt: skip
    return at(result.x), costs


def tune_baselines(
    machine: Machine,
    net: ActuatorNet,
    runs: int,
    generations: int,
    seed: int,
    noise: float = TaskConfig.noise,
    plant: Plant = PLANT,
    longest: float = TUNING_SECONDS,
    only: Sequence[str] = TUNED,
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines of `only`, tuned on the `plant` itself; and a record of it for JSON.

    That favours the baselines, because the policy is trained on nets alone. Each is tuned twice,
    with `seed` and the next, and the gains with the lower cost on other goals are kept; the costs
    of both agree if the search has converged. No run is longer than `longest` [s]. The strongest
    has more gains, so it gets twice the generations. The paper's second one gets the gains of its
    first: their damping differs near singularities alone, where no run goes.
    """
    seconds = min(TUNING_SECONDS, longest)
    tuning = tuning_set(machine, runs, seed, seconds)
    fresh = tuning_set(machine, FRESH_RUNS * runs, seed + 2, seconds)
    every = baselines(machine, net)
    tuned, record = {}, {}
    for name in only:
        controller, steps = every[name], generations * (2 if name == STRONGEST else 1)
        cost = partial(tuning_cost, controller, runs=tuning, seed=seed, noise=noise, plant=plant)
        seeds = (seed, seed + 1)
        vectors, costs = zip(
            *(tune(controller.gains, cost, one, steps, name) for one in seeds), strict=True
        )
        fresh_cost = tuning_cost(controller, np.array(vectors), fresh, seed + 2, noise, plant)
        gains = gains_of(controller.gains, vectors[int(np.argmin(fresh_cost))])
        tuned[name] = replace(controller, gains=gains)
        record[name] = {"seeds": seeds, "costs": costs, "fresh_costs": fresh_cost.tolist()}
    if PAPER_BASELINES[0] in tuned:
        gains = tuned[PAPER_BASELINES[0]].gains
        tuned[PAPER_BASELINES[1]] = replace(every[PAPER_BASELINES[1]], gains=gains)
    return {name: tuned[name] for name in every if name in tuned}, record


def gains_metadata(machine: Machine, net: ActuatorNet) -> dict[str, str]:
    """Machine and nets to which gains belong: its name, and the nets' fingerprint."""
    return {"machine": machine.name, "actuator": fingerprint(net)}


def write_gains(
    path: Path, controllers: Mapping[str, JacobianController], meta: Mapping[str, Any]
) -> None:
    """Write gains as `read_gains` reads them; `meta` includes `gains_metadata`."""
    every = {name: asdict(controller.gains) for name, controller in controllers.items()}
    gains = {name: {k: array.tolist() for k, array in of.items()} for name, of in every.items()}
    write_json(path, {"meta": meta, "gains": gains})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `write_gains` wrote.

    ValueError: no such file, gains of another machine or of other nets, or not finite ones.
    """
    with expected(path, "gains of `reproduce` or `evaluate --save-gains`"):
        file = read_json(path, "JSON")
        expect_same(path, file["meta"], gains_metadata(machine, net))
        read = {}
        for name, controller in baselines(machine, net).items():
            row = {key: np.array(values, float) for key, values in file["gains"][name].items()}
            gains = type(controller.gains)(**row)
            shape = gains_vector(controller.gains).shape
            if gains_vector(gains).shape != shape or not np.isfinite(gains_vector(gains)).all():
                raise ValueError(f"{path}: {name}: expected {shape[0]} finite gains, got {row}")
            read[name] = replace(controller, gains=gains)
        return read
