"""Velocity sequences and start poses: the ones that score, the user's own, and others for tuning.

Sequences and starts that score are never used for tuning; `tuning_goals` makes the others.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from brokk_min import jacobian, kinematics
from brokk_min.actuator import lever_arm
from brokk_min.env import TaskConfig, terminated
from brokk_min.identification import files
from brokk_min.learning.episodes import draw_pose, reset
from brokk_min.machine import PWM_MAX, Array, Machine, valve_opening

AXES = "xyz"
# One axis of the paper's experiment: seconds and share of tool_speed (assumed), with changes of direction.
PATTERN = ((1, 0.0), (4, 2 / 3), (1, 0.0), (4, -2 / 3), (1, 0.0), (3, 1 / 3), (3, -1 / 3), (1, 0.0))
# Others of the same length (assumed): seconds, then the velocity in shares of tool_speed.
BOX = ((1, 0, 0, 0), (5, 0, 0.5, 0), (3, 0, 0, 0.5), (5, 0, -0.5, 0), (3, 0, 0, -0.5), (1, 0, 0, 0))
STOPS = (
    (1, 0, 0, 0),
    *((1, 2 / 3, 0, 0), (1, 0, 0, 0)) * 4,
    *((1, -2 / 3, 0, 0), (1, 0, 0, 0)) * 4,
    (1, 0, 0, 0),
)
SLOW = (
    (1, 0, 0, 0),
    (4, 0.1, 0, 0),
    (4, -0.1, 0, 0),
    (4, 0, 0, 0.1),
    (4, 0, 0, -0.1),
    (1, 0, 0, 0),
)
KINDS = ("workspace", "limits", "extended")  # of starts, see `start_kinds`


class Commands(NamedTuple):
    """A named sequence of wanted tool velocities [m/s] at the control rate, (T, 3) or (T, starts, 3)."""

    name: str
    goals: Array

    def of_each(self, num: int) -> Array:
        """Goals of the first `num` starts, (T, num, 3)."""
        return (
            self.goals[:, :num]
            if self.goals.ndim == 3
            else np.repeat(self.goals[:, None], num, axis=1)
        )


def axis_sequences(machine: Machine) -> list[Commands]:
    """One sequence along x, one along y, one along z. Paper: Fig. 6"""
    return [Commands(name, _along(machine, np.eye(3)[i])) for i, name in enumerate(AXES)]


def least_motion(machine: Machine, starts: Array) -> list[Commands]:
    """The axis pattern along the direction in which the arm at each of `starts` (num, n) can hardly move.

    At a half and a quarter of its speed (assumed): at the whole, it is the joints' own speed that limits
    the tool near a singularity, and not damping. The direction is the left singular vector of the
    Jacobian's least singular value, its largest component positive.

    Paper: Fig. 6e, Fig. 6f
    """
    direction = np.linalg.svd(
        kinematics.jacobian(kinematics.forward_kinematics(machine, starts))[..., machine.driven]
    )[0][..., -1]
    largest = np.abs(direction).argmax(axis=-1)[:, None]
    direction = direction * np.sign(np.take_along_axis(direction, largest, axis=-1))
    goals = np.stack([_along(machine, towards) for towards in direction], axis=1)
    return [Commands("least_half", 0.5 * goals), Commands("least_quarter", 0.25 * goals)]


def _along(machine: Machine, direction: ArrayLike) -> Array:
    """The axis pattern along a unit vector (3,)."""
    rows = [(seconds, *(share * np.asarray(direction, float))) for seconds, share in PATTERN]
    return _held(machine, rows)


def _held(machine: Machine, rows: ArrayLike) -> Array:
    """Goals [m/s] (T, 3) of rows (seconds, shares of tool_speed along x, y, z)."""
    table = np.asarray(rows, float)
    ticks = np.rint(table[:, 0] * machine.rate).astype(int)
    return np.repeat(machine.tool_speed * table[:, 1:], ticks, axis=0)


def held_rows(machine: Machine, goals: Array) -> Array:
    """`_held` turned round: rows of seconds and the velocity [m/s] held for them, of goals (T, 3)."""
    at = np.concatenate([[0], np.flatnonzero(np.any(np.diff(goals, axis=0) != 0, axis=-1)) + 1])
    seconds = np.diff([*at, len(goals)]) / machine.rate
    return np.concatenate([seconds[:, None], goals[at]], axis=1)


def task_sequences(machine: Machine) -> list[Commands]:
    """All sequences that score, 18 s each: the paper's three axes and seven of ours.

    Two diagonals; a circle (x-z) and a rectangle (y-z) in vertical planes at half the tool speed; stop and
    go along x; slow motion near the dead zone along x and z. Paper: Sec. 4.2
    """
    turn = np.linspace(0, 2 * np.pi, round(16 * machine.rate), endpoint=False)
    circle = 0.5 * machine.tool_speed * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    rest = np.zeros((round(machine.rate), 3))
    return [
        *axis_sequences(machine),
        Commands("diagonal_flat", _along(machine, [0.5**0.5, 0.5**0.5, 0])),
        Commands("diagonal_rise", _along(machine, [3**-0.5, -(3**-0.5), 3**-0.5])),
        Commands("circle", np.concatenate([rest, circle, rest])),
        Commands("rectangle", _held(machine, BOX)),
        Commands("stop_and_go", _held(machine, STOPS)),
        Commands("slow", _held(machine, SLOW)),
    ]


def read_commands(path: Path, machine: Machine) -> list[Commands]:
    """Sequences of a CSV `sequence,time,vx,vy,vz` [s, m/s], each value held until the next row.

    The last row of a sequence marks its end.
    """
    table = files.read_table(path, ["sequence", "time", "vx", "vy", "vz"], text=("sequence",))
    result = []
    for name in dict.fromkeys(table["sequence"]):
        rows = np.flatnonzero(table["sequence"] == name)
        time = table["time"][rows] - table["time"][rows[0]]
        if len(rows) < 2 or not (np.diff(time) > 0).all():
            raise ValueError(f"{path}: sequence {name}: expected two or more rows with rising time")
        if round(time[-1] * machine.rate) < 1 or name == "all":
            raise ValueError(
                f"{path}: sequence {name}: expected a tick or more and another name than all"
            )
        at = np.searchsorted(
            time, np.arange(round(time[-1] * machine.rate)) / machine.rate + 1e-6, "right"
        )
        goals = np.stack([table[c][rows][at - 1] for c in ("vx", "vy", "vz")], axis=1)
        result.append(Commands(str(name), goals))
    return result


def read_starts(path: Path, machine: Machine) -> Array:
    """Start poses of a CSV with one column a joint [rad], shape (starts, n).

    ValueError: an angle outside its joint's range or a pose in the ground, with file and row.
    """
    table = files.read_table(path, list(machine.names))
    starts = np.stack([table[name] for name in machine.names], axis=1)
    low, high = machine.column("q_min"), machine.column("q_max")
    for row, joint in np.argwhere((starts < low) | (starts > high)):
        wanted = f"column {machine.names[joint]}: expected {low[joint]} to {high[joint]} rad"
        raise ValueError(f"{path}: row {row + 2}, {wanted}, got {starts[row, joint]}")
    lowest = kinematics.lowest_point(kinematics.forward_kinematics(machine, starts))
    for row in np.flatnonzero(terminated(machine, lowest)):
        wanted = f"expected the whole arm above {machine.ground} m"
        raise ValueError(f"{path}: row {row + 2}: {wanted}, got {lowest[row]:.3f} m")
    return starts


def feasible(machine: Machine, start: Array, goals: Array) -> NDArray[np.bool_]:
    """Can ideal actuators follow `goals` (T, num, 3) from `start` (num, n)? Shape (num,).

    Integrates lightly damped resolved rates with joint-limit weights. Margins, all assumed: the tool stays
    within 20 mm of its path (no singularity is crossed), joints 0.05 rad off their limits and below 0.9 of
    `speed_limits` (a tracking controller needs room to correct), the arm 0.1 m off the ground.
    """
    q, driven = np.array(start, float), machine.driven
    low, high = machine.column("q_min")[driven] + 0.05, machine.column("q_max")[driven] - 0.05
    frames = kinematics.forward_kinematics(machine, q)
    wanted = kinematics.tool_position(frames)
    good = kinematics.lowest_point(frames) > machine.ground + 0.1
    rates = np.zeros_like(q)
    for goal in goals:
        frames = kinematics.forward_kinematics(machine, q)
        p = kinematics.tool_position(frames)
        J = kinematics.jacobian(frames)[..., driven]
        inverse = jacobian.dls(
            J, jacobian.limit_weights(machine, q, rates)[:, driven], np.full(len(q), 1e-4)
        )
        rates = np.zeros_like(q)
        rates[:, driven] = (inverse @ (goal + (wanted - p))[..., None])[..., 0]
        q, wanted = q + rates * machine.dt, wanted + goal * machine.dt
        inside = ((q[:, driven] > low) & (q[:, driven] < high)).all(-1)
        down, up = speed_limits(machine, q)
        slow = ((rates > 0.9 * down) & (rates < 0.9 * up))[:, driven].all(-1)
        near = np.linalg.norm(wanted - p, axis=-1) < 0.02
        good &= inside & slow & near & (kinematics.lowest_point(frames) > machine.ground + 0.1)
    return good


def speed_limits(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Fastest negative and positive velocity [rad/s] (..., n) that a joint alone can hold at angles `q`.

    At the command limit. Paper: eq1
    """
    opening = valve_opening(machine.pwm_limit / PWM_MAX, machine.dead_zone)
    arm = lever_arm(machine, q)
    speeds = -machine.column("speed_negative"), machine.column("speed_positive")
    down, up = (opening * speed / arm for speed in speeds)
    return down, up


