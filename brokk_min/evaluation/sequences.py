"""Velocity sequences and start poses: of the evaluation, of the user's files, and for tuning.

Tuning never sees what is scored: only `task_sequences` has the seed of the scored rests, and
`tuning_set` draws starts and goals by other seeds than `draw_starts`.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from brokk_min._files import SHIPPED, numbers, read_csv
from brokk_min.actuator import cylinder_speeds, lever_arm
from brokk_min.env import draw_goal, draw_hold, draw_pose
from brokk_min.jacobian import dls, limit_weights, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.machine import BROKK_170, PWM_MAX, Array, Machine, require, valve_opening
from brokk_min.settings import TaskConfig

AXES = "xyz"
REST_SEED = 2026  # of the scored rests; nothing else draws from it
SECONDS = 26.0  # of a scored sequence, assumed
SHORTEST_REST, LONGEST_REST = 0.5, 10.0  # s, assumed
DRAWS, POSES = 50, 400  # so often so many motions are drawn, to find feasible ones (assumed)
STARTS_OF = 4000  # poses, of which a few can follow all scored motions (assumed)
TUNING = TaskConfig(zero_goals=0.3, hold_min_s=0.5, hold_max_s=3.0)  # assumed
# Rows of seconds and velocity in fractions of tool_speed (assumed).
# On one axis, as in the paper, with changes of direction:
AXIS = ((1, 0), (4, 2 / 3), (1, 0), (4, -2 / 3), (1, 0), (3, 1 / 3), (3, -1 / 3), (1, 0))
WAYS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
WAYS |= {"diagonal_flat": (0.5**0.5, 0.5**0.5, 0), "diagonal_rise": (3**-0.5, -(3**-0.5), 3**-0.5)}
# Along x, y and z:
REST = (1, 0, 0, 0)
RECTANGLE = (REST, (5, 0, 0.5, 0), (3, 0, 0, 0.5), (5, 0, -0.5, 0), (3, 0, 0, -0.5), REST)
STOP_AND_GO = (*(REST, (1, 2 / 3, 0, 0)) * 4, *(REST, (1, -2 / 3, 0, 0)) * 4, REST)
SLOW = (REST, (4, 0.1, 0, 0), (4, -0.1, 0, 0), (4, 0, 0, 0.1), (4, 0, 0, -0.1), REST)


class Commands(NamedTuple):
    """A named sequence of goal velocities of the tool [m/s], one per tick."""

    name: str
    goals: Array  # (T, 3)
    inward: bool = False  # +x and +y mean towards the slew axis, see `for_starts`

    def for_starts(self, machine: Machine, starts: Array) -> Array:
        """Goals [m/s] (T, num, 3) from the starts [rad] (num, n).

        Inward ones have x, y reversed where the tool starts at positive x, y, because otherwise
        the arm could follow them from one side of the slew range only.
        """
        p = tool_position(forward_kinematics(machine, starts))
        sign = np.where(self.inward & (p > 0), [-1.0, -1.0, 1.0], 1.0)
        return np.asarray(sign * self.goals[:, None])


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    return task_sequences(machine)[:3]


def task_sequences(machine: Machine) -> list[Commands]:
    """All sequences of the evaluation: the paper's three axes and six of ours. Paper: Sec. 4.2

    The circle lies in the x-z plane. All begin and end at rest and last `SECONDS`.
    """
    angle = np.linspace(0, 2 * np.pi, round(16 * machine.rate), endpoint=False)
    circle = [(machine.dt, 0.5 * np.cos(x), 0, 0.5 * np.sin(x)) for x in angle]
    seconds, speed = np.transpose(AXIS)
    moves = {
        **{name: np.column_stack([seconds, np.outer(speed, way)]) for name, way in WAYS.items()},
        "circle": np.array([REST, *circle, REST]),
        "rectangle": np.array(RECTANGLE),
        "stop_and_go": np.array(STOP_AND_GO),
        "slow": np.array(SLOW),
    }
    rng = np.random.default_rng(REST_SEED)
    result = []
    for name, rows in moves.items():
        rows = _with_rests(rows, rng)
        ticks = np.rint(rows[:, 0] * machine.rate).astype(int)
        goals = np.repeat(machine.tool_speed * rows[:, 1:], ticks, axis=0)
        result.append(Commands(name, goals, inward=True))
    return result


def _with_rests(rows: Array, rng: np.random.Generator) -> Array:
    """Rows with random seconds of each rest, such that all rows last `SECONDS`."""
    at_rest = ~rows[:, 1:].any(axis=1)
    total = SECONDS - rows[~at_rest, 0].sum()
    while True:
        seconds = _log_uniform(rng, at_rest.sum()).round(1)
        seconds[-1] = total - seconds[:-1].sum()
        if SHORTEST_REST <= seconds[-1] <= LONGEST_REST:
            rows[at_rest, 0] = rng.permutation(seconds)
            return rows


def _log_uniform(rng: np.random.Generator, num: int) -> Array:
    """Random lengths of rests [s], (num,)."""
    return np.exp(rng.uniform(np.log(SHORTEST_REST), np.log(LONGEST_REST), num))


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses [rad] (starts, n) of a CSV with one column per joint.

    ValueError: an angle outside its joint's range, or a pose in the ground.
    """
    table = read_csv(path, *machine.names)
    starts = np.stack([numbers(path, name, table[name]) for name in machine.names], axis=1)
    inside = (starts >= machine.column("q_min")) & (starts <= machine.column("q_max"))  # no nan
    lowest = lowest_point(forward_kinematics(machine, starts))
    fits = inside.all(axis=1) & (lowest >= machine.ground)
    row = int(np.argmin(fits))
    wanted = "angles within the joints' ranges and an arm above the ground"
    require(bool(fits.all()), f"{path}: row {row + 2}", wanted, starts[row].tolist())
    return starts


