"""Recorded runs side by side, of logs or of results simulated again: in a window or as a film."""

import subprocess
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from brokk_min.actuator import ActuatorNet
from brokk_min.can.drive_log import read_frames, read_telemetry
from brokk_min.env import TaskConfig
from brokk_min.evaluation import baselines, metrics
from brokk_min.evaluation.rollout import TITLES, Controller
from brokk_min.evaluation.sequences import Commands, goals_and_starts, task_sequences
from brokk_min.identification.files import located, read_json, whole_file
from brokk_min.identification.formats import RESULTS, RUNS, check_fields
from brokk_min.identification.progress import progress
from brokk_min.kinematics import forward_kinematics, tool_position, tool_velocity
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import Array, Machine
from brokk_min.viewer import camera, drawing, tracing
from brokk_min.viewer.window import Canvas, Colour, Window

FFMPEG = (  # raw pictures in, MP4 of even width and height out
    "ffmpeg -loglevel error -f rawvideo -pix_fmt rgb24 -s {0}x{1} -r {2} -i - -pix_fmt yuv420p "
    "-vf crop=trunc(iw/2)*2:trunc(ih/2)*2 -f mp4 -movflags frag_keyframe+empty_moov pipe:1"
)
LAST_FRAME = 3000  # ms for which a GIF holds it, then it begins again
Images = Iterable[NDArray[np.uint8]]  # (height, width, 3)


@dataclass
class Run:
    """A recorded run of T ticks."""

    machine: Machine
    title: str
    colour: Colour
    q: Array  # rad (T, n)
    q_dot: Array  # rad/s (T, n)
    u: Array  # in [-1, 1] (T, n)
    v_goal: Array  # m/s (T, 3)
    path: Array  # line that the tool should follow [m] (K, 3), or no points

    @cached_property
    def p_tool(self) -> Array:
        """Tool positions [m], (T, 3)."""
        return tool_position(forward_kinematics(self.machine, self.q))

    @cached_property
    def error(self) -> Array:
        """Velocity error |v_goal - v_tool| [m/s], (T,)."""
        v_tool = tool_velocity(forward_kinematics(self.machine, self.q), self.q_dot)
        return np.asarray(np.linalg.norm(self.v_goal - v_tool, axis=-1))

    @cached_property
    def distance(self) -> Array:
        """Distance of the tool from the path [m], (T,)."""
        return tracing.distance(self.path, self.p_tool)

    @cached_property
    def in_view(self) -> Array:
        """Points that a picture must show [m], (K, 3): the path, and the arm twice a second."""
        corners = camera.skeleton(self.machine, self.q[::10]).reshape(-1, 3)
        return np.vstack([corners, self.path])


def run_of_log(machine: Machine, path: Path, colour: Colour) -> Run:
    """Ticks of a candump log from the first driven one; ticks without all positions are left out.

    ValueError: no log, or one in which nothing drives.
    """
    telemetry = read_telemetry(machine, read_frames(path))
    ticks = [tick for tick in telemetry if np.isfinite(tick.q).all()]
    driving = [t.driving for t in ticks]
    if not any(driving):
        raise ValueError(f"{path}: expected a log in which the valves are driven, got none")
    ticks = ticks[driving.index(True) :]
    columns = {k: np.array([getattr(t, k) for t in ticks]) for k in ("q", "q_dot", "u", "v_goal")}
    return Run(machine, path.name, colour, **columns, path=drawing.NO_POINTS)


# --- results --------------------------------------------------------------------------------------


class Results(NamedTuple):
    """A file of results, and what it takes to simulate its runs again."""

    path: Path
    rows: list[dict[str, Any]]
    sequences: dict[str, Commands]
    starts: Array  # rad (starts, n)
    controllers: dict[str, Controller]
    net: ActuatorNet | None  # what moved; None: the plant
    seed: int
    noise: float


