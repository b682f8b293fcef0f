"""Faults on the bus: time until the valves are closed, in simulated time, as a Markdown table.

    python -m benchmarks.faults [--repeats 20] [--json F]
    python -m benchmarks.faults --frozen
    python -m benchmarks.faults --recorded
    python -m benchmarks.faults --hours 1

Machine, bus and `hw.Drive` run in one process on one clock. A fault of an encoder is repeated over
the joints. `--frozen` prints instead how long a frozen encoder takes at each command, `--recorded`
how long in drives of the shipped policy, frozen there at each tick. `--hours` drives
instead for that long of simulated time, and prints the memory.
"""

from __future__ import annotations

import gc
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks import POLICY, memory, write
from brokk_min.actuator import PLANT
from brokk_min.can.safety_gate import SLEW, expected_motion, gate_start, still_counts
from brokk_min.cli.operating import status
from brokk_min.evaluation.rollout import rollout
from brokk_min.evaluation.sequences import task_sequences
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170, PWM_MAX

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers_bus import ConstantCommand, HoldingOperator, World
from helpers_faults import FAULTS, NOT_FOUND, measure


@dataclass
class Options:
    repeats: int = 20  # Of each fault, at other moments between two SYNCs.
    only: str = ""  # Kinds of faults whose names match this regular expression.
    frozen: bool = False  # Times of frozen encoders by command instead.
    recorded: bool = False  # Times of frozen encoders in drives of the policy instead.
    hours: float = 0.0  # Drive for this long of simulated time, and print the memory.
    json: Path | None = None  # Also write the figures here.


def groups(faults: dict[str, Any]) -> dict[str, list[Any]]:
    """Faults of one kind at several joints under one name."""
    kinds = defaultdict(list)
    for name, fault in faults.items():
        joint = re.fullmatch(r"q[1-5] (.*)", name) if faults is FAULTS else None
        kinds[f"position {joint[1]}" if joint else name].append(fault)
    return kinds


def table(repeats: int, only: str) -> list[dict[str, Any]]:
    """One row a kind of fault; `words` without the joint's name."""
    rows = []
    print("| fault | median, worst [ms] | latched | words, or why it is not found |")
    print("|---|---|---|---|")
    for faults in (FAULTS, NOT_FOUND):
        for name, kinds in groups(faults).items():
            if not re.search(only, name):
                continue
            phases = (np.arange(repeats) + 0.5) / repeats * 0.05
            outcomes = [measure(kinds[k % len(kinds)][0], phases[k]) for k in range(repeats)]
            latched = sum(bool(outcome.latched) for outcome in outcomes)
            times = [1e3 * outcome.seconds for outcome in outcomes]
            said = {re.sub(r"^(fault: )?(q\d: )?| \(.*", "", outcome.words) for outcome in outcomes}
            words = "; ".join(sorted(said - {""})) if faults is FAULTS else kinds[0][1]
            row = {"fault": name, "median": float(np.median(times)), "worst": max(times)}
            rows.append(row | {"latched": latched, "repeats": repeats, "words": words})
            span = f"{row['median']:.0f}, {row['worst']:.0f}" if latched else "not found"
            print(f"| {name} | {span} | {latched} of {repeats} | {words} |", flush=True)
    return rows


def frozen_times(counts: int, moving: bool, rng: np.random.Generator) -> np.ndarray:
    """Time [s] from the freezing of an encoder to the gate's fault, many runs: inf, not found.

    One joint of 200 machines moves alone under `counts` [of 127], up or down; its encoder freezes
    at a random moment of a tick, in motion or before the command.
    """
    m, num, first = BROKK_170, 200, 40 if moving else 0
    joint, up = rng.choice(m.driven, num), rng.choice([-1, 1], num)
    low, high = m.column("q_min"), m.column("q_max")
    fraction = np.where(up > 0, rng.uniform(0.1, 0.4, num), rng.uniform(0.6, 0.9, num))
    plant = PLANT.reset(m, low + (high - low) * fraction[:, None])
    moment = rng.uniform(0, 1, num)  # of tick `first`
    frozen = np.rint(plant.q / m.encoder_step).astype(int)
    gate, found = gate_start(m, (num,))._replace(place=frozen), np.full(num, np.inf)
    for tick in range(first + 60):
        q = plant.q
        place, motion = expected_motion(m, gate, frozen)
        fault = (motion > 3 * still_counts(m) * m.encoder_step).any(axis=-1)
        found = np.where(fault & np.isinf(found), tick, found)
        sent = np.zeros((num, m.n), int)
        before = np.abs(gate.sent[range(num), joint, -1])
        sent[range(num), joint] = up * np.minimum(before + SLEW, counts)
        history = np.concatenate([gate.sent[..., 1:], sent[..., None]], axis=-1)
        gate = gate._replace(sent=history, place=place, motion=motion)
        plant = PLANT.step(m, plant, sent / PWM_MAX)
        if tick < first:
            frozen = np.rint(plant.q / m.encoder_step).astype(int)
        elif tick == first:
            q = q + moment[:, None] * (plant.q - q)
            frozen = np.rint(q / m.encoder_step).astype(int)
    return (found - first - moment) * m.dt


