"""Excitation that shows more of the valves than sines do.

What it changes: beside sines over a wide band a joint gets steps, random holds, starts after pauses
and from valves that are barely open, and its recordings begin anywhere in its range. The paper
records sines alone, which start at mid range and seldom leave a valve idle.

What it buys: fitted to sines, nets do not know how late a valve answers after a pause, nor what a
few counts beyond the dead zone do; policies need both. `benchmarks.ladder` has it with the nets
that read it ("alone: rich excitation, ...").

Who was first: persistence of excitation is Astrom and Bohlin's (1965); random holds of random
levels are the amplitude-modulated random signals that identification of nonlinear systems uses
(Nelles, Nonlinear System Identification, 2001).

It plugs into `fit.collect` as its excitation.
"""

import numpy as np

from brokk_min.fit import Excitation, Rows
from brokk_min.machine import PWM_MAX, Array, Machine

# Probabilities of the parts, assumed.
MIX = {"sine": 0.17, "step": 0.1, "holds": 0.17, "start": 0.21, "barely open": 0.35}
BARELY_OPEN = 0.049  # of full command beyond the dead zone, assumed: the largest of these levels
PAUSE = 2.0  # s, assumed: long enough for an idle valve to close


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


def anywhere(rng: np.random.Generator, machine: Machine, joint: Rows) -> Array:
    """Angles [rad] (rows, n): of joint `joint[k]` in row k random ones, a tenth at either limit."""
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.tile((low + high) / 2, (len(joint), 1))
    low, high = low[joint], high[joint]
    beyond = (high - low) / 8
    q[np.arange(len(joint)), joint] = np.clip(rng.uniform(low - beyond, high + beyond), low, high)
    return q


RICH = Excitation("rich", rich_command, anywhere, push=1.0)
