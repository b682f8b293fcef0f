"""Sentences of the paper, each with what was measured of it and a verdict, in the paper's order.

`claims.toml` has the sentences and the limits of the verdicts. Intervals are over starts.
Paper: Sec. 3.2, 4.1, 4.2, 5
"""

import tomllib
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, RAW
from brokk_min.evaluation.metrics import Mean, Run, by_start, column, interval_text, mean_interval
from brokk_min.evaluation.preliminary import Gap, Tests, response_time
from brokk_min.evaluation.rollout import TITLES

TEXTS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
JUDGED = ("rl_critic", "rl_paper")  # the paper's learner, and groups
PIDS = (RAW, BY_HAND, OPTIMISED)  # with the paper's structure, by hand first
ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"
SHORT = {ERROR: "error", DRIFT: "drift"}  # in columns


def claim(name: str, numbers: Mapping[str, Mapping[str, Mean]]) -> dict[str, Any]:
    """A sentence of `claims.toml` with its verdicts, by what is judged, as in `results.json`.

    It holds where all `numbers` of what is judged are beyond its limit, with their intervals, and
    does not where one is not, with its interval. Else it is undecided.
    """
    text = TEXTS[name]
    side, sign = ("above", 1) if "above" in text else ("below", -1)
    verdicts = {}
    for judged, row in numbers.items():
        ends = np.array([(number["low"], number["high"]) for number in row.values()], float)
        beyond = sign * ends > sign * text[side]  # (numbers, 2)
        if np.isnan(ends).any():
            verdicts[judged] = "was not measured"
        elif beyond.all():
            verdicts[judged] = "holds here"
        else:
            refuted = (~beyond).all(axis=1).any()
            verdicts[judged] = "does not hold here" if refuted else "is undecided here"
    measured = f"{text['measure']}, to be {side} {text[side]:g}"
    known = {"figure": text["figure"], "paper": text["paper"], "measured": measured}
    return known | {"numbers": numbers, "verdicts": verdicts}


def net_claims(nets: Tests, gap: Gap) -> list[dict[str, Any]]:
    """Do the nets behave as the paper's machine? Paper: Sec. 3.2 and 4.1, Fig. 2 and 5"""
    _, up, down, _ = (np.abs(q_dot).max() for _, q_dot in nets["range and direction"].values())
    idle, moving = (response_time(*curve) for curve in nets["past movement"].values())
    errors = np.linalg.norm(gap.p_tool, axis=-1).mean(axis=0)  # m, of each run
    table: dict[str, dict[str, float | None]] = {
        "gravity": {"down over up": float(down / up) if up else None},
        "idle": {"idle over moving": idle / moving if idle and moving else None},
        "gap": {"in the figure": float(errors[0]), "median of runs": float(np.median(errors))},
    }
    single = ("mean", "low", "high")  # one test each, so without an interval
    return [
        claim(name, {"nets": {what: dict.fromkeys(single, x) for what, x in row.items()}})
        for name, row in table.items()
    ]


def task_claims(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The claims on each policy of `JUDGED` that has runs, and PID. Paper: Sec. 4.2, 5, Fig. 6"""
    judged = [name for name in JUDGED if name in column(runs, "controller")]

    def drift(names: Sequence[str]) -> dict[str, dict[str, Mean]]:
        """Of each controller, along x."""
        return {TITLES[c]: {"drift": mean_interval(by_start(runs, c, "x", DRIFT))} for c in names}

    def less(sequences: Sequence[str], keys: Sequence[str] = (ERROR,)) -> dict[str, Any]:
        """Figures of each policy less those of each PID: negative where the policy is better."""
        numbers: dict[str, dict[str, Mean]] = {}
        for policy, pid in product(judged, PIDS):
            row = numbers[f"{TITLES[policy]} against {TITLES[pid]}"] = {}
            for s, key in product(sequences, keys):
                difference = by_start(runs, policy, s, key) - by_start(runs, pid, s, key)
                row[f"{SHORT[key]} along {s}"] = mean_interval(difference)
        return numbers

    return [
        claim("still", drift(judged)),
        claim("drift", drift(PIDS)),
        claim("tracking", less("xyz")),
        claim("along_z", less("z", (ERROR, DRIFT))),
        claim("outperforms", less(["all"])),
    ]


def verdict_rows(claims: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """A table of all claims: figure, the paper's words, what is judged, its figures, its verdict.

    Of the comparisons with PIDs it has those with the optimised one, and others that end otherwise.
    """
    rows = []
    for claim in claims:
        for judged, numbers in claim["numbers"].items():
            policy, against, _ = judged.partition(" against ")
            usual = f"{policy} against {TITLES[OPTIMISED]}" if against else judged
            if judged == usual or claim["verdicts"][judged] != claim["verdicts"].get(usual):
                texts = [f"{what} {interval_text(number)}" for what, number in numbers.items()]
                words = [claim["figure"], claim["paper"], judged, "; ".join(texts)]
                rows.append([*words, claim["verdicts"][judged]])
    return rows
