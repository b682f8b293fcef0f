"""Recorded runs, of a log or of results driven again, side by side: films of them."""

import json
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
from PIL import Image
from tqdm import tqdm

from brokk_min.actuator import ActuatorNet
from brokk_min.can.canopen import read_frames
from brokk_min.can.drive_log import Telemetry, TelemetryReader
from brokk_min.evaluation import baselines, metrics
from brokk_min.evaluation.rollout import Controller, Trace
from brokk_min.evaluation.sequences import Commands, goals_and_starts, task_sequences
from brokk_min.identification.files import expected, whole_file
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Array, Machine
from brokk_min.viewer import drawing as view
from brokk_min.viewer.drawing import skeleton
from brokk_min.viewer.window import open_window, picture


class Run(NamedTuple):
    """A recorded run: what was known tick by tick, and the tool's."""

    title: str
    colour: view.Colour
    known: Sequence[Telemetry]
    p_tool: Array  # m (T, 3)
    error: Array  # |v_goal - v_tool| [m/s] (T,)
    path: Array  # where the tool was to go [m] (K, 3), or none
    hold: Array  # corners of the arm on the way [m] (K, 3)


def recorded(
    machine: Machine, title: str, colour: view.Colour, known: Sequence[Telemetry], path: Array
) -> Run:
    """A run from its ticks; the velocity error is that of the velocities that it holds."""
    q, q_dot, v_goal = (
        np.array([getattr(k, name) for k in known]) for name in ("q", "q_dot", "v_goal")
    )
    frames = forward_kinematics(machine, q)
    p_tool, v_tool = tool_position(frames), tool_velocity(frames, q_dot)
    corners = skeleton(machine, q[::10]).reshape(-1, 3)
    error = np.linalg.norm(v_goal - v_tool, axis=-1)
    return Run(title, colour, known, p_tool, error, path, np.vstack([corners, path]))


def run_of_log(machine: Machine, path: Path, colour: view.Colour) -> Run:
    """The ticks of a candump log from the first that drives; ticks without all positions are left out.

    ValueError: no log, or one in which nothing drives.
    """
    ticks = TelemetryReader(machine)
    known = [
        k for frame in read_frames(path) if (k := ticks.update(frame)) and np.isfinite(k.q).all()
    ]
    first = next((i for i, k in enumerate(known) if k.driving), None)
    if first is None:
        raise ValueError(f"{path}: expected a log in which the valves are driven, got none")
    return recorded(machine, path.name, colour, known[first:], np.zeros((0, 3)))


def run_of_trace(
    machine: Machine, title: str, trace: Trace, run: int, goals: Array, start: Array
) -> Run:
    """One run of a rollout: true motion, and where the goals (T, 3) lead from the start [m] (3,)."""
    rows = zip(trace.q[:, run], trace.q_dot[:, run], trace.u[:, run], goals, strict=True)
    known = [Telemetry(i, *row, driving=True) for i, row in enumerate(rows)]
    path = start + np.vstack([np.zeros(3), np.cumsum(goals, axis=0)]) * machine.dt
    colour = next((c for name, c in view.COLOURS.items() if title.startswith(name)), view.STEEL)
    return recorded(machine, title, colour, known, path)


class Results(NamedTuple):
    """What a results file says of itself, and what it takes to drive its runs again."""

    path: Path
    runs: list[dict[str, Any]]  # its rows
    sequences: dict[str, Commands]
    starts: Array  # rad (starts, n)
    controllers: dict[str, Controller]
    net: ActuatorNet | None  # what moved; None: the plant
    seed: int


def read_results(machine: Machine, path: Path, controllers: Sequence[str]) -> Results:
    """A JSON file of `evaluate` or `reproduce`; its gains are read if other `controllers` than RL are wanted.

    ValueError: no results, or of another machine; the files that it names are not as they should be.
    """
    with expected(path, "results of `evaluate`"):
        file = json.loads(path.read_text())
        beside = {
            "policy": str(path.with_name("policy.npz")),
            "gains": str(path.with_name("gains.json")),
        }
        told = beside | {"plant": "analytic", "commands": "", "starts": ""} | file["meta"]
        rows = file.get("task_space", file)["runs"]
        names, seed = ", ".join(s.name for s in task_sequences(machine)), int(told["seed"])
        num = int(told["starts"]) if told["starts"].isdigit() else 0
        given = np.array(file["starts"], float) if "starts" in file else None
    if told.get("machine") != machine.name:
        raise ValueError(f"{path}: expected --machine {told.get('machine')}, got {machine.name}")
    commands = None if told["commands"] in ("", names) else Path(told["commands"])
    poses = None if num or not told["starts"] else Path(told["starts"])
    sequences, starts = goals_and_starts(machine, commands, poses, num, seed)
    policy = load_policy(Path(told["policy"]), machine)
    known: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
    if set(controllers) - {"rl"}:
        known |= baselines.read_gains(Path(told["gains"]), machine, policy.net)
    net, named = policy.net if told["plant"] == "net" else None, {s.name: s for s in sequences}
    return Results(path, rows, named, starts if given is None else given, known, net, seed)