def start_kinds(machine: Machine, starts: Array) -> list[str]:
    """Kind of each start (num, n), numbers assumed: "extended", "limits" or "workspace".

    Extended: tool beyond 90 % of the arm's length from the first link's end, and so near a singularity that
    the baselines' damping acts. Limits: a driven joint within 0.15 rad of an end of its range.
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    ends = kinematics.forward_kinematics(machine, starts).p
    reach = np.linalg.norm(ends[:, -1] - ends[:, 1], axis=-1)
    length = np.hypot(machine.column("a"), machine.column("d"))[1:].sum()
    w0 = jacobian.manipulability_threshold(machine)
    damped = (
        jacobian.manipulability(
            kinematics.jacobian(kinematics.forward_kinematics(machine, starts))[..., machine.driven]
        )
        < w0
    )
    room = np.minimum(starts - low, high - starts)[:, machine.driven].min(axis=-1)
    kinds = np.where((reach > 0.9 * length) & damped, 2, np.where(room < 0.15, 1, 0))
    return [KINDS[kind] for kind in kinds]


def draw_starts(
    machine: Machine, sequences: Sequence[Commands], num: int, rng: np.random.Generator
) -> Array:
    """Random poses (num, n) [rad]: of four, two "workspace", one "limits", one "extended". Paper: Fig. 6a

    From the first kind all sequences are `feasible`, from the second at least half of them; the third leaves
    parts of them out of reach. Where a machine has no poses of a kind, "workspace" stands in.

    ValueError: too few poses in many draws.
    """
    kept: dict[str, list[Array]] = {kind: [] for kind in KINDS}
    order = [KINDS[(0, 1, 0, 2)[i % 4]] for i in range(num)]
    goals = [sequence.goals[:, None] for sequence in sequences]
    with tqdm(total=num, desc="draw starts", unit="start", disable=None) as bar:
        for _ in range(200):
            for kind, poses in _by_kind(
                machine, draw_pose(machine, TaskConfig(), rng, 4000).round(4), goals
            ):
                kept[kind] += list(poses)
            found = sum(min(len(kept[kind]), order.count(kind)) for kind in KINDS)
            bar.update(found - bar.n)
            if found == num:
                break
    try:
        return np.array([kept[kind if kept[kind] else KINDS[0]].pop(0) for kind in order])
    except IndexError:
        wanted = f"{num} poses from which all sequences are feasible"
        raise ValueError(f"{machine.name}: expected {wanted}, got fewer in 200 draws") from None


def _by_kind(machine: Machine, poses: Array, goals: Sequence[Array]) -> Iterator[tuple[str, Array]]:
    """Which of `poses` (num, n) `draw_starts` may keep as starts of each kind, (k, n); `goals` (T, 1, 3)."""
    kinds = np.array(start_kinds(machine, poses))
    inside, near, far = (
        poses[kinds == kind][:n] for kind, n in zip(KINDS, (1500, 30, 4000), strict=True)
    )
    good = [feasible(machine, near, np.repeat(goal, len(near), axis=1)) for goal in goals]
    for goal in goals:
        inside = inside[feasible(machine, inside, np.repeat(goal, len(inside), axis=1))]
    return zip(KINDS, (inside, near[np.mean(good, axis=0) >= 0.5], far), strict=True)


def scored_starts(machine: Machine, num: int, sequences: Sequence[Commands], seed: int) -> Array:
    """The first `num` starts of the machine's own file in the package, or drawn where it has none.

    `brokk-min starts` made the file once. ValueError: more starts than the file has.
    """
    path = files.SHIPPED / machine.name / "starts.csv"
    if not path.exists():
        return draw_starts(machine, sequences, num, np.random.default_rng(seed))
    starts = read_starts(path, machine)
    if num > len(starts):
        raise ValueError(f"{path.name}: expected at most {len(starts)} starts, got {num}")
    return starts[:num]


def goals_and_starts(
    machine: Machine, commands: Path | None, starts: Path | None, num: int, seed: int
) -> tuple[list[Commands], Array]:
    """Velocity sequences and start poses of files, or where there is none the machine's own."""
    own = task_sequences(machine)
    poses = read_starts(starts, machine) if starts else scored_starts(machine, num, own, seed + 2)
    return read_commands(commands, machine) if commands else own, poses


