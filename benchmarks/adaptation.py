"""How near `beyond.adaptation` comes to a controller that knows its valves.

    python -m benchmarks.adaptation [--starts 8] [--machines 24] [--controllers rl rl_paper ...]

Each row is a machine that is not the one in the logs, or that changes while it drives. The columns
are the mean velocity error [m/s] and the drift [m] along x, y and z of a controller as it is
(plain); of one that knows speed and dead zone of each valve at any time; of one that knows those of
a direction of a joint once it has moved there for a second; and of the adaptive one, cold and after
a minute of other motions on the machine as it is at first. Nothing here was used to tune it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tyro

from benchmarks import POLICY
from brokk_min.actuator import PLANT, Cylinder, cylinder_speeds, hydraulics_of
from brokk_min.beyond.adaptation import adapt
from brokk_min.cli.options import own_controller
from brokk_min.evaluation import adaptive, baselines, metrics, reproduce, sequences
from brokk_min.learning.policy import POLICIES, load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import Array, Controller, Machine, Measured, limit_command, valve_opening

SEED = 31  # of starts and unseen machines
SPEEDS, ZONES, LATE = (0.75, 1.3), (0.045, 0.105), 0.04  # of unseen machines: times, of u, s
COLUMNS = ("plain", "knows", "knows after 1 s", "cold", "warm")
Schedule = Callable[[float], Machine]  # the machine at a time [s]


@dataclass
class Options:
    starts: int = 8  # Start poses.
    machines: int = 24  # Unseen machines.
    # Names in files of results, or FILE.py:NAME of your own, see examples/own_controller.py.
    controllers: tuple[str, ...] = ("rl", "rl_paper", baselines.STRONGEST, baselines.OPTIMISED)


class Changing:
    """The plant of a machine that changes each half second; all of its runs begin together."""

    def __init__(self, schedule: Schedule) -> None:
        self.schedule, self.tick = schedule, 0

    @property
    def now(self) -> Machine:
        return self.schedule(self.tick // (M.rate / 2) / 2)

    def reset(self, _: Machine, q: Any) -> Any:
        self.tick = 0
        return PLANT.reset(self.now, q)

    def step(self, _: Machine, state: Any, u: Array) -> Any:
        self.tick += 1
        return PLANT.step(self.now, state, u)


@dataclass(frozen=True)
class Knows:
    """A controller that knows the valves of a plant, each direction after `seconds` of motion."""

    inner: Controller
    plant: Changing
    seconds: float = 0.0

    def start(self, num: int) -> Any:
        return np.zeros((num, len(M.driven), 2)), self.inner.start(num)

    def __call__(self, measured: Measured, state: Any) -> Any:
        (moved, inner), d, truth = state, M.driven, self.plant.now
        zones, begins = M.dead_zones[d], truth.dead_zones[d]
        known = moved >= self.seconds
        k = (cylinder_speeds(truth) / cylinder_speeds(M))[d] * (1 - zones) / (1 - begins)
        k, offset = np.where(known, k, 1), np.where(known, (zones - begins) / (1 - zones), 0)
        history = measured.history.copy()
        pairs = zones[:, None], k[..., None, :], offset[..., None, :]
        history[..., 2, :] = np.clip(adapt(history[..., 2, :], *pairs, inverse=True), -1, 1)
        u, inner = self.inner(measured._replace(history=history), inner)
        opening = valve_opening(u[..., d], zones)
        u[..., d] = adapt(u[..., d], zones, k, offset)
        moved = moved + M.dt * np.stack([opening > 0.02, opening < -0.02], axis=-1)
        return limit_command(M, u), (moved, inner)


def faster(speed: Any, zones: Any = None, late: float = 0.0) -> Machine:
    """The Brokk with times the speed of each cylinder, other dead zones, and later commands."""
    h = hydraulics_of(M)
    speeds = cylinder_speeds(M) * speed
    pairs = zip(M.names, speeds.tolist(), strict=True)
    of = {j: replace(h.cylinders.get(j, Cylinder()), speed=(up, down)) for j, (up, down) in pairs}
    zones = M.dead_zones if zones is None else zones
    joints = tuple(replace(j, dead_zone=tuple(z)) for j, z in zip(M.joints, zones.tolist()))
    return replace(M, joints=joints, hydraulics=replace(h, cylinders=of, delay=h.delay + late))


def unseen(num: int) -> dict[str, Schedule]:
    """Machines with each speed, dead zone and the delay drawn anew."""
    rng, result = np.random.default_rng(SEED), {}
    for i in range(num):
        speeds, zones = (rng.uniform(*of, (M.n, 2)) for of in (SPEEDS, ZONES))
        late = hydraulics_of(M).dt * rng.integers(round(LATE / hydraulics_of(M).dt) + 1)
        drawn = faster(speeds, zones, late)
        result[f"unseen {i + 1}"] = lambda t, drawn=drawn: drawn
    return result


def changes() -> dict[str, Schedule]:
    """Machines that change while they drive."""
    zones = M.dead_zones
    sticks = np.where(np.arange(M.n)[:, None] == M.driven[1], 0.03, 0.0)  # of the second joint
    return {
        "oil warms up: 0.8 to 1.1 in 60 s": lambda t: faster(0.8 + 0.3 * min(t / 60, 1)),
        "oil warms up: 0.8 to 1.1 in 25 s": lambda t: faster(0.8 + 0.3 * min(t / 25, 1)),
        "load at 10 s: up -20 %, down +25 %": lambda t: faster([0.8, 1.25] if t >= 10 else 1.0),
        "a valve begins to stick within 20 s": lambda t: faster(
            1.0, zones + sticks * min(t / 20, 1)
        ),
    }


def row(controller: Controller, name: str, net: Any, schedule: Schedule, task: Any) -> list[Array]:
    """Error and drift of each column, (5, 2)."""
    moves, starts, motions = task
    plant, rows = Changing(schedule), len(moves) * len(starts)
    before = Changing(lambda _: schedule(0.0))  # on which it warms up
    both = adaptive.cold_and_warm({name: controller}, net, M, M, rows, motions, before)
    knows = (Knows(controller, plant), Knows(controller, plant, 1.0))
    result = []
    for one in (controller, *knows, *both.values()):
        runs, _ = metrics.evaluate(M, {name: one}, moves, starts, SEED, plant)
        keys = ("velocity_error_mean", "off_axis_drift_max")
        result.append(np.array([np.mean([run[key] for run in runs]) for key in keys]))
    return result


def main(options: Options) -> None:
    policies = {n: load_policy(POLICY.with_name(f), M) for n, f in POLICIES.items()}
    net = policies["rl"].net
    pids = baselines.read_gains(POLICY.with_name("gains.json"), M, net)
    each: dict[str, Controller] = {**policies, **pids}
    moves = sequences.axis_sequences(M)
    starts = sequences.draw_starts(M, options.starts, moves, SEED)
    task = moves, starts, adaptive.warm_up_motions(M)
    fixed = {name: (lambda t, of=of: of) for name, of in reproduce.variations(M).items()}
    drawn = unseen(options.machines)
    for name in options.controllers:
        each[name] = each[name] if name in each else own_controller(name, M, net)
        print(f"\n| {name} | {' | '.join(COLUMNS)} |\n|---|---|---|---|---|---|")
        of_drawn = []
        for title, schedule in {**fixed, **changes(), **drawn}.items():
            cells = row(each[name], name, net, schedule, task)
            if title in drawn:
                of_drawn.append(cells)
            else:
                print_row(title, cells)
        if of_drawn:
            print_row(f"{len(drawn)} unseen machines, mean", np.mean(of_drawn, axis=0))
            print_row("the worst of these", np.max(of_drawn, axis=0))


def print_row(title: str, cells: Any) -> None:
    texts = (f"{error:.4f} / {drift:.3f}" for error, drift in cells)
    print(f"| {title} | {' | '.join(texts)} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