def driven_again(
    machine: Machine, results: Results, controllers: Sequence[str], sequence: str, start: int
) -> list[Run]:
    """One run of each controller, simulated anew; ValueError: it is not the run that the file has."""
    chosen, every = (
        {name: results.controllers[name] for name in controllers},
        [*results.sequences.values()],
    )
    found, traces = metrics.evaluate(
        machine, chosen, every, results.starts, results.seed, results.net
    )
    for row in (r for r in found if r["start"] == start and r["sequence"] == sequence):
        same = [
            r
            for r in results.runs
            if all(r[k] == row[k] for k in ("controller", "sequence", "start"))
        ]
        if not same or not np.isclose(same[0]["velocity_rmse"], row["velocity_rmse"], rtol=1e-3):
            raise ValueError(
                f"{results.path}: expected the run {row}, got {same or 'none'}: another program?"
            )
    goals, first = (
        results.sequences[sequence].goals,
        tool_position(forward_kinematics(machine, results.starts[start])),
    )
    return [
        run_of_trace(machine, name, traces[name, sequence], start, goals, first) for name in chosen
    ]


def film(
    machine: Machine, runs: Sequence[Run], tick: int, size: tuple[int, int]
) -> list[view.Shape]:
    """The picture of one tick of all runs, by the same clock; what is over stands still."""
    scenes, hold = [], np.vstack([run.hold for run in runs])
    for run in runs:
        at = min(tick, len(run.known) - 1)
        known, mean = run.known[at], run.error[: at + 1].mean()
        title, status = view.TITLES.get(run.title, run.title), f"{at * machine.dt:.1f} s"
        scene = view.Scene(
            known.q, known.q_dot, known.u, known.v_goal, run.p_tool[: at + 1], run.path
        )
        notes = [f"velocity error {run.error[at]:.3f} m/s", f"mean so far {mean:.3f} m/s"]
        scenes.append(
            scene._replace(title=title, status=status, colour=run.colour, notes=notes, hold=hold)
        )
    return view.draw(machine, scenes, size)


def write_film(
    path: Path, machine: Machine, runs: Sequence[Run], size: tuple[int, int], fps: float
) -> None:
    """All runs as a GIF, or as MP4 where ffmpeg is installed.

    ValueError: another kind of file, or no ffmpeg that writes it.
    """
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    if path.suffix not in writers:
        raise ValueError(f"{path}: expected a name ending in .gif or .mp4, got {path.suffix!r}")
    ticks = range(0, max(len(run.known) for run in runs), max(1, round(machine.rate / fps)))
    bar = tqdm(ticks, desc="draw", unit="picture", disable=None)
    images = (picture(film(machine, runs, tick, size), size) for tick in bar)
    with whole_file(path) as file:
        writers[path.suffix](file, images, size, machine.rate / ticks.step)


def _write_gif(file: IO[bytes], images: Iterable[Any], size: tuple[int, int], fps: float) -> None:
    films = [Image.fromarray(image) for image in images]
    flat = [image.quantize(palette=_palette(films), dither=Image.Dither.NONE) for image in films]
    duration = round(1000 / fps)
    flat[0].save(file, "GIF", save_all=True, append_images=flat[1:], duration=duration, loop=0)


def _write_mp4(file: IO[bytes], images: Iterable[Any], size: tuple[int, int], fps: float) -> None:
    form = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps} -i - -pix_fmt yuv420p"
    form += " -vf crop=trunc(iw/2)*2:trunc(ih/2)*2"  # the code knows even sizes only
    form += " -f mp4 -movflags frag_keyframe+empty_moov pipe:1"
    command = ["ffmpeg", "-loglevel", "error", *form.split()]
    try:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=file) as process:
            cast(IO[bytes], process.stdin).writelines(image.tobytes() for image in images)
    except FileNotFoundError as error:
        raise ValueError(
            "film: expected ffmpeg for .mp4, or a name ending in .gif, got none"
        ) from error
    except BrokenPipeError:
        process.returncode = process.returncode or 1  # it did not read all pictures
    if process.returncode:
        raise ValueError(f"film: expected ffmpeg to write it, got its status {process.returncode}")


def _palette(films: Sequence[Image.Image]) -> Image.Image:
    """96 colours of some pictures and of all that warns or measures, however little of it there is."""
    some = [np.asarray(film) for film in films[:: max(1, len(films) // 6)]]
    named = [
        *view.COLOURS.values(),
        *view.STATUS_COLOURS.values(),
        view.MEASURED,
        view.PATH,
        view.WARNING,
    ]
    swatches = np.repeat(np.array(named, np.uint8), 40, axis=0)[:, None].repeat(
        some[0].shape[1], axis=1
    )
    return Image.fromarray(np.vstack([*some, swatches])).quantize(96)


def show_film(machine: Machine, runs: Sequence[Run], size: tuple[int, int]) -> None:
    """All runs in a window, in real time; space halts, left and right move by a second."""
    at, going, last = 0, True, max(len(run.known) for run in runs) - 1
    with open_window(size, "brokk_min replay") as window:
        pg = window.pygame
        while True:
            for event in pg.event.get():
                if event.type == pg.QUIT or (event.type == pg.KEYDOWN and event.key == pg.K_ESCAPE):
                    return
                if event.type == pg.KEYDOWN:
                    going ^= event.key == pg.K_SPACE
                    at += round(machine.rate) * (
                        (event.key == pg.K_RIGHT) - (event.key == pg.K_LEFT)
                    )
            at = min(max(at, 0), last)
            window.show(film(machine, runs, at, size), machine.rate)
            at += going