def write_starts(path: Path, machine: Machine, starts: Array) -> None:
    """Write poses as `read_starts` reads them."""
    files.write_csv(path, machine.names, starts.tolist())


def tuning_goals(machine: Machine, runs: int, seconds: float, seed: int) -> tuple[Array, Array]:
    """Feasible starts (runs, n) and goals (T, runs, 3), drawn as the policy's by `reset`: for tuning only.

    ValueError: too few in many draws.
    """
    rng, config, ticks = np.random.default_rng(seed), TaskConfig(), round(seconds * machine.rate)
    holds = int(np.ceil(seconds / config.hold_min_s))  # that many are always long enough
    starts, kept = list[Array](), list[Array]()
    with tqdm(total=runs, desc="draw tuning runs", unit="run", disable=None) as bar:
        for _ in range(60):
            drawn = reset(machine, config, rng, 200 * holds, plant=False)
            rows = [slice(i, i + holds) for i in range(0, 200 * holds, holds)]
            goals = np.array(
                [np.repeat(drawn.v_goal[r], drawn.goal_ticks[r], axis=0)[:ticks] for r in rows]
            )
            good = feasible(machine, drawn.q[::holds], goals.swapaxes(0, 1))
            starts += list(drawn.q[::holds][good])
            kept += list(goals[good])
            bar.update(min(runs, len(starts)) - bar.n)
            if len(starts) >= runs:
                return np.array(starts[:runs]), np.array(kept[:runs]).swapaxes(0, 1)
    raise ValueError(f"{machine.name}: expected {runs} feasible runs to tune on, got {len(starts)}")
