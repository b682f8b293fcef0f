"""Excitation of the machine: commands, and the recordings of encoder angles under them.

Nets are fitted to recordings of `collect`, which drives one actuator at a time over its range. They
are validated on `task_log`, where the joints move together, as under a policy.
"""

from itertools import chain

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from brokk_min.actuator import PLANT, Plant
from brokk_min.identification.logs import Log, machine_log
from brokk_min.identification.readings import Rows
from brokk_min.machine import PWM_MAX, Array, Machine, limit_command, read_encoder

# Probabilities of the parts of rich excitation, assumed.
MIX = {"sine": 0.17, "step": 0.1, "holds": 0.17, "start": 0.21, "barely open": 0.35}
BARELY_OPEN = 0.049  # of full command beyond the dead zone, assumed: the largest of these levels
MAX_SEGMENT = 30.0  # s, assumed: longest motion that is recorded in one piece
PAUSE = 2.0  # s, assumed: long enough for an idle valve to close


def sine_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """One sine of random amplitude (dead zone to limit) and frequency, (ticks,). Paper: Sec. 3.3

    The paper prints no frequencies. These, 0.05 to 5 Hz, are as fast as a policy's commands: on
    nets from slower sines policies learn to shake the valves.
    """
    amplitude = rng.uniform(machine.dead_zones.min(), machine.pwm_limit / PWM_MAX)
    frequency = np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
    phase = rng.uniform(0, 2 * np.pi)
    time = machine.dt * np.arange(ticks)
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * time + phase))


