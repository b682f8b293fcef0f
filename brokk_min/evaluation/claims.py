"""Sentences of the paper, each with what was measured of it and a verdict, in the paper's order.

`claims.toml` has the sentences and the limits of the verdicts. Intervals are over starts.
Paper: Sec. 3.2, 4.1, 4.2, 5
"""

import tomllib
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, RAW
from brokk_min.evaluation.metrics import Mean, Run, by_start, column, interval_text, mean_interval
from brokk_min.evaluation.rollout import TITLES

TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
POLICIES = ("rl_paper", "rl_critic")  # the paper's agent
PIDS = (RAW, BY_HAND, OPTIMISED)  # with the paper's structure: by hand, as in the paper, first
VERDICTS = {True: "holds here", False: "does not hold here", None: "was not measured"}
ERROR, DRIFT = "velocity_error_mean", "off_axis_drift_max"

Numbers = Mapping[str, Mean]  # by what they are of


class Claim(NamedTuple):
    """A sentence of the paper, and what was measured of it."""

    name: str  # in `claims.toml`
    numbers: Mapping[str, Mapping[str, Numbers]]  # by what is judged, and by the PID ("": none)

    def holds(self) -> dict[str, dict[str, bool | None]]:
        """Are all numbers of each beyond the limit? With their intervals; None: one has none."""
        above = "above" in TEXTS[self.name]
        limit = TEXTS[self.name]["above" if above else "below"]
        result: dict[str, dict[str, bool | None]] = {}
        for judged, of in self.numbers.items():
            for pid, row in of.items():
                ends = [number["low" if above else "high"] for number in row.values()]
                known = [end for end in ends if end is not None]
                beyond = [end > limit if above else end < limit for end in known]
                result.setdefault(judged, {})[pid] = None if len(known) < len(ends) else all(beyond)
        return result

    def verdict(self) -> str:
        """What `holds` says; where PIDs differ, the verdict depends on how they are tuned."""
        parts = []
        for judged, of in self.holds().items():
            by_verdict: dict[str, list[str]] = {}
            for pid, held in of.items():
                by_verdict.setdefault(VERDICTS[held], []).append(pid)
            if len(by_verdict) == 1:
                parts.append(f"{next(iter(by_verdict))} for {judged}")
                continue
            texts = [f"{text} with {' and '.join(pids)}" for text, pids in by_verdict.items()]
            parts.append(f"depends on the tuning for {judged}: it {', '.join(texts)}")
        return "; ".join(parts)

    def to_json(self) -> dict[str, Any]:
        """The claim as in `results.json`."""
        text = TEXTS[self.name]
        measured = [
            f"{label} of {' and '.join(filter(None, (judged, pid)))} {interval_text(number)}"
            for judged, of in self.numbers.items()
            for pid, row in of.items()
            for label, number in row.items()
        ]
        limit = next(f"{side} {text[side]:g}" for side in ("above", "below") if side in text)
        return {
            **{key: text[key] for key in ("figure", "paper", "unit")},
            "measured": f"{text['measure']}, to be {limit} {text['unit']}: {'; '.join(measured)}",
            "numbers": self.numbers,
            "holds": self.holds(),
            "verdict": self.verdict(),
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
    claims = []
    for name, row in table.items():
        numbers = {label: dict.fromkeys(ends, x) for label, x in row.items()}
        claims.append(Claim(name, {"nets": {"": numbers}}))
    return claims


def task_claims(runs: Sequence[Run]) -> list[Claim]:
    """The claims on task-space control, of the paper's agent and each PID.

    `runs` are those that count. Paper: Sec. 4.2 and 5, Fig. 6
    """
    policies = [name for name in POLICIES if name in column(runs, "controller")]
    drift = {
        name: {"along x": mean_interval(by_start(runs, name, "x", DRIFT))}
        for name in (*policies, *PIDS)
    }

    def less(sequences: Sequence[str], keys: Sequence[str] = (ERROR,)) -> Any:
        """Figures of each policy less those of each PID: negative where the policy is better."""
        numbers: dict[str, dict[str, dict[str, Mean]]] = {}
        for policy, pid, key, s in product(policies, PIDS, keys, sequences):
            difference = by_start(runs, policy, s, key) - by_start(runs, pid, s, key)
            row = numbers.setdefault(TITLES[policy], {}).setdefault(TITLES[pid], {})
            row[f"{key} along {s}"] = mean_interval(difference)
        return numbers

    return [
        Claim("still", {TITLES[name]: {"": drift[name]} for name in policies}),
        Claim("drift", {"the Jacobian-based method": {TITLES[name]: drift[name] for name in PIDS}}),
        Claim("tracking", less("xyz")),
        Claim("along_z", less("z", (ERROR, DRIFT))),
        Claim("outperforms", less(["all"])),
    ]