def read_results(machine: Machine, path: Path, controllers: Sequence[str]) -> Results:
    """A JSON file of `evaluate` or `reproduce`; `controllers` are needed from its gains file.

    ValueError: no results, or of another machine, or the files named in it are wrong.
    """
    file = read_json(path, "results of `evaluate`")
    check_fields(path, file, {"meta": RESULTS["meta"]}, {})
    meta: dict[str, Any] = {"plant": "analytic", "commands": "", "starts": ""}
    meta |= {"noise": TaskConfig.noise} | file["meta"]
    if meta["machine"] != machine.name:
        raise ValueError(f"{path}: expected --machine {meta['machine']}, got {machine.name}")
    check_fields(path, file, RESULTS, {"n": machine.n})
    content = file.get("task_space", file)
    check_fields(path, content, RUNS, {})
    num = int(meta["starts"]) if meta["starts"].isdecimal() else 0
    own = ", ".join(sequence.name for sequence in task_sequences(machine))
    commands = None if meta["commands"] in ("", own) else Path(meta["commands"])
    poses = None if num or not meta["starts"] else Path(meta["starts"])
    with located(path):
        sequences, drawn = goals_and_starts(machine, commands, poses, num, meta["seed"])
        policy = load_policy(Path(meta.get("policy", path.with_name("policy.npz"))), machine)
        named: dict[str, Controller] = {"rl": PolicyController(machine, policy)}
        if set(controllers) - {"rl"}:
            gains = Path(meta.get("gains", path.with_name("gains.json")))
            if gains.name == "tuned now":
                raise ValueError("gains: expected those of a file (--save-gains), got none")
            named |= baselines.read_gains(gains, machine, policy.net)
    starts = np.array(file.get("starts", drawn), float)
    if meta["plant"] not in ("analytic", "net"):
        expected = "expected runs of the analytic plant or of nets"
        raise ValueError(f"{path}: plant: {expected}, got {meta['plant']}")
    net = policy.net if meta["plant"] == "net" else None
    by_name = {s.name: s for s in sequences}
    made_by = meta["seed"], meta["noise"]
    return Results(path, content["runs"], by_name, starts, named, net, *made_by)


def simulate_again(
    machine: Machine, results: Results, controllers: Sequence[str], sequence: str, start: int
) -> list[Run]:
    """One run of each controller; ValueError: it is not the run of the file."""
    chosen = {name: results.controllers[name] for name in controllers}
    sequences = list(results.sequences.values())
    task = (sequences, results.starts, results.seed, results.net)
    config = TaskConfig(noise=results.noise)
    rows, traces = metrics.evaluate(machine, chosen, *task, config=config)
    for row in rows:
        if row["start"] == start and row["sequence"] == sequence:
            _check_row(results, row)
    goals = results.sequences[sequence].for_starts(machine, results.starts)[:, start]
    p_start = tool_position(forward_kinematics(machine, results.starts[start]))
    path = p_start + np.vstack([np.zeros(3), np.cumsum(goals, axis=0)]) * machine.dt
    runs = []
    for name in chosen:
        q, q_dot, u = (getattr(traces[name, sequence], k)[:, start] for k in ("q", "q_dot", "u"))
        colour = drawing.COLOURS.get(name.split("_")[0], drawing.STEEL)
        runs.append(Run(machine, name, colour, q, q_dot, u, goals, path))
    return runs


def _check_row(results: Results, row: dict[str, Any]) -> None:
    """Refuse a simulated row that differs from the file's."""
    keys = ("controller", "sequence", "start")
    same = [other for other in results.rows if all(other[key] == row[key] for key in keys)]
    if not same or not np.isclose(same[0]["velocity_rmse"], row["velocity_rmse"], rtol=1e-3):
        got = f"{same or 'none'}: another program?"
        raise ValueError(f"{results.path}: expected the run {row}, got {got}")


# --- films ----------------------------------------------------------------------------------------


def film(runs: Sequence[Run], tick: int, size: tuple[int, int]) -> Canvas:
    """The picture of one tick of all runs; a run that is over stands still."""
    in_view = np.vstack([run.in_view for run in runs])
    traced = [p for run in runs if len(run.path) for p in (run.path, run.p_tool)]
    close_up = np.vstack(traced) if len(traced) == 2 * len(runs) else drawing.NO_POINTS
    canvas = Canvas(size)
    scenes = [_scene(run, tick, in_view, close_up) for run in runs]
    drawing.draw(canvas, runs[0].machine, scenes)
    return canvas


