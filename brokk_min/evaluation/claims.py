"""Sentences of the paper, each with what was measured of it and a verdict, in the paper's order.

`claims.toml` has the sentences and the limits of the verdicts. Intervals are over starts.
Paper: Sec. 3.2, 4.1, 4.2, 5
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, RAW
from brokk_min.evaluation.metrics import Mean, Run, by_start, column, mean_interval
from brokk_min.evaluation.preliminary import Motion, SimulatorTests, response_time
from brokk_min.evaluation.rollout import TITLES

TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
POLICIES = ("rl_paper", "rl_critic")  # the paper's agent
PIDS = (RAW, BY_HAND, OPTIMISED)  # with the paper's structure, by hand first
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"
SHORT = {ERROR: "error", DRIFT: "drift"}  # in columns


def claim(name: str, numbers: Mapping[str, Mapping[str, Mean]]) -> dict[str, Any]:
    """A sentence of `claims.toml` with its verdict, as in `results.json`.

    `numbers` are by what is judged and by what they are of. The sentence holds where all numbers,
    with their intervals, are beyond the limit. One without an interval was not measured.
    """
    text = TEXTS[name]
    side, end = ("above", "low") if "above" in text else ("below", "high")
    limit = text[side]
    verdicts = dict[str, list[str]]()
    for judged, row in numbers.items():
        ends = [number[end] for number in row.values()]
        known = [x for x in ends if x is not None]
        beyond = all(x > limit if side == "above" else x < limit for x in known)
        verdict = VERDICTS[beyond if len(known) == len(ends) else None]
        verdicts.setdefault(verdict, []).append(judged)
    return {
        "figure": text["figure"],
        "paper": text["paper"],
        "measured": f"{text['measure']}, to be {side} {limit:g}",
        "numbers": numbers,
        "verdict": "; ".join(f"{verdict} for {listed(of)}" for verdict, of in verdicts.items()),
    }


def listed(judged: Sequence[str]) -> str:
    """Names as text; a controller that is judged against several others is named once."""
    against: dict[str, list[str]] = {}
    for name in judged:
        first, *other = name.split(" against ")
        against.setdefault(first, []).extend(other)
    names = []
    for first, others in against.items():
        names.append(f"{first} (against {' / '.join(others)})" if others else first)
    return " and ".join(names)


def net_claims(nets: SimulatorTests, gap: Motion) -> list[dict[str, Any]]:
    """Do the nets behave as the paper's machine?

    The plant was made after the paper's figures, so verdicts on it could not fail. These are single
    tests, so they have no interval. Paper: Sec. 3.2 and 4.1, Fig. 2 and 5
    """
    _, up, down, _ = (np.abs(q_dot).max() for _, q_dot in nets.sweeps.values())
    idle, moving = (response_time(*curve) for curve in nets.past_movement.values())
    errors = np.linalg.norm(gap.p_tool, axis=-1).mean(axis=0)  # m, of each run
    table: dict[str, dict[str, float | None]] = {
        "gravity": {"down over up": float(down / up)},
        "idle": {"idle over moving": idle / moving if idle and moving else None},
        "gap": {"in the figure": float(errors[0]), "median of runs": float(np.median(errors))},
    }
    ends = ("mean", "low", "high")
    return [
        claim(name, {"nets": {what: dict.fromkeys(ends, x) for what, x in row.items()}})
        for name, row in table.items()
    ]


def task_claims(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The claims on task-space control, of the paper's agent and each PID.

    `runs` are those that count. Paper: Sec. 4.2 and 5, Fig. 6
    """
    policies = [name for name in POLICIES if name in column(runs, "controller")]

    def drift(names: Sequence[str]) -> dict[str, dict[str, Mean]]:
        """Of each controller, along x."""
        drifts = {name: by_start(runs, name, "x", DRIFT) for name in names}
        return {TITLES[name]: {"drift": mean_interval(of)} for name, of in drifts.items()}

    def less(sequences: Sequence[str], keys: Sequence[str] = (ERROR,)) -> dict[str, Any]:
        """Figures of each policy less those of each PID: negative where the policy is better."""
        numbers: dict[str, dict[str, Mean]] = {}
        for policy in policies:
            for pid in PIDS:
                row = numbers.setdefault(f"{TITLES[policy]} against {TITLES[pid]}", {})
                for s in sequences:
                    for key in keys:
                        of_pid = by_start(runs, pid, s, key)
                        difference = by_start(runs, policy, s, key) - of_pid
                        row[f"{SHORT[key]} along {s}"] = mean_interval(difference)
        return numbers

    return [
        claim("still", drift(policies)),
        claim("drift", drift(PIDS)),
        claim("tracking", less("xyz")),
        claim("along_z", less("z", (ERROR, DRIFT))),
        claim("outperforms", less(["all"])),
    ]
