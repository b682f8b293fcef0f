"""Logs of a machine: one table on disk, recordings at one rate in memory.

Columns `run,time,u_<joint>...,q_<joint>...`, one row per sample; `.csv`, or `.npz` with the same
columns as arrays. `run` is the name of the recording, time is in s, u in [-1, 1] of full command
(held until the next row), q in rad (m of prismatic joints). Other columns are not read: velocities
are estimated, because a bus carries angles alone. Joints may have any names. The rate must not be
below the machine's, and it may jitter.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import brief, expected, whole_file, write_csv
from brokk_min.fit import Log, Recording, join_recordings, moving, velocity_of
from brokk_min.identification.columns import TOPICS, Mapped, load_table
from brokk_min.identification.readings import check_run, left_out, longest_gap, pieces_of
from brokk_min.identification.ros_logs import COMMAND_TIME
from brokk_min.machine import Array, Machine, require

MEAN_OF = 10  # samples of the held command in a tick, of which the mean is taken


def split(log: Log) -> tuple[Log, Log]:
    """Recordings to fit to, and to score on: every tenth of those that drive the same joints.

    ValueError: no two recordings drive the same joints.
    """
    keys = [moving(recording).tobytes() for recording in log.recordings]
    scored = [keys.count(key) > 1 and keys[:i].count(key) % 10 == 0 for i, key in enumerate(keys)]
    wanted = "two or more (column run, or files) that drive the same joints, or --test"
    require(any(scored), "recordings", wanted, len(log.recordings))
    fitted = compress(log.recordings, np.logical_not(scored))
    tested = compress(log.recordings, scored)
    return log._replace(recordings=tuple(fitted)), log._replace(recordings=tuple(tested))


def without(log: Log, names: Collection[str]) -> Log:
    """A log without some recordings; ValueError: it has no others."""
    kept = tuple(one for one in log.recordings if one.name not in names)
    require(len(kept) > 0, "recordings", "some in which commands move the joints", "none")
    return log._replace(recordings=kept)


def in_order(log: Log, joints: Sequence[str]) -> Log:
    """A log whose arrays have the joints in this order. ValueError: it has other joints."""
    require(set(log.joints) == set(joints), "joints", brief(list(joints)), brief(list(log.joints)))
    return only(log, joints)


def only(log: Log, joints: Sequence[str]) -> Log:
    """A log of some of its joints, in this order."""
    order = [log.joints.index(name) for name in joints]
    recordings = (Recording(one.name, *(x[:, order] for x in one[1:])) for one in log.recordings)
    return log._replace(joints=tuple(joints), recordings=tuple(recordings))


def without_locked(log: Log, machine: Machine, kept: Collection[str]) -> Log:
    """A log without those locked joints of the machine that are not `kept`."""
    locked = {machine.names[i] for i in machine.locked} - {*kept}
    return only(log, [name for name in log.joints if name not in locked])


def join_logs(logs: Mapping[Path, Log]) -> Log:
    """One log of several files, in the order of the first; ValueError: other joints, or empty.

    A name that two recordings have gets that of its file in front.
    """
    first, *_ = logs.values()
    recordings: tuple[Recording, ...] = ()
    warnings: tuple[str, ...] = ()
    names = Counter(one.name for log in logs.values() for one in log.recordings)
    for path, log in logs.items():
        with expected(path, "a log"):
            for one in in_order(log, first.joints).recordings:
                name = f"{path}: {one.name}" if names[one.name] > 1 else one.name
                recordings += (one._replace(name=name),)
        warnings += log.warnings
    require(len(recordings) > 0, ", ".join(map(str, logs)), "at least one recording", "none")
    return Log(first.joints, recordings, first.rate, warnings)


def write_log(path: Path, log: Log) -> None:
    """Write recordings as one table, `.csv` or `.npz` by the name; read it with `read_log`."""
    joined = join_recordings(log)
    time = np.concatenate([np.arange(length) / log.rate for length in joined.lengths])
    run = np.repeat([recording.name for recording in log.recordings], joined.lengths)
    columns: dict[str, Any] = {"run": run, "time": time}
    for kind, values in (("u", joined.u), ("q", joined.q)):
        columns |= {f"{kind}_{name}": values[:, i] for i, name in enumerate(log.joints)}
    if Path(path).suffix == ".csv":
        numbers = [np.char.mod("%.7g", column) for column in list(columns.values())[1:]]
        write_csv(path, columns, zip(run, *numbers, strict=True))
        return
    with whole_file(path) as file:
        np.savez_compressed(file, **columns)


def read_log(
    path: Path, machine: Machine, mapped: Mapped | None = None, topics: tuple[str, str] = TOPICS
) -> Log:
    """Check the table of a file, see `load_table`, and resample it at the rate of `machine`.

    The command is held and averaged over each tick, the angle interpolated. A recording starts at
    rest. Gaps and jumps cut it, see `pieces_of`; after a cut the rows are left out whose velocity
    would need samples from before. The joints may be others than those of the machine.
    ValueError: the file, and the row (1 is the header), the column or the run of the first error.
    """
    with expected(path, "a log"):
        table, told = load_table(path, mapped or {}, topics)
        joints = tuple(name[2:] for name in table if name.startswith("u_"))
        u, q = (np.array([table[f"{kind}_{name}"] for name in joints]).T for kind in "uq")
        speeds = dict(zip(machine.names, machine.q_dot_max, strict=True))
        fastest = np.array([speeds.get(name, 0.0) for name in joints])
        wrong, gaps, longest = np.zeros(q.shape, bool), [], longest_gap(machine.rate)
        recordings = []
        unique, first, number = np.unique(table["run"], return_index=True, return_inverse=True)
        for i in np.argsort(first):
            run, rows = str(unique[i]), np.flatnonzero(number == i)
            time, angles = table["time"][rows], q[rows]
            held = (time, u[rows]) if COMMAND_TIME not in table else (table[COMMAND_TIME], u)
            if len(rows) > 1:
                check_run(run, time, angles, machine.rate, joints, fastest)
            gaps += [f"{t:g} s of {run}" for t in time[:-1][np.diff(time) > longest]]
            pieces, wrong[rows] = pieces_of(time, angles, machine.rate, fastest)
            for part, piece in enumerate(pieces):
                skipped = machine.velocity_samples - 1 if part else 0
                resampled = _resample(*held, time[piece], angles[piece], machine)
                sampled = [x[skipped:] for x in resampled]
                if len(sampled[0]):
                    recordings.append(Recording(f"{run}#{part + 1}" if part else run, *sampled))
        if gaps:
            got = f"{len(gaps)} gaps, the first after {gaps[0]}; each begins another recording"
            told = [*told, f"time: expected rows within {longest:g} s of the one before, got {got}"]
        warnings = tuple(f"{path}: {one}" for one in (*told, *left_out(wrong, q, joints)))
        return Log(joints, tuple(recordings), machine.rate, warnings)


def _resample(
    u_time: Array, u: Array, t: Array, q: Array, machine: Machine
) -> tuple[Array, Array, Array]:
    """u held, q interpolated, each by its own times, at the machine's rate; and q_dot estimated."""
    rate = machine.rate
    grid = t[0] + np.arange(int((t[-1] - t[0]) * rate + 1e-6) + 1) / rate
    parts = np.linspace(0, 1 / rate, MEAN_OF, endpoint=False)[:, None]
    held = np.searchsorted(u_time, grid + parts + 1e-6, side="right") - 1
    q = np.stack([np.interp(grid, t, angles) for angles in q.T], axis=-1)
    return u[held].mean(axis=0), q, velocity_of(q, machine.velocity_samples, rate)
