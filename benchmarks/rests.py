"""Errors by length of rest: the moves along x, y and z, every rest equally long.

    python -m benchmarks.rests

Shipped policies and baselines, 16 workspace starts, with 5 % noise: |v_goal - v_tool| [m/s].
"""

from __future__ import annotations

import numpy as np

from brokk_min import BROKK_170
from brokk_min.evaluation import baselines, metrics, sequences
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.policy import POLICIES, load_policy, policy_controllers
from brokk_min.machine import Machine

RESTS = (0.5, 1.0, 2.0, 2.5, 4.0, 5.0, 10.0)  # s


def with_rests(
    machine: Machine, commands: sequences.Commands, seconds: float
) -> sequences.Commands:
    """The same moves; every rest lasts `seconds`."""
    rows = sequences.hold_table(machine, commands.goals)
    rows[~rows[:, 1:].any(axis=1), 0] = seconds
    ticks = np.rint(rows[:, 0] * machine.rate).astype(int)
    return commands._replace(goals=np.repeat(rows[:, 1:], ticks, axis=0).astype(np.float32))


def main() -> None:
    """Print a row for each controller."""
    m, folder = BROKK_170, SHIPPED / BROKK_170.name
    policies = {name: load_policy(folder / file, m) for name, file in POLICIES.items()}
    controllers: metrics.Controllers = {
        **policy_controllers(m, policies),
        **baselines.read_gains(folder / "gains.json", m, policies["rl"].net),
    }
    axes = sequences.axis_sequences(m)
    starts = sequences.workspace_starts(m, 32)
    columns = []
    for seconds in RESTS:
        commands = [with_rests(m, one, seconds) for one in axes]
        runs, _ = metrics.evaluate(m, controllers, commands, starts, 0)
        summary = metrics.summary(runs)
        columns.append({name: summary[name]["all"]["velocity_error_mean"] for name in controllers})
    print(f"{'rest [s]':32}", *(f"{seconds:8g}" for seconds in RESTS))
    for name in controllers:
        print(f"{name:32}", *(f"{column[name]:8.4f}" for column in columns))


if __name__ == "__main__":
    main()
