"""The report: one HTML page with the paper's figures. The page itself is in `report.html.j2`."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure
from tqdm import tqdm

from brokk_min._files import whole_file
from brokk_min.evaluation import figures
from brokk_min.evaluation.metrics import Traces, interval_text
from brokk_min.evaluation.preliminary import Motion, SimulatorTests
from brokk_min.evaluation.rollout import TITLES, valves_at_rest
from brokk_min.evaluation.sequences import axis_sequences
from brokk_min.machine import Machine

Results = Mapping[str, Any]  # of `results.json`
COLUMNS = {  # of the first table: figure of merit and its head
    "velocity_error_mean": "velocity error [m/s]",
    "off_axis_drift_max": "largest drift [m]",
    "jerk_rms": "jerk [m/s³]",
    "valve_travel": "valve travel [full strokes]",
}


def write_report(out: Path, results: Results, drawn: Mapping[str, Figure], minutes: float) -> None:
    """Write `report.html` to the folder `out`; `minutes` is what the chain took so far."""
    images = {}
    for name, figure in tqdm(drawn.items(), desc="draw", disable=None):
        images[name] = base64.b64encode(figures.png(figure)).decode()
    with whole_file(out / "report.html", "w") as file:
        file.write(render(results, images, minutes))


def draw(
    machine: Machine,
    results: Results,
    tests: Mapping[str, SimulatorTests],
    gap: Motion,
    traces: Traces,
) -> dict[str, Figure]:
    """All figures of the page by name."""
    starts, kinds = np.array(results["starts"]), results["start_kinds"]
    run = kinds.index("workspace")  # the first from which all sequences can be followed
    drawn = {
        "tests": figures.plot_tests(machine, tests),
        "gap": figures.plot_gap(machine, gap),
        "starts": figures.plot_starts(machine, starts, kinds),
        "joints": figures.plot_joint_velocities(machine, traces, "x", run),
    }
    for axis in axis_sequences(machine):
        drawn[axis.name] = figures.plot_sequence(machine, traces, axis, starts[run], run)
    return drawn


def render(results: Results, images: Mapping[str, str], minutes: float) -> str:
    """The page, with PNG `images` in base64 by name."""
    folder = Path(__file__).parent
    page = Environment(loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined)
    page.filters["interval"] = interval_text
    values = {"results": results, "images": images, "minutes": minutes, "columns": COLUMNS}
    template = page.get_template("report.html.j2")
    return template.render(titles=TITLES, rest=valves_at_rest, **values)
