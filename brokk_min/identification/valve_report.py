"""What `beyond.adaptation` knows of the valves: in words, in a file, and from a log.

A line says how much faster a valve is than in the logs of its nets and by how much of its opening
it opens earlier. Where an estimate stands at its bound, the machine is another one.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from brokk_min._files import expect_same, expected, write_json
from brokk_min.actuator import ActuatorNet, append_sample, initial_history
from brokk_min.beyond.adaptation import OPENING, SPEED, Known, begin, learn, unknown, valves
from brokk_min.fit import Log
from brokk_min.identification.net_file import fingerprint
from brokk_min.machine import Machine, require

KEPT = 0.2  # part of what a file knows that still counts (assumed)
LARGEST = 1e9  # number in such a file; those of an hour of motion are below 1e6


def describe(machine: Machine, known: Known) -> Iterator[str]:
    """A line for each valve of one machine that has moved; the last one says when to fit again."""
    seconds = known.seconds.reshape(-1, 2)
    k, d = (each.reshape(-1, 2) for each in valves(known))
    at_bounds = (k <= SPEED[0]) | (k >= SPEED[1]) | (np.abs(d) >= OPENING)
    for i, side in np.argwhere(seconds > 0):
        name = f"{machine.names[machine.driven[i]]} {('up', 'down')[side]}"
        speed = f"{abs(k[i, side] - 1):.0%} {'faster' if k[i, side] > 1 else 'slower'}"
        zone = f"opens {abs(d[i, side]):.1%} {'earlier' if d[i, side] > 0 else 'later'}"
        after = f"after {seconds[i, side]:.0f} s of motion"
        yield f"{name}: {speed} than in the logs, {zone}, {after}"
    if at_bounds.any():
        end = "log and fit the machine again, with commands like these"
        yield f"at least one valve is beyond what can be learned here: {end}"


def save_known(path: Path, machine: Machine, net: ActuatorNet, known: Known) -> None:
    """Write what is known of one machine's valves, with the machine's and the nets' names."""
    about = {"machine": machine.name, "nets": fingerprint(net)}
    write_json(path, about | {name: of[0].tolist() for name, of in known._asdict().items()})


def load_known(path: Path, machine: Machine, net: ActuatorNet) -> Known:
    """What a file knows; ValueError: of another machine or other nets, or no such numbers.

    It counts as a few seconds of motion do, because the oil is another one on another day.
    """
    with expected(path, "estimates of valves that `drive --adapt` wrote"):
        content = json.loads(path.read_text("utf-8"))
        wanted = {"machine": machine.name, "nets": fingerprint(net)}
        expect_same(path, content, wanted)
        known = Known(*(np.array([content[name]], float) for name in Known._fields))
        shapes = [[*of.shape] for of in unknown((1, len(machine.driven)))]
        require([[*of.shape] for of in known] == shapes, "A, b, seconds", str(shapes), "others")
        sane = all((np.abs(of) < LARGEST).all() for of in known) and (known.seconds >= 0).all()
        sums = sane and np.allclose(known.A, known.A.mT) and np.linalg.eigvalsh(known.A).min() > -1
        require(bool(sums), "A, b, seconds", "sums of squares of some seconds", "others")
    return Known(*(KEPT * of for of in known))


def from_log(machine: Machine, net: ActuatorNet, log: Log) -> Known:
    """What recordings of a machine tell of its driven joints' valves; nets are of these joints."""
    rows = [log.joints.index(machine.names[i]) for i in machine.driven]
    length = np.array([len(one.u) for one in log.recordings])
    u, q = np.zeros((2, length.max(), len(length), len(rows)))
    for i, one in enumerate(log.recordings):  # side by side; a short one stays at its end
        u[: length[i], i] = one.u[:, rows]
        q[:, i] = one.q[np.minimum(np.arange(len(q)), length[i] - 1)][:, rows]
    history = initial_history(q[0].astype(np.float32), machine.history)
    runs, known = begin(history), unknown(history.shape[:-2])
    for t in range(1, len(q)):
        history = append_sample(history, u[t - 1], q[t], machine.velocity_samples, machine.dt)
        later, runs = learn(machine, net, known, runs, history)
        for old, new in zip(known, later):
            old[t < length] = new[t < length]
    told = Known(*(of.sum(axis=0, keepdims=True) for of in known))
    told.A[..., 1, :, :] = told.b[..., 1, :] = 0.0  # the last seconds of each recording
    return told
