"""The classical controllers that the policy is compared with: their settings, tuning and files of gains."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import Bounds, OptimizeResult, differential_evolution
from tqdm import tqdm

from brokk_min import jacobian
from brokk_min.actuator import ActuatorNet, fingerprint
from brokk_min.env import TaskConfig, rollout
from brokk_min.evaluation.sequences import tuning_goals
from brokk_min.identification.files import expected, write_json
from brokk_min.jacobian import JacobianController
from brokk_min.machine import Array, Machine

PAPERS = ("jacobian_pid_k0.1", "jacobian_pid_k0.05")  # the paper's two baselines
STRONGER = ("jacobian_pid_ff",)  # than the paper's: its sentences are put to it, too
AWAKE = "jacobian_pid_ff_awake"  # the same, its valves never closed: what the policy learns to do
SEARCH: dict[str, Any] = {
    "mutation": (0.4, 0.9),
    "tol": 0,
    "polish": False,
}  # of SciPy's search, assumed


def baselines(machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The paper's two baselines and two with feed-forward, with gains set by hand. Paper: Sec. 4.2

    The last keeps its valves barely open even while the tool is to stand still.
    """
    w0 = jacobian.manipulability_threshold(machine)
    pid = jacobian.join_gains(
        machine, {"kp": 1.0, "ki": 8.0, "kd": 0.05, "feedback": 0.4, "ready": 0.015}
    )
    mild = jacobian.join_gains(
        machine, {"kp": 0.2, "ki": 0.5, "kd": 0.02, "feedback": 0.1, "ready": 0.015}
    )
    steady = jacobian.steady_map(machine, net)
    return {
        "jacobian_pid_k0.1": JacobianController(machine, pid, 0.1, w0),
        "jacobian_pid_k0.05": JacobianController(machine, pid, 0.05, w0),
        "jacobian_pid_ff": JacobianController(machine, mild, 0.1, w0, steady),
        AWAKE: JacobianController(machine, mild, 0.1, w0, steady, awake=True),
    }


def tuning_set(machine: Machine, runs: int, seed: int) -> tuple[Array, Array]:
    """Starts and goals of `runs` runs that the baselines are tuned on: apart from all that scores."""
    return tuning_goals(machine, runs, 12.0, seed + 1000)


def tuned_baselines(
    machine: Machine, net: ActuatorNet, runs: int, generations: int, seed: int
) -> tuple[dict[str, JacobianController], dict[str, dict[str, Any]]]:
    """The baselines, each tuned on the machine itself, and how their tuning went, for JSON.

    The cost is the figure that is scored, mean |v_goal - v_tool|, on the `tuning_set`. Tuning on the
    machine favours the baselines: the policy never sees it. The least of many noisy costs flatters, so
    "cost_anew" is the mean of 16 more of the gains that were found.
    """
    start, goals = tuning_set(machine, runs, seed)

    def cost(controller: JacobianController) -> Array:
        candidates = len(controller.gains)
        batch = replace(controller, gains=np.repeat(controller.gains, runs, axis=0))
        wanted, rng = np.tile(goals, (1, candidates, 1)), np.random.default_rng(seed)
        trace = rollout(machine, batch, np.tile(start, (candidates, 1)), wanted, TaskConfig(), rng)
        error = np.linalg.norm(wanted - trace.v_tool, axis=-1)
        return np.asarray(error.mean(0).reshape(candidates, runs).mean(1))

    tuned, how = {}, {}
    for name, controller in baselines(machine, net).items():
        tuned[name], costs = tune(controller, cost, seed, generations, name)
        anew = float(cost(replace(tuned[name], gains=np.tile(tuned[name].gains, (16, 1)))).mean())
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
    first = np.random.default_rng(seed).normal(
        controller.gains, 0.15 * (high - low), (32, len(low))
    )
    first[0] = controller.gains
    costs: list[float] = []

    def objective(vectors: Array) -> Any:  # (candidates,): SciPy's types know no vectorised search
        return cost(replace(controller, gains=vectors.T))

    with tqdm(total=generations, desc=f"tune {label}", unit="generation", disable=None) as bar:

        def note(intermediate_result: OptimizeResult) -> None:
            costs.append(float(intermediate_result.fun))
            bar.update()

        how = SEARCH | {"rng": seed, "maxiter": generations, "init": np.clip(first, low, high)}
        how |= {"callback": note, "vectorized": True, "updating": "deferred"}
        result = differential_evolution(objective, Bounds(low, high), **how)
    return replace(controller, gains=result.x), costs


def gain_bounds(machine: Machine) -> tuple[Array, Array]:
    """Smallest and largest gains of `GAINS` as vectors."""
    low, high = ({name: ends[i] for name, ends in jacobian.GAINS.items()} for i in (0, 1))
    return jacobian.join_gains(machine, low), jacobian.join_gains(machine, high)


def gains_at_bound(controller: JacobianController) -> list[str]:
    """Gains within 1 % of an end of their range: there the range decided, not the cost."""
    m, (low, high) = controller.machine, gain_bounds(controller.machine)
    names = [f"{kind} {m.names[i]}" for kind in ("kp", "ki", "kd") for i in m.driven] + [
        "feedback",
        "ready",
    ]
    share = (controller.gains - low) / (high - low)
    return [name for name, s in zip(names, share, strict=True) if not 0.01 < s < 0.99]


def plain_gains(controllers: Mapping[str, JacobianController]) -> dict[str, dict[str, list[float]]]:
    """Gains of each baseline by name, for JSON."""
    named = {name: jacobian.split_gains(c.gains) for name, c in controllers.items()}
    return {
        name: {key: gain.tolist() for key, gain in gains.items()} for name, gains in named.items()
    }


def write_gains(
    path: Path, controllers: Mapping[str, JacobianController], about: Mapping[str, Any]
) -> None:
    """Write the baselines' gains as `read_gains` reads them; `about` is the `meta` of their tuning."""
    write_json(path, {"meta": about, "gains": plain_gains(controllers)})


def read_gains(path: Path, machine: Machine, net: ActuatorNet) -> dict[str, JacobianController]:
    """The baselines with gains that `reproduce` wrote.

    ValueError: no such file, or gains of other controllers or joints, tuned for another machine or with
    other nets, whose feed-forward is another.
    """
    result, wanted = baselines(machine, net), tuned_for(machine, net)
    with expected(path, f"gains for {machine.name} with nets {wanted['actuator']}"):
        table = json.loads(path.read_text())
        found = {name: table["meta"].get(name) for name in wanted}
        if found != wanted:
            raise ValueError(f"gains for {found}")
        for name, controller in result.items():
            result[name] = replace(
                controller, gains=jacobian.join_gains(machine, table["gains"][name])
            )
    return result


def tuned_for(machine: Machine, net: ActuatorNet) -> dict[str, str]:
    """What gains and sweeps belong to: the machine's name and the fingerprint of its driven joints' nets."""
    return {"machine": machine.name, "actuator": fingerprint(net)}
