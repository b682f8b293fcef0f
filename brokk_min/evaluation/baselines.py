"""The classical controllers that the policy is compared with: gains, tuning, and files of gains."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.evaluation.feedforward import static_map
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.identification.files import brief, expect_same, read_json, write_json
from brokk_min.identification.formats import GAINS, META, Field, check_fields
from brokk_min.identification.net_file import fingerprint
from brokk_min.identification.progress import progress
from brokk_min.jacobian import Gains, JacobianController, manipulability_threshold
from brokk_min.machine import Array, Machine

PAPER_BASELINES = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")
WITH_INTEGRAL = (
    "jacobian_pid_ff_integral",
    "jacobian_pid_ff_integral_dither",
)  # valves closed; dither
# What is tuned by itself; gains found for one of a group may serve another one.
GROUPS = (("jacobian_pid_k0.1",), ("jacobian_pid_ff",), WITH_INTEGRAL)
TUNED = tuple(name for group in GROUPS for name in group)
# Stronger than the paper's: its claims are tested against these, too.
WITH_FEEDFORWARD = ("jacobian_pid_ff", "jacobian_pid_ff_integral")
TUNING_RUNS = 10  # of the whole chain and of `evaluate`, assumed
TUNING_SECONDS = 20.0  # of each run
FRESH_RUNS = 4  # times as many, on which the best of the gains found are chosen
GENERATIONS = 10
CANDIDATES = 24
SPREAD = 0.12  # of the first candidates, in the scale of `gains_of`, assumed
SEARCH: dict[str, Any] = {"mutation": (0.4, 0.9), "tol": 0, "polish": False}  # assumed
SEARCH |= {"vectorized": True, "updating": "deferred"}  # a whole generation at once
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
OF_ALL = tuple(RANGES)[3:]  # one number for all joints


def baselines(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The paper's two baselines and three with feed-forward, with gains by hand. Paper: Sec. 4.2"""
    w0 = manipulability_threshold(machine)
    pid = make_gains(machine, kp=1.0, ki=8.0, kd=0.05, feedback=0.4, min_opening=0.015)
    mild = make_gains(machine, kp=0.2, ki=0.5, kd=0.02, feedback=0.1, min_opening=0.015)
    feedforward = static_map(machine, net).command
    with_feedforward = JacobianController(machine, mild, 0.1, w0, feedforward)
    more = {"integral_feedback": 1.0, "start_boost": 2.0, "start_time": 0.26}
    gains = replace(mild, **{name: np.full(1, value) for name, value in more.items()})
    with_integral = replace(with_feedforward, gains=gains)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": with_feedforward,
        "jacobian_pid_ff_integral": with_integral,
        "jacobian_pid_ff_integral_dither": replace(with_integral, valves="dither"),
    }


def make_gains(machine: Machine, **gains: ArrayLike) -> Gains:
    """Gains by the names of `RANGES`, 0 if not given; one number stands for all joints.

    ValueError: another number of gains, or not finite ones.
    """
    arrays = {}
    for name in RANGES:
        size = len(machine.driven) if name in ("kp", "ki", "kd") else 1
        arrays[name] = np.broadcast_to(np.asarray(gains.get(name, 0.0), float), size)
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name}: expected finite gains, got {arrays[name]}")
    return Gains(**arrays)


def gains_vector(gains: Gains) -> Array:
    """Gains as one vector (..., 3 n_driven + 5), in the order of `RANGES`."""
    return np.concatenate([getattr(gains, name) for name in RANGES], axis=-1)


def split_vector(vector: Array) -> Gains:
    """The inverse of `gains_vector`."""
    n = (vector.shape[-1] - len(OF_ALL)) // 3
    ends = np.cumsum([n] * 3 + [1] * len(OF_ALL))
    return Gains(*np.split(vector, ends[:-1], axis=-1))


def gain_bounds(machine: Machine) -> Array:
    """Smallest and largest gains of `RANGES` as vectors, (2, 3 n_driven + 5)."""
    ranges = np.array(list(RANGES.values()))
    return np.repeat(ranges, [len(machine.driven)] * 3 + [1] * len(OF_ALL), axis=0).T


