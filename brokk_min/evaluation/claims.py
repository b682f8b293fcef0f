"""Sentences of the paper, each with what was measured of it and a verdict, in the paper's order.

`claims.toml` has the sentences and the limits of the verdicts. Intervals are over starts.
Paper: Sec. 3.2, 4.1, 4.2, 5
"""

import tomllib
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from brokk_min.evaluation.baselines import PAPER_BASELINES
from brokk_min.evaluation.metrics import Mean, Run, by_start, column, interval_text, mean_interval
from brokk_min.evaluation.rollout import TITLES

TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
STRONG, WEAK = PAPER_BASELINES  # damping
POLICIES = ("rl_paper", "rl")
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"


class Claim(NamedTuple):
    """A sentence of the paper, and what was measured of it."""

    name: str  # in `claims.toml`
    numbers: Mapping[str, Mapping[str, Mean]]  # by what is judged (a policy, "nets"), and by label

    def holds(self) -> dict[str, bool | None]:
        """Are all numbers of each, with their intervals, beyond the limit? None: one is missing."""
        text = TEXTS[self.name]
        above = "above" in text
        result: dict[str, bool | None] = {}
        for judged, row in self.numbers.items():
            ends = [number["low" if above else "high"] for number in row.values()]
            known = [end for end in ends if end is not None]
            beyond = [end > text["above"] if above else end < text["below"] for end in known]
            result[judged] = all(beyond) if len(known) == len(ends) else None
        return result

    def to_json(self) -> dict[str, Any]:
        """The claim as in `results.json`."""
        text, holds = TEXTS[self.name], self.holds()
        labelled = [pair for row in self.numbers.values() for pair in row.items()]
        measured = "; ".join(f"{label} {interval_text(number)}" for label, number in labelled)
        limit = next(f"{side} {text[side]:g}" for side in ("above", "below") if side in text)
        verdicts = [f"{VERDICTS[h]} for {TITLES.get(who, who)}" for who, h in holds.items()]
        return {
            "figure": text["figure"],
            "paper": text["paper"],
            "measured": f"{text['measure']}, to be {limit}: {measured} [{text['unit']}]",
            "numbers": self.numbers,
            "unit": text["unit"],
            "holds": holds,
            "verdict": " and ".join(verdicts),
        }


def net_claims(numbers: Mapping[str, Any]) -> list[Claim]:
    """Do the nets behave as the paper's machine? `numbers` is of `preliminary.numbers`.

    The plant was made after the paper's figures, so verdicts on it could not fail. These are single
    tests, so they have no interval. Paper: Sec. 3.2 and 4.1, Fig. 2 and 5
    """
    up, down = list(numbers["sweep"].values())[1:3]  # at the limit
    times = numbers["response_time"]["nets"]
    idle, moving = times["idle"], times["moving"]
    gap = numbers["sim_to_real"]
    of_runs = gap["tool_position_error_mean_of_runs"]["median"]
    table: dict[str, dict[str, float | None]] = {
        "gravity": {"down over up": down["nets_peak"] / up["nets_peak"]},
        "idle": {"idle over moving": idle / moving if idle and moving else None},
        "gap": {"in the figure": gap["tool"]["position_error_mean"], "median of runs": of_runs},
    }
    ends = ("mean", "low", "high")
    return [
        Claim(name, {"nets": {label: dict.fromkeys(ends, x) for label, x in row.items()}})
        for name, row in table.items()
    ]


def task_claims(runs: Sequence[Run]) -> list[Claim]:
    """The claims on task-space control, of each policy in `runs`, in the paper's order.

    `runs` are those that count. Paper: Sec. 4.2 and 5, Fig. 6
    """
    policies = [name for name in POLICIES if name in column(runs, "controller")]

    def less(policy: str, sequences: Sequence[str], keys: Sequence[str] = (ERROR,)) -> Any:
        return {
            f"{key} of {policy} along {s} less {c}": mean_interval(
                by_start(runs, policy, s, key) - by_start(runs, c, s, key)
            )
            for key, s, c in product(keys, sequences, PAPER_BASELINES)
        }

    def drift(name: str) -> dict[str, Mean]:
        return {name: mean_interval(by_start(runs, name, "x", DRIFT))}

    return [
        Claim("still", {policy: drift(policy) for policy in policies}),
        Claim("drift", {"the paper's PIDs": drift(STRONG) | drift(WEAK)}),
        Claim("tracking", {policy: less(policy, "xyz") for policy in policies}),
        Claim("along_z", {policy: less(policy, "z", (ERROR, DRIFT)) for policy in policies}),
        Claim("outperforms", {policy: less(policy, ["all"]) for policy in policies}),
    ]