def frozen_table() -> list[dict[str, float]]:
    """Median and worst times of frozen encoders by command."""
    rng = np.random.default_rng(0)
    rows = []
    print("| command, counts of 127 | joint was moving [s] | joint was at rest [s] |")
    print("|---|---|---|")
    for counts in (80, 60, 40, 30, 20, 16, 14):
        times = [frozen_times(counts, moving, rng) for moving in (True, False)]
        cells = [f"{np.median(t):.2f}, at most {t.max():.2f}" for t in times]
        print(f"| {counts} | {cells[0]} | {cells[1]} |".replace("inf", "never"))
        rows.append({"counts": counts, "moving": times[0].max(), "rest": times[1].max()})
    return rows


def recorded_drives() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Angles [encoder counts] and commands [counts of 127] (T, n) of drives of the policy."""
    m, rng = BROKK_170, np.random.default_rng(0)
    policy = load_policy(POLICY, m)
    start = np.array([m.q_start])
    for sequence in task_sequences(m):
        trace = rollout(m, policy, start, sequence.for_starts(m, start), 0.0, rng)
        q, u = np.concatenate([start, trace.q[:-1, 0]]), trace.u[:, 0]
        yield np.rint(q / m.encoder_step).astype(int), np.rint(u * PWM_MAX).astype(int)


def frozen_on_drive(counts: np.ndarray, sent: np.ndarray, most: int = 60) -> np.ndarray:
    """Speed [rad/s], time to the fault [s] and angle turned until then [rad] (num, 3).

    One row for each driven joint and each tick at which its encoder freezes. The commands stay as
    they were recorded. A false alarm without any fault is an AssertionError.
    """
    m, state = BROKK_170, gate_start(BROKK_170)
    before = np.concatenate([np.zeros_like(state.sent.T), sent])
    windows = np.lib.stride_tricks.sliding_window_view(before, state.sent.shape[-1], axis=0)
    limit = 3 * still_counts(m) * m.encoder_step
    places, motions = counts.astype(float), np.zeros(counts.shape)
    for t in range(1, len(counts)):
        state = state._replace(sent=windows[t], place=places[t - 1], motion=motions[t - 1])
        places[t], motions[t] = expected_motion(m, state, counts[t])
        assert (motions[t] <= limit).all(), "false alarm"
    at = np.arange(4, len(counts) - most)
    frozen = counts[at]
    state = state._replace(place=places[at], motion=motions[at])
    ticks = np.full(frozen.shape, most)
    for k in range(1, most):
        place, motion = expected_motion(m, state._replace(sent=windows[at + k]), frozen)
        state = state._replace(place=place, motion=motion)
        ticks = np.where(motion > limit, np.minimum(ticks, k), ticks)
    later = np.take_along_axis(counts, at[:, None] + ticks, axis=0)
    speed = np.abs(frozen - counts[at - 4]) * m.encoder_step / (4 * m.dt)
    seconds = np.where(ticks < most, ticks * m.dt, np.inf)
    rows = np.stack([speed, seconds, np.abs(later - frozen) * m.encoder_step], axis=-1)
    return rows[:, m.driven].reshape(-1, 3)


def recorded_table() -> list[dict[str, float]]:
    """Times to the fault by how fast the joint turns when its encoder freezes."""
    rows = np.concatenate([frozen_on_drive(*drive) for drive in recorded_drives()])
    print("| speed [rad/s] | cases | within 175 ms | found | median, 95 % [s] | turned [rad] |")
    print("|---|---|---|---|---|---|")
    table = []
    for low, high in ((0.1, np.inf), (0.05, 0.1), (0.02, 0.05)):
        _, seconds, turned = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)].T
        found = np.isfinite(seconds)
        row = {"from": low, "cases": len(found), "within_175_ms": (seconds <= 0.175).mean()}
        row |= {"found": found.mean(), "median": np.median(seconds[found])}
        row |= {"p95": np.percentile(seconds[found], 95), "turned": np.median(turned[found])}
        table.append({name: float(value) for name, value in row.items()})
        shares = f"{row['within_175_ms']:.0%} | {row['found']:.0%}"
        times = f"{row['median']:.2f}, {row['p95']:.2f} | {row['turned']:.3f}"
        print(f"| {low:g} to {high:g} | {len(found)} | {shares} | {times} |")
    return table


def hours(number: float) -> dict[str, Any]:
    """Memory while a drive runs, at its start and each twelfth of it."""

    controller, operator = ConstantCommand(30, 0, 30, 30, 30), HoldingOperator()

    def turn() -> None:
        """Forward and back every two seconds, so that no joint gets to its limit."""
        side = (-1) ** (world.drive.ticks // 40)
        operator.v = (0.1 * side, 0.0, 0.0)
        controller.m = side * np.abs(controller.m)

    operator.act = turn
    gc.disable()  # as `Drive.run` does
    world = World(controller, operator, log=Path(os.devnull))
    world.step = world.drive.machine.plant_dt
    world.drive.begin()
    ticks = round(3600 * number * world.drive.machine.rate)
    used = []
    for k in range(ticks):
        world.drive.tick()
        for rows in (world.syncs, world.recorder.u, world.recorder.q):
            rows.clear()
        if k % max(1, ticks // 12) == max(1, ticks // 12) // 2:
            used.append(memory())
            print(f"{k} ticks: {used[-1]:.1f} MB, {status(world.drive)}", flush=True)
    return {"ticks": ticks, "memory_mb": used, "driving": bool(world.drive.gate.driving)}


def main(options: Options) -> dict[str, Any]:
    result: dict[str, Any] = {}
    if options.hours:
        result = hours(options.hours)
    elif options.recorded:
        result["recorded"] = recorded_table()
    elif options.frozen:
        result["frozen"] = frozen_table()
    else:
        result["faults"] = table(options.repeats, options.only)
    if options.json:
        write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