def gains_of(machine: Machine, x: Array) -> Gains:
    """Gains at the fractions x [0, 1] (..., 3 n_driven + 5) of the roots of their ranges.

    gain = low + x^2 (high - low): small gains of a wide range are searched as finely as large ones.
    """
    low, high = gain_bounds(machine)
    return split_vector(low + np.square(x) * (high - low))


def fractions_of(machine: Machine, gains: Gains) -> Array:
    """The inverse of `gains_of`; gains outside their range are at its end."""
    low, high = gain_bounds(machine)
    return np.asarray(np.sqrt(np.clip((gains_vector(gains) - low) / (high - low), 0, 1)))


def gains_at_bound(controller: JacobianController) -> list[str]:
    """Names of gains other than 0 by the ends of their range: there it decided, not the cost."""
    m = controller.machine
    names = [f"{kind} {m.names[i]}" for kind in ("kp", "ki", "kd") for i in m.driven]
    names += OF_ALL
    values = gains_vector(controller.gains)
    x = fractions_of(m, controller.gains)
    numbers = zip(names, values, x, strict=True)
    return [name for name, value, x_of in numbers if value and not 0.01 < x_of < 0.99]


def tune_baselines(
    machine: Machine,
    net: ActuatorNet,
    runs: int,
    generations: int,
    seed: int,
    config: TaskConfig | None = None,
    plant: ActuatorNet | None = None,
    longest: float = np.inf,
    only: Sequence[str] = TUNED,
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself with `tuning_cost`; and a record for JSON.

    Tuning on the machine (or the nets `plant`) favours the baselines: the policy is
    trained on nets alone. Each is tuned twice, with `seed` and the next: "cost" and "second_cost"
    agree if the search has converged. Of both, and of those of its group in `GROUPS`, the gains
    with the least cost on `FRESH_RUNS` times as many other goals are kept: "fresh_cost". `config`
    has the noise. No run is longer than `longest` [s]; `only` has the baselines to tune.
    `WITH_INTEGRAL` have more gains, and twice the generations. The paper's second one gets the
    gains of its first: their damping differs near singularities alone, where no run goes.
    """
    config = config or TaskConfig()

    def cost_on(num: int, seed: int) -> Callable[[JacobianController], Array]:
        """The cost on `num` runs of the tuning."""
        start, goals = tuning_set(machine, num, seed, min(TUNING_SECONDS, longest))
        return partial(tuning_cost, start=start, goals=goals, seed=seed, config=config, plant=plant)

    cost, fresh_cost = cost_on(runs, seed), cost_on(FRESH_RUNS * runs, seed + 2)
    every = baselines(machine, net)
    found: dict[str, list[Gains]] = {}
    record: dict[str, dict[str, Any]] = {}
    for name in only:
        steps = generations * (2 if name in WITH_INTEGRAL else 1)
        first, costs = tune(every[name], cost, seed, steps, name)
        second, second_costs = tune(every[name], cost, seed + 1, steps, name)
        found[name] = [first.gains, second.gains]
        record[name] = {"seed": seed, "cost": costs, "second_cost": second_costs}
    tuned = {}
    for name in only:
        group = next(group for group in GROUPS if name in group)
        gains = [one for other in group for one in found.get(other, [])]
        rows = split_vector(np.array([gains_vector(one) for one in gains]))
        costs = fresh_cost(replace(every[name], gains=rows)).tolist()
        tuned[name] = replace(every[name], gains=gains[int(np.argmin(costs))])
        record[name] |= {"fresh_cost": min(costs), "at_bound": gains_at_bound(tuned[name])}
    first_k, second_k = PAPER_BASELINES
    if first_k in tuned:
        tuned[second_k] = replace(every[second_k], gains=tuned[first_k].gains)
    return {name: tuned[name] for name in every if name in tuned}, record


def tuning_cost(
    controller: JacobianController,
    start: Array,
    goals: Array,
    seed: int,
    config: TaskConfig,
    plant: ActuatorNet | None = None,
) -> Array:
    """Mean |v_goal - v_tool| [m/s] of each candidate, one row of the controller's gains: (rows,).

    `start` [rad] (runs, n) and `goals` [m/s] (T, runs, 3) are of `tuning_set`. The nets `plant`
    move the machine, or the plant (None).
    """
    vectors = gains_vector(controller.gains)
    runs = len(start)
    candidates = len(vectors)
    batch = replace(controller, gains=split_vector(np.repeat(vectors, runs, axis=0)))
    start = np.tile(start, (candidates, 1))
    goals = np.tile(goals, (1, candidates, 1))
    rng = np.random.default_rng(seed)
    trace = rollout(controller.machine, batch, start, goals, config, rng, plant)
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

    SciPy's differential evolution with `CANDIDATES`, the first ones near the controller's own
    gains; gains that are 0 stay so. `cost` is that (candidates,) of a controller with one row of
    gains per candidate.
    """
    from scipy.optimize import Bounds, differential_evolution  # slow to import

    machine = controller.machine
    start = fractions_of(machine, controller.gains)
    searched = gains_vector(controller.gains) > 0
    spread = SPREAD * searched
    first = np.random.default_rng(seed).normal(start, spread, (CANDIDATES, len(start)))
    first[0] = start
    first = np.clip(first, 0, 1)[:, searched]
    costs: list[float] = []

    def at(x: Array) -> JacobianController:
        gains = np.zeros((*x.shape[:-1], len(start)))
        gains[..., searched] = x
        gains = np.where(searched, gains_vector(gains_of(machine, gains)), 0.0)
        return replace(controller, gains=split_vector(gains))

    def objective(x: Array) -> Any:
        return cost(at(x.T))

    with progress(total=generations, desc=f"tune {label}", unit="generation") as bar:

        def record(intermediate_result: Any) -> None:
            costs.append(float(intermediate_result.fun))
            bar.update()

        options = SEARCH | {"init": first, "maxiter": generations, "rng": seed}
        bounds = Bounds(np.zeros(first.shape[1]), np.ones(first.shape[1]))
        result = differential_evolution(objective, bounds, callback=record, **options)
    return at(result.x), costs


def gains_table(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    every = {name: asdict(controller.gains) for name, controller in controllers.items()}
    return {name: {k: array.tolist() for k, array in of.items()} for name, of in every.items()}


def gains_metadata(machine: Machine, net: ActuatorNet) -> dict[str, str]:
    """Machine and nets to which gains belong: its name, and the nets' fingerprint."""
    return {"machine": machine.name, "actuator": fingerprint(net)}


def write_gains(
    path: Path, controllers: Mapping[str, JacobianController], meta: Mapping[str, Any]
) -> None:
    """Write gains as `read_gains` reads them; `meta` includes `gains_metadata`."""
    write_json(path, {"meta": meta, "gains": gains_table(controllers)})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `write_gains` wrote.

    ValueError: no such file, or gains of other controllers, of another machine, or of other nets.
    """
    controllers = baselines(machine, net)
    file = read_json(path, "gains of `reproduce` or `evaluate --save-gains`")
    check_fields(path, file, {"meta": META}, {})
    expect_same(path, file["meta"], gains_metadata(machine, net))
    check_fields(path, file, {"gains": Field("object")}, {})
    for name, controller in controllers.items():
        row = file["gains"].get(name)
        if not isinstance(row, dict):
            got = brief(row if name in file["gains"] else list(file["gains"]))
            raise ValueError(f"{path}: gains.{name}: expected gains: tune again, got {got}")
        row = {"min_opening" if key == "ready" else key: row[key] for key in row}  # older files
        for key, value in row.items():  # one number stands for all joints
            if isinstance(value, float | int):
                row[key] = [value] * (len(machine.driven) if key in ("kp", "ki", "kd") else 1)
        check_fields(path, row, GAINS, {"driven": len(machine.driven)}, f"gains.{name}.")
        controllers[name] = replace(controller, gains=make_gains(machine, **row))
    return controllers
