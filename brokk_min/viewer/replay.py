"""Recorded runs side by side, in a window or as a film: drive logs, or runs of `evaluate`.

A file of `evaluate` holds no motion, so its runs are simulated again.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from brokk_min._files import expected, read_json, require_package, whole_file
from brokk_min.actuator import PLANT, Plant
from brokk_min.can.drive_log import read_frames, read_telemetry
from brokk_min.evaluation.baselines import read_gains
from brokk_min.evaluation.metrics import LABELS, evaluate
from brokk_min.evaluation.rollout import TITLES, Controller
from brokk_min.evaluation.sequences import (
    Commands,
    evaluation_starts,
    read_commands,
    read_starts,
    task_sequences,
)
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Array, Machine, require
from brokk_min.viewer.drawing import BLUE, NO_POINTS, ORANGE, WARNING, Scene, draw, image
from brokk_min.viewer.play import distance, show, window

PANEL = (560, 400)  # px, of a run in a film
PID = "jacobian_pid_k0.1"  # whose runs of a file of `evaluate` are shown beside the policy's
Run = list[Scene]  # one for each tick


def film(
    paths: Sequence[Path],
    machine: Machine,
    out: Path | None,
    fps: float,
    sequence: str = "",
    start: int = 0,
) -> None:
    """Show drive logs (candump) and results (.json) in a window, or write them as a film `out`.

    Of results, `sequence` (by default the first) and `start` say which run. A run that is over
    stands still. ValueError: no such run, or a film other than .gif and .mp4.
    """
    if out:
        require(out.suffix in (".gif", ".mp4"), str(out), "a name in .gif or .mp4", out.suffix)
    runs: list[Run] = []
    for path in paths:
        if path.suffix == ".json":
            runs += runs_of_results(machine, path, sequence, start)
        else:
            runs.append(run_of_log(machine, path))
    step = max(1, round(machine.rate / fps))
    ticks = range(0, max(map(len, runs)) + step - 1, step)  # the last one is there, too
    frames = [[run[min(tick, len(run) - 1)] for run in runs] for tick in ticks]
    if out:
        write_film(out, machine, frames, machine.rate / step)
    else:
        show_film(machine, frames, machine.rate / step)


def run_of(
    machine: Machine, title: str, q: Array, u: Array, v_goal: Array, v_tool: Array, path: Array
) -> Run:
    """The pictures of T ticks: q and u are (T, n), v_goal and v_tool (T, 3), `path` (K, 3)."""
    p = tool_position(forward_kinematics(machine, q))
    error = np.linalg.norm(v_goal - v_tool, axis=-1)
    off = 1e3 * distance(path, p) if len(path) else np.zeros(len(p))
    colour = ORANGE if title.startswith("jacobian") else BLUE
    run = []
    for t in range(len(q)):
        notes = [f"velocity error {error[t]:.3f} m/s", f"its mean {error[: t + 1].mean():.3f} m/s"]
        if len(path):
            notes.append(f"at most {off[: t + 1].max():.0f} mm from the line")
        tool = v_goal[t], v_tool[t], p[: t + 1], path, TITLES.get(title, title)
        run.append(Scene(q[t], u[t], *tool, f"{t * machine.dt:.1f} s", colour, notes))
    return run


def run_of_log(machine: Machine, path: Path) -> Run:
    """The ticks of a candump log from the first driven one on, but for those without all angles.

    ValueError: no log, or one in which nothing drives.
    """
    ticks = [t for t in read_telemetry(machine, read_frames(path)) if np.isfinite(t.q).all()]
    driving = [t.driving for t in ticks]
    require(any(driving), str(path), "a log in which the machine is driven", "another one")
    rows = [(t.q, t.q_dot, t.u, t.v_goal) for t in ticks[driving.index(True) :]]
    q, q_dot, u, v_goal = (np.array(column) for column in zip(*rows, strict=True))
    v_tool = tool_velocity(forward_kinematics(machine, q), q_dot)
    return run_of(machine, path.name, q, u, v_goal, v_tool, NO_POINTS)


def runs_of_results(machine: Machine, path: Path, sequence: str, start: int) -> list[Run]:
    """The policy's run and the PID's in a file of `evaluate`, simulated again as it says.

    ValueError: no such run, or one that does not come out as in the file.
    """
    file = read_json(path, "results of `evaluate`")
    with expected(
        path, f"results of `evaluate` with start {start} of sequence {sequence or 'any'}"
    ):
        meta = file["meta"]
        known, plant = controllers_of(machine, meta)
        commands, starts = commands_of(machine, meta)
        command = {c.name: c for c in commands}[sequence or commands[0].name]
        task = machine, known, [command], starts, meta["seed"], plant
        rows, traces = evaluate(*task, noise=meta["noise"])
        errors = {tuple(row[k] for k in LABELS): row["velocity_error_mean"] for row in file["runs"]}
        for row in rows:
            got, wanted = row["velocity_error_mean"], errors[tuple(row[k] for k in LABELS)]
            require(np.isclose(got, wanted, rtol=1e-3), "velocity_error_mean", wanted, got)
        v_goal = command.for_starts(machine, starts)[:, start]
        p_start = tool_position(forward_kinematics(machine, starts[start]))
        line = np.vstack([p_start, p_start + machine.dt * np.cumsum(v_goal, axis=0)])
        runs = []
        for (name, _), trace in traces.items():
            q, u, v_tool = (array[:, start] for array in (trace.q, trace.u, trace.v_tool))
            runs.append(run_of(machine, name, q, u, v_goal, v_tool, line))
        return runs


def controllers_of(machine: Machine, meta: dict[str, Any]) -> tuple[dict[str, Controller], Plant]:
    """Policy and PID of a file of `evaluate`, and the plant that moved the machine in it."""
    require(meta["machine"] == machine.name, "--machine", meta["machine"], machine.name)
    require(meta["plant"] in ("analytic", "net"), "plant", "analytic or net", meta["plant"])
    policy = load_policy(Path(meta["policy"]), machine)
    pids = read_gains(Path(meta["gains"]), machine, policy.net)
    plant = policy.net if meta["plant"] == "net" else PLANT
    return {"rl": PolicyController(machine, policy), PID: pids[PID]}, plant


def commands_of(machine: Machine, meta: dict[str, Any]) -> tuple[list[Commands], Array]:
    """Sequences and start poses [rad] (starts, n) of a file of `evaluate`."""
    commands, starts = task_sequences(machine), meta["starts"]
    if starts.isdecimal():
        poses = evaluation_starts(machine, int(starts), commands, meta["seed"] + 2)
    else:
        poses = read_starts(Path(starts), machine)
    if meta["commands"] != "own":
        commands = read_commands(Path(meta["commands"]), machine)
    return commands, poses


def show_film(machine: Machine, frames: Sequence[Run], fps: float) -> None:
    """The frames in a window, again and again, until it is closed."""
    with window("brokk_min replay") as pygame:
        clock, at = pygame.time.Clock(), 0
        while True:
            for event in pygame.event.get():
                escape = event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
                if escape or event.type == pygame.QUIT:
                    return
            show(pygame, machine, frames[at])
            at = (at + 1) % len(frames)
            clock.tick(fps)


def write_film(out: Path, machine: Machine, frames: Sequence[Run], fps: float) -> None:
    """The frames as a GIF, or as an MP4 by imageio, which brings ffmpeg."""

    def picture(frame: Run) -> NDArray[np.uint8]:
        return np.hstack([image(draw(machine, scene, PANEL)) for scene in frame])

    bar = tqdm(frames, desc="draw", unit="frame", disable=None)
    with whole_file(out) as file:
        if out.suffix == ".mp4":
            imageio = require_package("imageio.v3", "play")
            imageio.imwrite(file, np.array([*map(picture, bar)]), extension=".mp4", fps=fps)
            return
        samples = [picture(frames[at]) for at in (0, len(frames) // 2, -1)]
        samples.append(np.full_like(samples[0][:40], WARNING))  # red may be in none of them
        palette = Image.fromarray(np.vstack(samples)).quantize(64)
        none, duration = Image.Dither.NONE, round(1e3 / fps)
        pictures = (Image.fromarray(picture(frame)) for frame in bar)
        first, *rest = (one.quantize(palette=palette, dither=none) for one in pictures)
        first.save(file, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)
