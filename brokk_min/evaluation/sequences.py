"""Velocity sequences and start poses: of the evaluation, of the user's files, and for tuning.

Tuning never opens what is scored: only `task_sequences` has the seed of the scored rests, only
`evaluation_starts` opens the file of scored starts, and `tuning_set` draws other starts and goals.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brokk_min.env import TaskConfig, terminated
from brokk_min.evaluation.feasibility import feasible, first_failure, most_frequent
from brokk_min.identification import files
from brokk_min.identification.formats import COMMANDS, read_table, starts_of
from brokk_min.identification.progress import progress
from brokk_min.jacobian import manipulability, manipulability_threshold
from brokk_min.kinematics import forward_kinematics, jacobian, lowest_point, tool_position
from brokk_min.learning.episodes import draw_pose, reset
from brokk_min.machine import Array, Machine

AXES = "xyz"
LONGEST = 3600.0  # s of a sequence of a file, assumed
MOST_STARTS = 1000  # of a file
KINDS = ("workspace", "limits", "extended")  # of starts, see `start_kinds`
REST_SEED = 2026  # of the scored rests; nothing else draws from it
SECONDS = 26.0  # of a scored sequence, assumed
SHORTEST_REST, LONGEST_REST = 0.5, 10.0  # s, assumed
TRIES = 8  # draws after which a kind of starts without any pose is given up, assumed
# Rows of seconds and velocity in fractions of tool_speed (assumed).
# On one axis, as in the paper, with changes of direction:
AXIS = ((1, 0), (4, 2 / 3), (1, 0), (4, -2 / 3), (1, 0), (3, 1 / 3), (3, -1 / 3), (1, 0))
# Along x, y and z:
REST = (1, 0, 0, 0)
RECTANGLE = (REST, (5, 0, 0.5, 0), (3, 0, 0, 0.5), (5, 0, -0.5, 0), (3, 0, 0, -0.5), REST)
STOP_AND_GO = (*(REST, (1, 2 / 3, 0, 0)) * 4, *(REST, (1, -2 / 3, 0, 0)) * 4, REST)
SLOW = (REST, (4, 0.1, 0, 0), (4, -0.1, 0, 0), (4, 0, 0, 0.1), (4, 0, 0, -0.1), REST)


class Commands(NamedTuple):
    """A named sequence of goal velocities of the tool [m/s], one per tick."""

    name: str
    goals: Array  # (T, 3), or (T, starts, 3) if each start has its own
    inward: bool = False  # +x and +y mean towards the slew axis, see `for_starts`

    def for_starts(self, machine: Machine, starts: Array) -> Array:
        """Goals [m/s] (T, num, 3) from the starts [rad] (num, n).

        Inward ones have x, y reversed where the tool starts at positive x, y. Otherwise the first
        moves along +x and +y fit into the arm's reach only from one side of the slew range.
        """
        num = len(starts)
        each = self.goals.ndim == 3
        goals = self.goals[:, :num] if each else np.repeat(self.goals[:, None], num, axis=1)
        if not self.inward:
            return goals
        sign = np.where(tool_position(forward_kinematics(machine, starts)) > 0, -1.0, 1.0)
        sign[:, 2] = 1.0
        return sign * goals


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    return task_sequences(machine)[:3]


def singular_sequences(machine: Machine, starts: Array) -> list[Commands]:
    """The axis pattern along the direction in which the tool at each start can hardly move.

    It is the left singular vector of the Jacobian's least singular value, its largest component
    positive. Goals are a half and a quarter of the pattern's (assumed): at full speed the joints'
    own speed limits the tool near a singularity, and not damping. Paper: Fig. 6e, Fig. 6f
    """
    J = jacobian(forward_kinematics(machine, starts))[..., machine.driven]
    direction = np.linalg.svd(J).U[..., -1]  # (starts, 3)
    largest = np.abs(direction).argmax(axis=-1)[:, None]
    direction = direction * np.sign(np.take_along_axis(direction, largest, axis=-1))
    goals = np.stack([_goals(machine, _along(vector)) for vector in direction], axis=1)
    return [Commands("least_half", 0.5 * goals), Commands("least_quarter", 0.25 * goals)]


def task_sequences(machine: Machine) -> list[Commands]:
    """All sequences of the evaluation: the paper's three axes and six of ours. Paper: Sec. 4.2

    Two diagonals; a circle (x-z) and a rectangle (y-z) at half the tool speed; stop and go along
    x; slow motion near the dead zone along x and z. All begin and end at rest and last `SECONDS`.
    """
    angle = np.linspace(0, 2 * np.pi, round(16 * machine.rate), endpoint=False)
    circle = [(machine.dt, 0.5 * np.cos(x), 0, 0.5 * np.sin(x)) for x in angle]
    moves = {name: _along(np.eye(3)[i]) for i, name in enumerate(AXES)}
    moves |= {
        "diagonal_flat": _along([0.5**0.5, 0.5**0.5, 0]),
        "diagonal_rise": _along([3**-0.5, -(3**-0.5), 3**-0.5]),
        "circle": np.array([REST, *circle, REST]),
        "rectangle": np.array(RECTANGLE),
        "stop_and_go": np.array(STOP_AND_GO),
        "slow": np.array(SLOW),
    }
    rng = np.random.default_rng(REST_SEED)
    return [
        Commands(name, _goals(machine, _with_rests(rows, rng)), inward=True)
        for name, rows in moves.items()
    ]


def _log_uniform(rng: np.random.Generator, num: int) -> Array:
    """Random lengths of rests [s], (num,)."""
    return np.exp(rng.uniform(np.log(SHORTEST_REST), np.log(LONGEST_REST), num))


def _with_rests(rows: Array, rng: np.random.Generator) -> Array:
    """Rows with random seconds of each rest, such that all rows last `SECONDS`."""
    rows = rows.astype(float)
    at_rest = ~rows[:, 1:].any(axis=1)
    total = SECONDS - rows[~at_rest, 0].sum()
    while True:
        seconds = _log_uniform(rng, at_rest.sum()).round(1)
        seconds[-1] = total - seconds[:-1].sum()
        if SHORTEST_REST <= seconds[-1] <= LONGEST_REST:
            rows[at_rest, 0] = rng.permutation(seconds)
            return rows


def _along(direction: ArrayLike) -> Array:
    """Rows of the pattern `AXIS` along a unit vector (3,)."""
    return np.array([(t, *(v * np.asarray(direction, float))) for t, v in AXIS])


def _goals(machine: Machine, rows: Array) -> Array:
    """Goals [m/s] (T, 3) of rows of seconds and fractions of tool_speed along x, y, z."""
    ticks = np.rint(rows[:, 0] * machine.rate).astype(int)
    return np.repeat(machine.tool_speed * rows[:, 1:], ticks, axis=0)


def shorten(machine: Machine, commands: Sequence[Commands], seconds: float) -> list[Commands]:
    """The first seconds of each sequence."""
    ticks = round(seconds * machine.rate)
    return [sequence._replace(goals=sequence.goals[:ticks]) for sequence in commands]


def hold_table(machine: Machine, goals: Array) -> Array:
    """Rows of seconds and the velocity [m/s] that goals (T, 3) hold for them."""
    changes = np.flatnonzero(np.any(np.diff(goals, axis=0) != 0, axis=-1)) + 1
    first = np.concatenate([[0], changes])
    seconds = np.diff([*first, len(goals)]) / machine.rate
    return np.concatenate([seconds[:, None], goals[first]], axis=1)


def read_commands(path: Path, machine: Machine) -> list[Commands]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s]; values hold until the next row.

    The last row of a sequence marks its end. ValueError: no such table, rows less than a tick
    apart, or the name "all".
    """
    table = read_table(path, COMMANDS)
    velocity = np.stack([table["vx"], table["vy"], table["vz"]], axis=1)
    result = []
    for name in dict.fromkeys(table["sequence"]):
        rows = table["sequence"] == name
        time = table["time"][rows] - table["time"][rows][0]
        ticks = round(time[-1] * machine.rate)
        if len(time) < 2 or not (np.diff(time) > 0.99 * machine.dt).all():
            got = f"got {files.brief(time.tolist())}"
            expected = "expected two or more rows, each a tick or more after the one before"
            raise ValueError(f"{path}: sequence {name}: {expected}, {got}")
        if not ticks <= LONGEST * machine.rate or name == "all":
            expected = f"expected at most {LONGEST:g} s and another name than all"
            raise ValueError(f"{path}: sequence {name}: {expected}, got {time[-1]:g} s")
        row = np.searchsorted(time, np.arange(ticks) / machine.rate + 1e-6, "right") - 1
        result.append(Commands(str(name), velocity[rows][row]))
    return result


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses [rad] (starts, n) of a CSV with one column per joint.

    ValueError: an angle outside its joint's range or a pose in the ground, with file and row, or
    too many poses: all are simulated at once.
    """
    table = read_table(path, starts_of(machine))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    if len(starts) > MOST_STARTS:
        raise ValueError(f"{path}: expected at most {MOST_STARTS} poses, got {len(starts)}")
    lowest = lowest_point(forward_kinematics(machine, starts))
    for row in np.flatnonzero(terminated(machine, lowest)):
        expected = f"expected the whole arm above {machine.ground} m"
        raise ValueError(f"{path}: row {row + 2}: {expected}, got {lowest[row]:.3f} m")
    return starts


def goals_and_starts(
    machine: Machine, commands: Path | None, starts: Path | None, num: int, seed: int
) -> tuple[list[Commands], Array]:
    """Velocity sequences and start poses of files, or the machine's own where there is no file."""
    own = task_sequences(machine)
    goals = read_commands(commands, machine) if commands else own
    if starts:
        return goals, read_starts(starts, machine)
    return goals, evaluation_starts(machine, num, own, seed + 2)


