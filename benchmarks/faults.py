"""Faults on the bus: time until the valves are closed, in simulated time, as a Markdown table.

    python -m benchmarks.faults [--repeats 20]
    python -m benchmarks.faults --frozen

Machine, bus and `hw.Drive` run in one process on one clock. A fault of an encoder is repeated over
the joints. `--frozen` prints instead how long a frozen encoder takes at each command.
"""

import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import benchmarks  # noqa: F401, before NumPy computes: one thread
from brokk_min.actuator import PLANT
from brokk_min.can.safety_gate import SLEW, expected_motion, gate_start, still_counts
from brokk_min.machine import BROKK_170, PWM_MAX

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers_faults import FAULTS, NOT_FOUND, measure


def groups(faults: dict[str, Any]) -> dict[str, list[Any]]:
    """Faults of one kind at several joints under one name."""
    kinds = defaultdict(list)
    for name, fault in faults.items():
        joint = re.fullmatch(r"q[1-5](: .*)", name) if faults is FAULTS else None
        kinds[f"encoder{joint[1]}" if joint else name].append(fault)
    return kinds


def table(repeats: int) -> None:
    """One row a kind of fault, in words without the joint's name."""
    print("| fault | median, worst [ms] | latched | words, or why it is not found |")
    print("|---|---|---|---|")
    for faults in (FAULTS, NOT_FOUND):
        for name, kinds in groups(faults).items():
            phases = (np.arange(repeats) + 0.5) / repeats * 0.05
            outcomes = [measure(kinds[k % len(kinds)][0], phases[k]) for k in range(repeats)]
            times = [1e3 * seconds for seconds, _ in outcomes]
            latched = int(np.isfinite(times).sum())
            said = {re.sub(r"^(fault: )?(q\d: )?| \(.*", "", words) for _, words in outcomes}
            words = "; ".join(sorted(said - {""})) if faults is FAULTS else kinds[0][1]
            span = f"{np.median(times):.0f}, {max(times):.0f}" if latched else "not found"
            print(f"| {name} | {span} | {latched} of {repeats} | {words} |", flush=True)


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
    sent = gate_start(m).sent[None].repeat(num, axis=0)
    gate, found = gate_start(m)._replace(place=frozen, sent=sent), np.full(num, np.inf)
    for tick in range(first + 60):
        q = plant.q
        place, motion = expected_motion(m, gate, frozen)
        fault = (motion > 3 * still_counts(m) * m.encoder_step).any(axis=-1)
        found = np.where(fault & np.isinf(found), tick, found)
        sent = np.zeros((num, m.n))
        before = np.abs(gate.sent[range(num), joint, -1])
        sent[range(num), joint] = up * np.minimum(before + SLEW, counts / PWM_MAX)
        history = np.concatenate([gate.sent[..., 1:], sent[..., None]], axis=-1)
        gate = gate._replace(sent=history, place=place, motion=motion)
        plant = PLANT.step(m, plant, sent)
        if tick < first:
            frozen = np.rint(plant.q / m.encoder_step).astype(int)
        elif tick == first:
            q = q + moment[:, None] * (plant.q - q)
            frozen = np.rint(q / m.encoder_step).astype(int)
    return (found - first - moment) * m.dt


def frozen_table() -> None:
    """Median and worst times of frozen encoders by command."""
    rng = np.random.default_rng(0)
    print("| command, counts of 127 | joint was moving [s] | joint was at rest [s] |")
    print("|---|---|---|")
    for counts in (80, 60, 40, 30, 20, 16, 14):
        times = [frozen_times(counts, moving, rng) for moving in (True, False)]
        cells = [f"{np.median(t):.2f}, at most {t.max():.2f}" for t in times]
        print(f"| {counts} | {cells[0]} | {cells[1]} |".replace("inf", "never"))


def main(repeats: int = 20, frozen: bool = False) -> None:
    if frozen:
        frozen_table()
    else:
        table(repeats)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
