"""The report: one HTML page with the paper's figures. The page itself is in `report.html.j2`."""

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import StrictUndefined, Template
from matplotlib import style
from matplotlib.figure import Figure
from tqdm import tqdm

from brokk_min._files import SHIPPED, read_json, whole_file
from brokk_min.evaluation import figures
from brokk_min.evaluation.baselines import BY_HAND, OPTIMISED, STRONGEST
from brokk_min.evaluation.metrics import COLUMNS, Traces, interval_text
from brokk_min.evaluation.preliminary import Motion, SimulatorTests
from brokk_min.evaluation.rollout import TITLES, valves_at_rest
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.machine import BROKK_170, Machine

Results = Mapping[str, Any]  # of `results.json`
Tests = Mapping[str, SimulatorTests]
ROWS = (BY_HAND, OPTIMISED, "rl_paper", "rl", STRONGEST)
PAIRS = (("rl_paper", BY_HAND), ("rl_paper", OPTIMISED), ("rl", STRONGEST))  # within a class
BOUND = 0.0097  # m/s, of `benchmarks/perfect_model.py`, which knows the plant of the Brokk 170


@style.context("default")  # not the settings of the owner for his own pictures
def write_report(
    out: Path, machine: Machine, results: Results, measured: tuple[Tests, Motion, Traces]
) -> None:
    """Write `report.html` to the folder `out`; `measured` is what the paper's figures show."""
    tests, gap, traces = measured
    starts, table = np.array(results["starts"]), first_table(results)
    drawn = {
        "errors": figures.plot_errors({c: table[c]["velocity_error_mean"] for c in ROWS}),
        "tests": figures.plot_tests(machine, tests),
        "gap": figures.plot_gap(machine, gap),
        "starts": figures.plot_starts(machine, starts),
        "joints": figures.plot_joint_velocities(machine, traces, "x"),
    }
    for axis in axis_sequences(machine):
        drawn[axis.name] = figures.plot_sequence(machine, traces, axis, starts)
    images = {name: png(figure) for name, figure in tqdm(drawn.items(), "draw", disable=None)}
    with whole_file(out / "report.html", "w") as file:
        file.write(render(results, images))


def png(figure: Figure) -> str:
    """A figure as PNG in base64, the same text for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode()


def first_table(results: Results) -> Results:
    """Means along x, y and z by controller: of these results, or of shipped ones for a trial."""
    shipped = SHIPPED / results["meta"]["machine"] / "table.json"
    trial = results["meta"]["effort"]["hours"] < 1 and shipped.exists()
    return (read_json(shipped, "JSON") if trial else results)["table"]  # type: ignore[no-any-return]


def render(results: Results, images: Mapping[str, str]) -> str:
    """The page, with PNG `images` in base64 by name."""
    text = Path(__file__).with_suffix(".html.j2").read_text("utf-8")
    bound = BOUND if results["meta"]["machine"] == BROKK_170.name else None
    page: Template = Template(text, autoescape=True, undefined=StrictUndefined)
    page.globals.update(rows=ROWS, pairs=PAIRS, columns=COLUMNS, titles=TITLES)
    page.globals.update(rest=valves_at_rest, interval=interval_text)
    return page.render(results=results, images=images, bound=bound, table=first_table(results))
