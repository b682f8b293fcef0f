"""How the machine is made to show what it does, and what is recorded: commands in, encoder angles out.

Nets are fitted to what `collect` records, one actuator at a time, over its whole range. They are judged on
`task_log`, which moves the joints together, as a policy does.
"""

from collections.abc import Callable
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from brokk_min.actuator import plant_reset, plant_step
from brokk_min.identification.logs import RETURN, Log, machine_log
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, read_encoder

Tape = tuple[str, Array, Array]  # name, commands and encoder angles (T, n)
# Shares of what rich excitation is made of, assumed.
MIX = {"sine": 0.17, "step": 0.1, "holds": 0.17, "go": 0.21, "hover": 0.35}
BARELY = 0.049  # of full command, assumed: a valve so far beyond its dead zone is barely open
LEG = 30.0  # s, assumed: the longest drive that is recorded in one piece
MAX_RETURN = 300.0  # s, assumed: a way back to the start that takes longer is broken off


def sine_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """One sine of random amplitude (dead zone to limit) and frequency, (ticks,). Paper: Sec. 3.3."""
    amplitude = rng.uniform(machine.dead_zone, machine.pwm_limit / PWM_MAX)
    frequency, phase = rng.uniform(0.02, 0.5), rng.uniform(0, 2 * np.pi)
    return np.asarray(
        amplitude * np.sin(2 * np.pi * frequency * machine.dt * np.arange(ticks) + phase)
    )