def evaluation_starts(
    machine: Machine, num: int, sequences: Sequence[Commands], seed: int
) -> Array:
    """The first `num` starts of the file that the package has for the machine, else drawn ones.

    `brokk-min starts` made the file once. ValueError: more starts than the file has.
    """
    path = files.SHIPPED / machine.name / "starts.csv"
    if not path.exists():
        return draw_starts(machine, sequences, num, np.random.default_rng(seed))
    starts = read_starts(path, machine)
    if num > len(starts):
        raise ValueError(f"{path.name}: expected at most {len(starts)} starts, got {num}")
    return starts[:num]


def workspace_starts(machine: Machine, num: int) -> Array:
    """The "workspace" poses, of which means are taken, among `num` of `evaluation_starts`."""
    starts = evaluation_starts(machine, num, task_sequences(machine), 2)
    return np.asarray(starts[np.array(start_kinds(machine, starts)) == "workspace"])


def start_kinds(machine: Machine, starts: Array) -> list[str]:
    """Kind of each start (num, n): "extended", "limits" or "workspace"; numbers assumed.

    Extended: the tool is beyond 90 % of the arm's length from the first link's end, and the
    baselines' damping acts. Limits: a driven joint is within 0.15 rad of an end of its range.
    """
    frames = forward_kinematics(machine, starts)
    reach = np.linalg.norm(frames.p[:, -1] - frames.p[:, 1], axis=-1)
    slide = [joint.q_max * (joint.kind == "prismatic") for joint in machine.joints]
    length = np.hypot(machine.column("a"), machine.column("d") + slide)[1:].sum()
    w = manipulability(jacobian(frames)[..., machine.driven])
    extended = (reach > 0.9 * length) & (w < manipulability_threshold(machine))
    margin = np.minimum(starts - machine.column("q_min"), machine.column("q_max") - starts)
    at_limit = margin[:, machine.driven].min(axis=-1) < 0.15
    kinds: list[str] = np.select([extended, at_limit], ["extended", "limits"], "workspace").tolist()
    return kinds


