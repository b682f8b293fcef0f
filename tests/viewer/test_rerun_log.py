"""Runs on rerun's timeline, read back with rerun's own reader."""

import numpy as np
import pytest
from helpers_viewer import run_of

from brokk_min.machine import BROKK_170
from brokk_min.viewer import rerun_log
from brokk_min.viewer.camera import skeleton

chunk = pytest.importorskip("rerun.chunk", reason="extra `rerun`")


def read(path):
    """Columns by name, as nested lists, and times [s] of each entity."""
    columns, times = {}, {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        for field, column in zip(batch.schema, batch.columns, strict=True):
            if field.name == "time":
                times[part.entity_path] = column.cast("int64").to_numpy() / 1e9
            else:
                columns[part.entity_path, field.name.split(":")[-1]] = column.to_pylist()
    return columns, times


def test_write_rerun__has_poses_commands_errors_and_goals_at_their_times(tmp_path):
    line = np.array([[3.0, -1, 1], [3, 1, 1]])
    run = run_of(7, line)
    other = run_of(4)
    rerun_log.write_rerun(tmp_path / "runs.rrd", [run, other])
    columns, times = read(tmp_path / "runs.rrd")
    arms = np.array(columns["/0_rl/arm", "strips"])[:, 0]
    np.testing.assert_allclose(arms, skeleton(BROKK_170, run.q), atol=1e-6)
    np.testing.assert_allclose(np.array(columns["/0_rl/goal", "vectors"])[:, 0], run.v_goal, 1e-6)
    for i, name in enumerate(BROKK_170.names):
        for key in ("u", "q", "q_dot"):
            values = np.ravel(columns[f"/0_rl/{key}/{name}", "scalars"])
            np.testing.assert_allclose(values, getattr(run, key)[:, i])
    np.testing.assert_allclose(np.ravel(columns["/0_rl/velocity_error", "scalars"]), run.error)
    np.testing.assert_allclose(np.ravel(columns["/0_rl/distance", "scalars"]), run.distance)
    np.testing.assert_allclose(columns["/0_rl/path", "strips"][0][0], line)
    np.testing.assert_allclose(times["/0_rl/u/q3"], 0.05 * np.arange(7))
    np.testing.assert_allclose(times["/1_rl/arm"], 0.05 * np.arange(4))
    assert ("/1_rl/path", "strips") not in columns


def test_write_rerun__keeps_a_file_if_it_cannot_write(tmp_path):
    with pytest.raises(ValueError, match="expected an existing directory"):
        rerun_log.write_rerun(tmp_path / "none" / "runs.rrd", [run_of(3)])