def rich_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """Sines over a wide band, steps, random holds, starts out of rests and off barely open valves, (ticks,).

    Steps last up to 10 s, so that joints also run through to their stops, and so do series of starts, so
    that most of them come out of long rests. Levels are drawn up to a third above the limit: cut there, a
    quarter are at the limit, as a policy's.
    """
    limit = 4 / 3 * machine.pwm_limit / PWM_MAX
    parts: list[Array] = []
    while sum(map(len, parts)) < ticks:
        kind = rng.choice(list(MIX), p=list(MIX.values()))
        length = int(rng.uniform(0.5, 4.0 if kind in ("sine", "holds") else 10.0) / machine.dt)
        time = machine.dt * np.arange(length)
        amplitude = rng.uniform(machine.dead_zone, limit)
        if kind == "sine":
            frequency = np.exp(rng.uniform(np.log(0.05), np.log(4.0)))
            middle, phase = rng.uniform(-0.3, 0.3) * limit, rng.uniform(0, 2 * np.pi)
            part = middle + amplitude * np.sin(2 * np.pi * frequency * time + phase)
        elif kind == "step":
            part = np.full(length, rng.choice([-1, 1]) * amplitude)
        elif kind == "holds":
            hold = int(rng.integers(1, 8))
            part = np.repeat(rng.uniform(-limit, limit, length // hold + 1), hold)[:length]
        else:
            part = _starts(rng, machine, length, limit, _rest if kind == "go" else _hover)
        if kind in ("sine", "step", "holds") and rng.random() < 0.5:
            part = part + rng.uniform(0, 0.08) * rng.standard_normal(length)
        parts.append(part)
    return np.concatenate(parts)[:ticks]


def _starts(
    rng: np.random.Generator,
    machine: Machine,
    length: int,
    limit: float,
    wait: Callable[..., Array],
) -> Array:
    """Levels up to `limit` for 0.1 to 1 s, each after a `wait`, (length,)."""
    pieces: list[Array] = []
    restless = rng.choice([0, 1]) * rng.uniform(0, machine.dead_zone)  # a hand within the dead zone
    while sum(map(len, pieces)) < length:
        move = int(rng.uniform(0.1, 1.0) / machine.dt)
        pieces += [wait(rng, machine, restless), np.full(move, rng.uniform(-limit, limit))]
    return np.concatenate(pieces)[:length]


def _rest(rng: np.random.Generator, machine: Machine, restless: float) -> Array:
    """A rest, in half of the cases until the valve is idle, with noise of size `restless`."""
    idle, short = 5 * machine.tau_valve_down, np.exp(rng.uniform(np.log(0.05), np.log(3.0)))
    ticks = int((idle if rng.random() < 0.5 else short) / machine.dt)
    return restless * rng.uniform(-1, 1, ticks)


def _hover(rng: np.random.Generator, machine: Machine, _: float) -> Array:
    """A valve barely open or not quite, to one side or to and fro: where it wakes is what nets must know."""
    ticks = int(rng.uniform(0.2, 2.0) / machine.dt)
    turns = np.arange(ticks) // rng.choice([1, 2, 3, 4, 6, ticks])
    side = rng.choice([-1, 1])
    level = rng.uniform(0.9 * machine.dead_zone, machine.dead_zone + BARELY)
    return np.asarray(side * level * (-1.0) ** turns)


EXCITATIONS = {"sine": sine_command, "rich": rich_command}


class _Recorder:
    """The plant as a log sees it: commands in, encoder angles out, (rows, n) each tick, all kept."""

    def __init__(self, machine: Machine, q: Array) -> None:
        self.machine, self.state = machine, plant_reset(machine, q)
        self.u: list[Array] = []
        self.q = [
            read_encoder(machine, q)
        ]  # one more than commands: the newest angle is not logged yet

    def play(self, u: Array) -> None:
        """One tick under the wanted commands `u`."""
        self.u.append(limit_command(self.machine, u))
        self.state = plant_step(self.machine, self.state, self.u[-1])
        self.q.append(read_encoder(self.machine, self.state.q))

    def tape(self, name: str, row: int, start: int = 0, end: int | None = None) -> Tape:
        """Ticks `start` to `end` of one row."""
        end = len(self.u) if end is None else end
        u, q = (np.array([tick[row] for tick in ticks[start:end]]) for ticks in (self.u, self.q))
        return name, u, q


def collect(machine: Machine, hours: float, excitation: str, rng: np.random.Generator) -> Log:
    """Record the analytic plant, one actuator at a time, `hours` for each, ways back not counted.

    A recording starts with `history` samples of an idle valve, then drives for `LEG` or until the joint
    meets its limit; in rich excitation it may push there for a second in all. The way back to its start,
    and the rest there until the valve is idle, is named `..._return` and dropped by `read_log`. The
    paper's sines start at home (mid range), rich excitation at random angles. Paper: Sec. 3.3
    """
    if excitation not in EXCITATIONS:
        raise ValueError(f"excitation: expected one of {list(EXCITATIONS)}, got {excitation!r}")
    if not 0 < hours < np.inf:
        raise ValueError(f"hours: expected above 0, got {hours}")
    wanted = max(machine.history + 2, round(hours * 3600 * machine.rate))  # samples of each joint
    side_by_side = int(np.clip(wanted // 300, 1, 100))
    counted = np.zeros(machine.n, int)
    tapes: list[list[Tape]] = [[] for _ in machine.joints]
    with tqdm(
        total=wanted * machine.n, desc=f"record ({excitation})", unit="sample", disable=None
    ) as bar:
        while counted.min() < wanted:
            joint = np.repeat(np.flatnonzero(counted < wanted), side_by_side)
            recorder, back, home = _drive_legs(machine, joint, excitation, rng)
            for row, j in enumerate(joint):
                if leg := min(back[row], wanted - counted[j]):
                    name = f"{machine.names[j]}_{len(tapes[j]) // 2:03d}"
                    tapes[j].append(recorder.tape(name, row, 0, leg))
                    tapes[j].append(recorder.tape(name + RETURN, row, back[row], home[row]))
                    counted[j] += leg
                    bar.update(leg)
    return machine_log(machine, chain(*tapes))


def _leg_starts(
    machine: Machine, joint: NDArray[np.intp], excitation: str, rng: np.random.Generator
) -> Array:
    """Angles (rows, n) at which legs begin: home, mid range, or if rich anywhere for `joint[k]`."""
    low, high, row = machine.column("q_min"), machine.column("q_max"), np.arange(len(joint))
    q = np.tile((low + high) / 2, (len(row), 1))
    if excitation == "rich":  # a tenth of the legs begins at either stop
        low, high = low[joint], high[joint]
        past = (high - low) / 8
        q[row, joint] = np.clip(rng.uniform(low - past, high + past), low, high)
    return q


def _drive_legs(
    machine: Machine, joint: NDArray[np.intp], excitation: str, rng: np.random.Generator
) -> tuple[_Recorder, NDArray[np.intp], NDArray[np.intp]]:
    """Drive joint `joint[k]` of row k until it meets its limit or `LEG` is over, then back to its start.

    Returns:
        What was recorded, and the ticks (rows,) at which the ways back begin and end.
    """
    low, high, row = (
        machine.column("q_min")[joint],
        machine.column("q_max")[joint],
        np.arange(len(joint)),
    )
    q, ticks = _leg_starts(machine, joint, excitation, rng), round(LEG * machine.rate)
    start, near, length = q[row, joint], 2 * machine.encoder_step, machine.history + ticks
    commands = np.zeros((len(row), length))
    commands[:, machine.history :] = [EXCITATIONS[excitation](rng, machine, ticks) for _ in row]
    slow = (machine.dead_zone + machine.pwm_limit / PWM_MAX) / 2
    rest = round(5 * machine.tau_valve_down * machine.rate)  # ticks until a valve is idle again
    back = np.full(len(row), length)  # tick at which each way back begins
    rested = np.zeros(len(row), int)  # ticks at rest after it
    met = np.zeros(len(row), int)  # ticks at a limit
    push = machine.rate * (excitation == "rich")  # allowed ones
    recorder = _Recorder(machine, q)
    while rested.min() < rest and len(recorder.u) < length + MAX_RETURN * machine.rate:
        tick, angle = len(recorder.u), recorder.q[-1][row, joint]
        at_limit = (angle < low + near) | (angle > high - near)
        met += at_limit
        back[at_limit & (met > push) & (machine.history + machine.rate < tick) & (tick < back)] = (
            tick
        )
        arrived = (np.abs(angle - start) < max(0.06, near)) | (rested > 0)
        rested += arrived & (tick >= back)
        homeward = np.where(arrived, 0.0, slow * np.sign(start - angle))
        u = np.zeros_like(q)
        u[row, joint] = np.where(tick < back, commands[:, min(tick, length - 1)], homeward)
        recorder.play(u)
    return recorder, back, len(recorder.u) - rested + rest


def task_log(
    machine: Machine,
    runs: int,
    seconds: float,
    rng: np.random.Generator,
    start: ArrayLike | None = None,
) -> Log:
    """Recordings under commands like a policy's: reversals, small corrections, driven joints together.

    In every fifth recording the locked joints move instead: the machine lets them move only alone.
    Smoothed random levels held for 0.5 to 5 s, towards the nearer end of the range less often, so
    that the joints stay off their stops. For scoring only; no net is fitted to them. All begin at the
    angles `start` (n,), or each at random ones.
    """
    q_min, q_max = machine.column("q_min"), machine.column("q_max")
    shape, limit = (runs, machine.n), machine.pwm_limit / PWM_MAX
    drawn = rng.uniform(0.8 * q_min + 0.2 * q_max, 0.2 * q_min + 0.8 * q_max, shape)
    start = drawn if start is None else np.tile(start, (runs, 1))
    level, command, left = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    smoothing, noise = rng.uniform(0.05, 0.6, shape), rng.uniform(0, 0.06, shape)
    locked_turn = (np.arange(runs) % 5 == 4)[:, None]
    moving = np.isin(np.arange(machine.n), machine.locked) == locked_turn
    recorder = _Recorder(machine, start)
    for _ in range(round(seconds * machine.rate)):
        fraction = (recorder.q[-1] - q_min) / (q_max - q_min)
        up = rng.random(shape) > np.clip(1.5 * fraction - 0.25, 0, 1)
        drawn = np.where(up, 1, -1) * rng.uniform(0, limit, shape) * (rng.random(shape) < 0.85)
        level = np.where(left <= 0, drawn, level)
        left = np.where(left <= 0, rng.uniform(0.5, 5.0, shape), left) - machine.dt
        command = command + smoothing * (level - command)
        jitter = noise * rng.standard_normal(shape) * (level != 0)
        recorder.play(moving * (command + jitter))
    return machine_log(machine, (recorder.tape(f"task_{i:02d}", i) for i in range(runs)))