def draw_starts(
    machine: Machine, sequences: Sequence[Commands], num: int, rng: np.random.Generator
) -> Array:
    """Random poses [rad] (num, n): of four, two "workspace", one "limits", one "extended".

    All sequences are `feasible` from the first kind, at least half of them from the second.
    Where a machine has no poses of a kind in 8 draws, "workspace" ones replace them. Paper: Fig. 6a
    ValueError: too few poses in 200 draws, or none in 8, with the criterion that most of them fail.
    """
    order = [("workspace", "limits", "workspace", "extended")[i % 4] for i in range(num)]
    kept: dict[str, list[Array]] = {kind: [] for kind in KINDS}
    failures: list[NDArray[np.int64]] = []
    with progress(total=num, desc="draw starts", unit="start") as bar:
        for draw in range(200):
            poses = draw_pose(machine, TaskConfig(), rng, 4000).round(4)
            for kind, poses_of_kind in _select(machine, poses, sequences, failures).items():
                kept[kind] += list(poses_of_kind)
            if draw == TRIES - 1:  # a kind without poses until now has none
                order = [kind if kept[kind] else "workspace" for kind in order]
            missing = [kind for kind in KINDS if len(kept[kind]) < order.count(kind)]
            bar.update(sum(min(len(kept[kind]), order.count(kind)) for kind in KINDS) - bar.n)
            if not missing or (draw == TRIES - 1 and not kept["workspace"]):
                break
    if missing:
        got = f"got {len(kept[missing[0]])} {missing[0]} ones in {draw + 1} draws"
        expected = f"expected {num} poses from which all sequences are feasible"
        raise ValueError(f"{machine.name}: {expected}, {got}; {most_frequent(failures)}")
    return np.array([kept[kind].pop(0) for kind in order])