def _scene(run: Run, tick: int, in_view: Array, close_up: Array) -> drawing.Scene:
    at = min(tick, len(run.q) - 1)
    headline = ""
    if len(close_up):
        headline = f"largest distance from the line: {1e3 * run.distance[: at + 1].max():.0f} mm"
    return drawing.Scene(
        run.q[at],
        run.q_dot[at],
        run.u[at],
        run.v_goal[at],
        trail=run.p_tool[: at + 1],
        path=run.path,
        title=TITLES.get(run.title, run.title),
        status=f"{at * run.machine.dt:.1f} s",
        colour=run.colour,
        notes=[
            f"velocity error {run.error[at]:.3f} m/s",
            f"mean so far {run.error[: at + 1].mean():.3f} m/s",
        ],
        in_view=in_view,
        close_up=close_up,
        headline=headline,
    )


def write_film(
    path: Path, machine: Machine, runs: Sequence[Run], size: tuple[int, int], fps: float
) -> None:
    """All runs as a GIF, or as MP4 where ffmpeg is installed.

    ValueError: another kind of file, or no ffmpeg that writes it.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: expected a name ending in .gif or .mp4, got {path.suffix!r}")
    step = max(1, round(machine.rate / fps))
    last = max(len(run.q) for run in runs) - 1
    bar = progress([*range(0, last, step), last], desc="draw", unit="frame")
    images = (film(runs, tick, size).image() for tick in bar)
    with whole_file(path) as file:
        if path.suffix == ".mp4":
            _write_mp4(file, images, size, machine.rate / step)
        else:
            samples = [film(runs, tick, size).image() for tick in (0, last // 2, last)]
            _write_gif(file, images, samples, machine.rate / step)


def _write_gif(file: IO[bytes], images: Images, samples: Sequence[Any], fps: float) -> None:
    """A GIF with the colours of some samples of the pictures, and of what may be short."""
    rare = [np.full_like(samples[0][:40], c) for c in (drawing.WARNING, drawing.MEASURED)]
    palette = Image.fromarray(np.vstack([*samples, *rare])).quantize(48)
    none = Image.Dither.NONE
    frames = [Image.fromarray(image).quantize(palette=palette, dither=none) for image in images]
    times = [round(1000 / fps)] * (len(frames) - 1) + [LAST_FRAME]
    more = {"append_images": frames[1:], "duration": times, "loop": 0}
    frames[0].save(file, "GIF", save_all=True, **more)


def _write_mp4(file: IO[bytes], images: Images, size: tuple[int, int], fps: float) -> None:
    with TemporaryFile() as raw:
        raw.writelines(image.tobytes() for image in images)
        raw.seek(0)
        try:
            done = subprocess.run(FFMPEG.format(*size, fps).split(), stdin=raw, stdout=file)
        except FileNotFoundError as error:
            message = "film: expected ffmpeg for .mp4, or a name in .gif, got none"
            raise ValueError(message) from error
    if done.returncode:
        raise ValueError(f"film: expected ffmpeg to write it, got its status {done.returncode}")


def show_film(machine: Machine, runs: Sequence[Run], size: tuple[int, int]) -> None:
    """All runs in a window, in real time; space halts, left and right move by a second."""
    last = max(len(run.q) for run in runs) - 1
    second = round(machine.rate)
    tick = 0
    playing = True
    with closing(Window(size, "brokk_min replay")) as window:
        pg = window.pygame
        steps = {pg.K_RIGHT: second, pg.K_LEFT: -second}
        while True:
            for event in pg.event.get():
                key = event.key if event.type == pg.KEYDOWN else None
                if event.type == pg.QUIT or key == pg.K_ESCAPE:
                    return
                playing ^= key == pg.K_SPACE
                tick += steps.get(key, 0)
            tick = min(max(tick, 0), last)
            window.show(film(runs, tick, size), machine.rate)
            tick += playing