def evaluation_starts(machine: Machine, num: int, commands: Sequence[Commands], seed: int) -> Array:
    """Start poses [rad] (num, n): those of the package's file, for other machines drawn ones."""
    if machine != BROKK_170:
        return draw_starts(machine, num, commands, seed)
    path = SHIPPED / machine.name / "starts.csv"
    starts = read_starts(path, machine)
    require(num <= len(starts), "--num-starts", f"at most the {len(starts)} of {path.name}", num)
    return starts[:num]


def draw_starts(machine: Machine, num: int, sequences: Sequence[Commands], seed: int) -> Array:
    """Random poses [rad] (num, n) from which ideal actuators follow all sequences.

    The first ones are the same for any `num`. ValueError: too few.
    """
    rng = np.random.default_rng(seed)

    def draw() -> Array:
        poses = draw_pose(machine, TUNING, rng, STARTS_OF).round(4)
        poses = np.clip(poses, machine.column("q_min"), machine.column("q_max"))
        for sequence in sequences:
            poses = poses[feasible(machine, poses, sequence.for_starts(machine, poses))]
        return poses

    return np.array(first(machine, num, draw))


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` [m/s] (T, num, 3) from `start` [rad] (num, n)? (num,).

    They answer at once, and are as fast as the analytic plant's cylinders at the command limit.
    The margins to the path, the ground, the joints' ranges and their speeds are assumed.
    """
    rows = np.arange(len(start))  # those that could follow so far
    q, q_dot = np.array(start, float), np.zeros((len(start), machine.n))
    p_goal = tool_position(forward_kinematics(machine, q))
    low, high = machine.column("q_min") + 0.05, machine.column("q_max") - 0.05
    limit = machine.pwm_limit / PWM_MAX * np.array([[1.0], [-1.0]])
    opening = valve_opening(limit, machine.dead_zones)  # up, and down, which is negative
    up, down = 0.9 * opening * cylinder_speeds(machine).T  # of the cylinders [m/s], (n,) each
    for v_goal in goals:
        if not len(rows):
            break
        frames = forward_kinematics(machine, q)
        off = p_goal - tool_position(frames)
        fits = np.linalg.norm(off, axis=-1) < 0.02
        fits &= lowest_point(frames) > machine.ground + 0.1
        J = jacobian(frames)[..., machine.driven]
        J_inv = dls(J, limit_weights(machine, q, q_dot)[:, machine.driven], 1e-4)
        v = v_goal[rows] + off  # the second term brings the tool back to its path in 1 s
        q_dot = np.zeros_like(q)
        q_dot[:, machine.driven] = (J_inv @ v[..., None])[..., 0]
        speed = q_dot * lever_arm(machine, q)  # dq/dt = v / r(q)
        q, p_goal = q + q_dot * machine.dt, p_goal + v_goal[rows] * machine.dt
        inside = (q > low) & (q < high) & (speed > down) & (speed < up)
        fits &= inside[:, machine.driven].all(axis=-1)
        rows, q, q_dot, p_goal = (array[fits] for array in (rows, q, q_dot, p_goal))
    return np.isin(np.arange(len(start)), rows)


def tuning_set(machine: Machine, num: int, seed: int, seconds: float = 20.0) -> tuple[Array, Array]:
    """Feasible starts [rad] (num, n) and goals [m/s] (T, num, 3) for tuning the baselines.

    They are drawn as in training, but half of the time the tool rests, and rests are as long as
    scored ones. ValueError: too few.
    """
    rng = np.random.default_rng(seed + 1000)
    motions = POSES * int(np.ceil(seconds / TUNING.hold_min_s))  # enough for each pose

    def draw() -> Iterable[tuple[Array, Array]]:
        poses = draw_pose(machine, TUNING, rng, POSES)
        v_goal = draw_goal(machine, TUNING, rng, motions)
        rests = np.rint(_log_uniform(rng, motions) * machine.rate).astype(int)
        ticks = np.where(v_goal.any(axis=1), draw_hold(machine, TUNING, rng, motions), rests)
        runs = zip(np.split(v_goal, POSES), np.split(ticks, POSES), strict=True)
        whole = [np.repeat(*run, axis=0)[: round(seconds * machine.rate)] for run in runs]
        follows = feasible(machine, poses, np.stack(whole, axis=1))
        return zip(poses[follows], np.array(whole)[follows], strict=True)

    starts, goals = zip(*first(machine, num, draw), strict=True)
    return np.array(starts), np.stack(goals, axis=1)


def first(machine: Machine, num: int, draw: Callable[[], Iterable[Any]]) -> list[Any]:
    """The first `num` of what is drawn again and again; ValueError: too few."""
    draws = chain.from_iterable(draw() for _ in range(DRAWS))
    found = list(tqdm(islice(draws, num), "draw starts", num, leave=False, disable=None))
    wanted = "from which the arm stays on its path, above the ground and within ranges and speeds"
    axes = manipulability_threshold(machine) > 1e-6
    doubt = "is tool_speed too large?" if axes else "its joints do not move the tool along x, y, z"
    require(len(found) == num, machine.name, f"{num} starts {wanted}", f"{len(found)}: {doubt}")
    return found