def _select(
    machine: Machine, poses: Array, sequences: Sequence[Commands], failures: list[NDArray[np.int64]]
) -> dict[str, Array]:
    """Poses (num, n) that may be starts, by kind; `failures` gets those of `first_failure`."""
    kinds = np.array(start_kinds(machine, poses))
    workspace = poses[kinds == "workspace"][:1500]
    limits = poses[kinds == "limits"][:30]
    feasible_sequences = np.zeros(len(limits))
    for sequence in sequences:
        failure = first_failure(machine, workspace, sequence.for_starts(machine, workspace))
        failures.append(failure)
        workspace = workspace[failure == 0]
        feasible_sequences += feasible(machine, limits, sequence.for_starts(machine, limits))
    limits = limits[feasible_sequences >= 0.5 * len(sequences)]
    return {"workspace": workspace, "limits": limits, "extended": poses[kinds == "extended"]}


def tuning_set(machine: Machine, num: int, seed: int, seconds: float = 20.0) -> tuple[Array, Array]:
    """`feasible` starts [rad] (num, n) and goals [m/s] (T, num, 3) for tuning the baselines.

    `learning.episodes.reset` draws them, as for the policy; but half of the time the tool rests,
    and rests are as long as scored ones. ValueError: too few in 60 draws, or none in 8.
    """
    rng = np.random.default_rng(seed + 1000)
    config = TaskConfig(zero_goals=0.3)
    holds = int(np.ceil(seconds / config.hold_min_s))  # goals of a run: enough, however short
    tick = np.arange(round(seconds * machine.rate))[:, None]
    starts = np.empty((0, machine.n))
    goals = np.empty((len(tick), 0, 3), np.float32)
    failures: list[NDArray[np.int64]] = []
    for draw in range(60):
        drawn = reset(machine, config, rng, 200 * holds, plant=False)
        rests = np.rint(_log_uniform(rng, 200 * holds) * machine.rate).astype(int)
        ticks = np.where(drawn.v_goal.any(axis=-1), drawn.goal_ticks, rests)
        first = np.concatenate([[0], np.cumsum(ticks)])[:-1:holds]  # tick of each run
        v_goal = np.repeat(drawn.v_goal, ticks, axis=0)[first + tick]  # (T, 200, 3)
        q = drawn.q[::holds]
        failure = first_failure(machine, q, v_goal)
        failures.append(failure)
        starts = np.concatenate([starts, q[failure == 0]])
        goals = np.concatenate([goals, v_goal[:, failure == 0]], axis=1)
        if len(starts) >= num:
            return starts[:num], goals[:, :num]
        if draw == TRIES - 1 and not len(starts):
            break
    expected = f"expected {num} feasible runs to tune on, got {len(starts)}"
    raise ValueError(f"{machine.name}: {expected}; {most_frequent(failures)}")
