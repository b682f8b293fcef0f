"""Measure the numbers of docs/annotated.md: `python docs/annotated_numbers.py`, two minutes.

They are of the shipped policies, nets and gains on the analytic plant. Numbers go to
annotated.json, figures to figures/. `--if-changed`: only if the shipped files are others than
those of annotated.json.
"""

from __future__ import annotations

import hashlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from brokk_min import BROKK_170
from brokk_min.evaluation import baselines, claims, figures, metrics, preliminary, robustness
from brokk_min.evaluation.rollout import Trace
from brokk_min.evaluation.sequences import evaluation_starts, task_sequences
from brokk_min.identification import excitation, validation
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.logs import Recording
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.policy import POLICIES, load_policy, policy_controllers

DOCS = Path(__file__).parent
NUMBERS = DOCS / "annotated.json"
FILES = SHIPPED / BROKK_170.name
PIDS = (*claims.PAPER_BASELINES, *claims.WITH_FEEDFORWARD)
SHOWN = ("rl", "rl_paper", "jacobian_pid_k0.1")  # in the figure of motion along x
KEYS = ("velocity_error_mean", "off_axis_drift_max", "jerk_rms", "valve_travel")
STARTS, SEED = 64, 0  # as `brokk-min evaluate --num-starts 64`


def fingerprints() -> dict[str, str]:
    """The first 16 digits of SHA-256 of the shipped files that are read here, by name."""
    names = sorted([*POLICIES.values(), "gains.json", "starts.csv"])
    return {name: hashlib.sha256((FILES / name).read_bytes()).hexdigest()[:16] for name in names}


def controllers() -> tuple[dict[str, Any], dict[str, Any]]:
    """The controllers of the paper's experiment, and our nets and the paper's."""
    policies = {name: load_policy(FILES / file, BROKK_170) for name, file in POLICIES.items()}
    nets = {"ours": policies["rl"].net, "paper": policies["rl_paper"].net}
    pids = baselines.read_gains(FILES / "gains.json", BROKK_170, nets["ours"])
    rl: dict[str, Any] = {**policy_controllers(BROKK_170, policies)}
    return rl | {name: pids[name] for name in PIDS}, nets


def sample(every: dict[str, Any]) -> dict[str, float]:
    """Errors [m/s] of two controllers along x from two starts: a test measures them anew."""
    commands = task_sequences(BROKK_170)
    two = {name: every[name] for name in ("rl", "jacobian_pid_k0.1")}
    starts = evaluation_starts(BROKK_170, 2, commands, SEED + 2)
    rows, _ = metrics.evaluate(BROKK_170, two, commands[:1], starts, SEED)
    means = metrics.summary(rows)
    return {name: means[name]["x"]["velocity_error_mean"] for name in two}


def net_errors(nets: dict[str, Any]) -> dict[str, Any]:
    """Errors on recordings that no net was fitted to, worst driven joint, and of the tool."""
    log = excitation.task_log(BROKK_170, 20, 40.0, np.random.default_rng(SEED + 1))
    driven = BROKK_170.driven
    recordings = [Recording(r.name, *(array[:, driven] for array in r[1:])) for r in log.recordings]
    log = log._replace(
        joints=tuple(BROKK_170.names[j] for j in driven), recordings=tuple(recordings)
    )
    result = {}
    for name, net in nets.items():
        scores = validation.score(net, log).values()
        both = preliminary.simulators(BROKK_170, net)
        gap = preliminary.gap_numbers(BROKK_170, preliminary.sim_to_real(BROKK_170, both, SEED))
        result[name] = {
            "one_step_rmse": max(s["one_step_rmse"] for s in scores),
            "persistence_rmse": max(s["persistence_rmse"] for s in scores),
            "free_run_10": max(s["free_run"]["10"]["velocity_rmse"] for s in scores),
            "gap": gap["tool_position_error_mean_of_runs"],
        }
    return result


def verdicts(every: dict[str, Any], rows: metrics.Rows, traces: metrics.Traces) -> dict[str, Any]:
    """The claims on task-space control, of the paper's learner, of ours and of a stronger PID."""
    m, commands = BROKK_170, task_sequences(BROKK_170)
    starts = evaluation_starts(m, STARTS, commands, SEED + 2)
    kinds = np.array([row["kind"] for row in rows[:STARTS]])
    scored = [row for row in rows if row["kind"] == "workspace"]
    reachable = kinds == "workspace"
    pids = {name: every[name] for name in PIDS}
    near = claims.singular_controllers({n: every[n] for n in ("rl", "rl_paper")}, pids)
    _, singular, _ = robustness.near_singularities(m, near, starts[kinds == "extended"], 26.0, SEED)
    along_x = {c: Trace(*(array[:, reachable] for array in traces[c, "x"])) for c in pids}
    goals = commands[0].for_starts(m, starts[reachable])
    result: dict[str, Any] = {}
    for policy in ("rl_paper", "rl"):
        found = claims.task_claims(m, policy, pids, scored, along_x, goals, singular[policy])
        for claim in found:
            numbers = result.setdefault(claim.name, {})
            numbers[policy] = {"holds": claim.holds, "numbers": dict(claim.numbers)}
            if claim.stronger:
                numbers[policy]["stronger"] = claim.stronger.holds
    return result


def rounded(value: Any) -> Any:
    """Numbers with six digits, also within dictionaries and lists."""
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def save(name: str, figure: Any) -> None:
    """A PNG of 32 colours in figures/."""
    with io.BytesIO() as buffer:
        figure.savefig(buffer, dpi=80)
        picture = Image.open(buffer).convert("RGB").quantize(32)
    picture.save(DOCS / "figures" / f"{name}.png", optimize=True)


def measure() -> dict[str, Any]:
    """All numbers of the page; Fig. 2, 5 and 6 go to figures/."""
    m, commands = BROKK_170, task_sequences(BROKK_170)
    every, nets = controllers()
    measured = preliminary.run(m, nets["ours"], SEED)
    found = preliminary.numbers(m, measured)
    starts = evaluation_starts(m, STARTS, commands, SEED + 2)
    rows, traces = metrics.evaluate(m, every, commands, starts, SEED)
    means = metrics.summary([row for row in rows if row["kind"] == "workspace"])
    axes = {
        name: {key: float(np.mean([of[axis][key] for axis in "xyz"])) for key in KEYS}
        for name, of in means.items()
    }
    save("fig2", figures.plot_tests(m, measured.tests))
    save("fig5", figures.plot_gap(m, measured.gap))
    shown = {(name, "x"): traces[name, "x"] for name in SHOWN}
    save("fig6", figures.plot_sequence(m, shown, commands[0], starts[0], 0))
    return {
        "files": fingerprints(),
        "sample": sample(every),
        "tool": tool_position(forward_kinematics(m, m.q_start)).tolist(),
        "preliminary": found,
        "net_claims": {claim.name: claim.holds for claim in claims.net_claims(found)},
        "nets": net_errors(nets),
        "axes": axes,
        "nine": {name: of["all"]["velocity_error_mean"] for name, of in means.items()},
        "claims": verdicts(every, rows, traces),
    }


if __name__ == "__main__":
    same = NUMBERS.exists() and json.loads(NUMBERS.read_text())["files"] == fingerprints()
    if same and "--if-changed" in sys.argv:
        sys.exit()
    NUMBERS.write_text(json.dumps(rounded(measure()), indent=1) + "\n")