def rich_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """Sines over a wide band, steps, random holds, starts after pauses and from barely open valves.

    Steps last up to 10 s, so that joints also reach their stops. Levels are drawn up to a third
    above the limit: after the cut a quarter of them is at the limit, as in a policy's commands.
    """
    limit = 4 / 3 * machine.pwm_limit / PWM_MAX
    parts: list[Array] = []
    while sum(map(len, parts)) < ticks:
        kind = rng.choice(list(MIX), p=list(MIX.values()))
        longest = 4.0 if kind in ("sine", "holds") else 10.0
        length = int(rng.uniform(0.5, longest) / machine.dt)
        amplitude = rng.uniform(machine.dead_zones.min(), limit)
        if kind == "sine":
            frequency = np.exp(rng.uniform(np.log(0.05), np.log(4.0)))
            mean, phase = rng.uniform(-0.3, 0.3) * limit, rng.uniform(0, 2 * np.pi)
            time = machine.dt * np.arange(length)
            part = mean + amplitude * np.sin(2 * np.pi * frequency * time + phase)
        elif kind == "step":
            part = np.full(length, rng.choice([-1, 1]) * amplitude)
        elif kind == "holds":
            hold = int(rng.integers(1, 8))
            part = np.repeat(rng.uniform(-limit, limit, length // hold + 1), hold)[:length]
        else:
            part = _starts(rng, machine, length, limit, kind == "start")
        if kind in ("sine", "step", "holds") and rng.random() < 0.5:
            part = part + rng.uniform(0, 0.08) * rng.standard_normal(length)
        parts.append(part)
    return np.concatenate(parts)[:ticks]


def _starts(
    rng: np.random.Generator, machine: Machine, length: int, limit: float, pauses: bool
) -> Array:
    """Levels up to `limit` for 0.1 to 1 s, each after a pause or a valve barely open, (length,).

    In half of the pauses the valve becomes idle; they have the uniform noise of an operator's hand.
    """
    parts: list[Array] = []
    noise = rng.choice([0, 1]) * rng.uniform(0, machine.dead_zones.min())
    while sum(map(len, parts)) < length:
        ticks = int(rng.uniform(0.1, 1.0) / machine.dt)
        if pauses:
            short = np.exp(rng.uniform(np.log(0.05), np.log(3.0)))
            seconds = PAUSE if rng.random() < 0.5 else short
            parts.append(noise * rng.uniform(-1, 1, int(seconds / machine.dt)))
        else:
            parts.append(_barely_open(rng, machine))
        parts.append(np.full(ticks, rng.uniform(-limit, limit)))
    return np.concatenate(parts)[:length]


def _barely_open(rng: np.random.Generator, machine: Machine) -> Array:
    """A valve at its minimum opening, to one side or alternating."""
    ticks = int(rng.uniform(0.2, 2.0) / machine.dt)
    alternations = np.arange(ticks) // rng.choice([1, 2, 3, 4, 6, ticks])
    sign = rng.choice([-1, 1])
    level = rng.uniform(0.9 * machine.dead_zones.min(), machine.dead_zones.max() + BARELY_OPEN)
    return np.asarray(sign * level * (-1.0) ** alternations)


EXCITATIONS = {"sine": sine_command, "rich": rich_command}


def collect(
    machine: Machine, hours: float, excitation: str, rng: np.random.Generator, plant: Plant = PLANT
) -> Log:
    """Record a plant, one actuator at a time, `hours` for each.

    A segment begins with `history` samples of an idle valve and ends before the joint returns.
    Sines start at mid range, as in the paper, rich excitation at random angles. Paper: Sec. 3.3
    """
    goal = max(machine.history + 2, round(hours * 3600 * machine.rate))  # samples per joint
    rows = int(np.clip(goal // 300, 1, 100))  # segments of a joint that are simulated at once
    count = np.zeros(machine.n, int)
    recordings: list[list[tuple[str, Array, Array]]] = [[] for _ in machine.joints]
    title = f"record ({excitation})"
    with tqdm(total=goal * machine.n, desc=title, unit="sample", disable=None) as bar:
        while count.min() < goal:
            joint = np.repeat(np.flatnonzero(count < goal), rows)
            u, q, ended = _drive_segments(machine, plant, joint, excitation, rng)
            for row, j in enumerate(joint):
                if num := min(ended[row], goal - count[j]):
                    name = f"{machine.names[j]}_{len(recordings[j]):03d}"
                    recordings[j].append((name, u[:num, row], q[:num, row]))
                    count[j] += num
                    bar.update(num)
    return machine_log(machine, chain(*recordings))


def _drive_segments(
    machine: Machine, plant: Plant, joint: Rows, excitation: str, rng: np.random.Generator
) -> tuple[Array, Array, Rows]:
    """Commands and angles (T, rows, n) while joint `joint[k]` of row k moves, and its last ticks.

    A segment ends after its commands, or within two counts of a limit, but not within a second.
    Rich excitation pushes for a second first, and starts a tenth of its segments at either limit.
    """
    rows, rich = np.arange(len(joint)), excitation == "rich"
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.tile((low + high) / 2, (len(joint), 1))
    low, high = low[joint], high[joint]
    if rich:
        beyond = (high - low) / 8
        q[rows, joint] = np.clip(rng.uniform(low - beyond, high + beyond), low, high)
    ticks = round(MAX_SEGMENT * machine.rate)
    commands = np.zeros((machine.history + ticks, *q.shape))
    for row in rows:
        commands[machine.history :, row, joint[row]] = EXCITATIONS[excitation](rng, machine, ticks)
    commands = limit_command(machine, commands)
    state, angles = plant.reset(machine, q), []
    for u in commands:
        angles.append(read_encoder(machine, state.q))
        state = plant.step(machine, state, u)
    q, near = np.array(angles), 2 * machine.encoder_step[joint]
    at_limit = (q[:, rows, joint] < low + near) | (q[:, rows, joint] > high - near)
    late = np.arange(len(q)) > machine.history + machine.rate
    push = machine.rate if rich else 0.0  # ticks at a limit
    pushed = at_limit & (np.cumsum(at_limit, axis=0) > push) & late[:, None]
    return commands, q, np.where(pushed.any(axis=0), pushed.argmax(axis=0), len(q))


def task_log(
    machine: Machine,
    recordings: int,
    seconds: float,
    rng: np.random.Generator,
    start: ArrayLike | None = None,
    plant: Plant = PLANT,
) -> Log:
    """Recordings under commands like a policy's: driven joints together, small corrections.

    In every fifth recording the locked joints move instead. Commands are smoothed random levels
    held for 0.5 to 5 s, less often towards the nearer end of the range. For validation only.
    `recordings` is their number, `seconds` the length of each [s]. All begin at the angles `start`
    (n,) [rad]; None: at random ones.
    """
    q_min, q_max = machine.column("q_min"), machine.column("q_max")
    shape, limit = (recordings, machine.n), machine.pwm_limit / PWM_MAX
    q = rng.uniform(0.8 * q_min + 0.2 * q_max, 0.2 * q_min + 0.8 * q_max, shape)
    if start is not None:
        q = np.tile(start, (recordings, 1))
    level, command, remaining = np.zeros((3, *shape))
    smoothing = rng.uniform(0.05, 0.6, shape)
    noise = rng.uniform(0, 0.06, shape)
    move_locked = (np.arange(recordings) % 5 == 4)[:, None]
    moving = np.isin(np.arange(machine.n), machine.locked) == move_locked
    state, u_log, q_log = plant.reset(machine, q), [], []
    for _ in range(round(seconds * machine.rate)):
        q_log.append(read_encoder(machine, state.q))
        fraction = (q_log[-1] - q_min) / (q_max - q_min)
        up = rng.random(shape) > np.clip(1.5 * fraction - 0.25, 0, 1)
        drawn = np.where(up, 1, -1) * rng.uniform(0, limit, shape) * (rng.random(shape) < 0.85)
        level = np.where(remaining <= 0, drawn, level)
        remaining = np.where(remaining <= 0, rng.uniform(0.5, 5.0, shape), remaining) - machine.dt
        command = command + smoothing * (level - command)
        jitter = noise * rng.standard_normal(shape) * (level != 0)
        u_log.append(limit_command(machine, moving * (command + jitter)))
        state = plant.step(machine, state, u_log[-1])
    u, q = np.stack(u_log, axis=1), np.stack(q_log, axis=1)
    return machine_log(machine, [(f"task_{i:02d}", u[i], q[i]) for i in range(recordings)])
