"""Recorded runs on the timeline of rerun (https://rerun.io), as an .rrd file; extra `rerun`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from brokk_min.identification.files import require, whole_file
from brokk_min.viewer.camera import skeleton
from brokk_min.viewer.replay import Run


def write_rerun(path: Path, runs: Sequence[Run]) -> None:
    """Each run under a name of its own: arm, trail, path, goal, errors, commands, joints.

    Lengths are in m, angles in rad, velocities in m/s and rad/s, commands in [-1, 1].
    ValueError: rerun is not installed.
    """
    rr = require("rerun", "rerun")
    recording = rr.RecordingStream("brokk_min")
    memory = recording.memory_recording()
    for number, run in enumerate(runs):
        name = f"{number}_{run.title}"
        time = rr.TimeColumn("time", duration=run.machine.dt * np.arange(len(run.q)))
        arms = skeleton(run.machine, run.q)
        columns = {
            "arm": rr.LineStrips3D.columns(strips=arms, colors=[run.colour] * len(arms)),
            "goal": rr.Arrows3D.columns(origins=run.p_tool, vectors=run.v_goal),
            "velocity_error": rr.Scalars.columns(scalars=run.error),
        }
        for i, joint in enumerate(run.machine.names):
            for key in ("u", "q", "q_dot"):
                columns[f"{key}/{joint}"] = rr.Scalars.columns(scalars=getattr(run, key)[:, i])
        lines = {"trail": run.p_tool}
        if len(run.path):
            lines["path"] = run.path
            columns["distance"] = rr.Scalars.columns(scalars=run.distance)
        for key, points in lines.items():
            recording.log(f"{name}/{key}", rr.LineStrips3D([points]), static=True)
        for key, values in columns.items():
            recording.send_columns(f"{name}/{key}", [time], values)
    with whole_file(path) as file:
        file.write(memory.drain_as_bytes())
