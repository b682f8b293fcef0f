"""The log of a drive as a film."""

from itertools import dropwhile
from pathlib import Path

import numpy as np
from tqdm import tqdm

from brokk_min._files import whole_file
from brokk_min.can.drive_log import read_frames, read_telemetry
from brokk_min.fit import velocity_of
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.machine import Machine, require
from brokk_min.viewer.drawing import Scene, draw

SIZE = (640, 400)  # px
STEP = 2  # ticks a picture


def film(path: Path, machine: Machine, out: Path) -> None:
    """Write the drive of a candump log as a GIF. ValueError: no log, or nothing drives in it."""
    run = scenes(machine, path)
    shown = [*run[:-1:STEP], run[-1]]
    bar = tqdm(shown, desc="draw", unit="frame", disable=None)
    first, *rest = (draw(machine, scene, SIZE) for scene in bar)
    duration = round(1e3 * STEP * machine.dt)
    with whole_file(out) as file:
        first.save(file, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)


def scenes(machine: Machine, path: Path) -> list[Scene]:
    """The ticks of a log from the first driven one on."""
    ticks = list(dropwhile(lambda t: not t.driving, read_telemetry(machine, read_frames(path))))
    require(
        len(ticks) > 0, str(path), "a log in which the machine is driven", "another (--machine?)"
    )
    q = np.array([t.q for t in ticks])
    fk = forward_kinematics(machine, q)
    q_dot = velocity_of(q, machine.velocity_samples, machine.rate)
    p, v = tool_position(fk), tool_velocity(fk, q_dot)
    return [
        Scene(t.q, t.u, t.v_goal, v[k], p[: k + 1], path.name, f"{k * machine.dt:.1f} s")
        for k, t in enumerate(ticks)
    ]
