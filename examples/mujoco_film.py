"""A film of one motion in MuJoCo, driven by the PID that was tuned by hand and by a policy.

    python -m examples.mujoco_film --out film.gif

Grey is the path that is wanted, blue the one that the tool has taken. The chart has the velocity
error |v_goal - v_tool| since the start, and the number its mean so far. MuJoCo's renderer needs
OpenGL; on a computer without a screen set MUJOCO_GL=egl.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

try:
    import mujoco
except Exception as error:  # of PyOpenGL, if MUJOCO_GL names a library that is not there
    raise SystemExit(f"MUJOCO_GL: expected an OpenGL library that is there, got {error}") from None

from matplotlib import get_data_path

from brokk_min._files import SHIPPED
from brokk_min.can.operator_input import read_commands
from brokk_min.evaluation.baselines import BY_HAND, load_pids
from brokk_min.evaluation.rollout import Trace, rollout, title
from brokk_min.kinematics import forward_kinematics, tool_position
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.machine import Array
from brokk_min.settings import TaskConfig
from examples.mujoco_brokk import PLANT, build

SIZE = (440, 330)  # px, of each half
CHART = 70  # px, its height below that
HIGHEST = 0.15  # m/s, in the chart
GREY, BLUE = (0.25, 0.25, 0.28, 1.0), (0.0, 0.45, 0.7, 1.0)
FONT = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", 17)
GAINS = SHIPPED / M.name / "gains.json"


@dataclass
class Options:
    """A film of the machine in MuJoCo."""

    out: Path  # GIF to write.
    policy: Path = SHIPPED / M.name / "policy.npz"  # that drives.
    commands: Path = Path(__file__).parents[1] / "docs" / "rectangle.csv"  # Its first sequence.
    fps: float = 5.0  # pictures of a second of the drive.
    seed: int = 0  # of the sensors' noise.


def renderer() -> tuple[Any, Any, Any]:
    """MuJoCo's renderer with the model and its data; SystemExit: there is no OpenGL."""
    model, data = build(M, 0.0, 0.0)
    model.vis.global_.offwidth, model.vis.global_.offheight = SIZE
    try:
        return mujoco.Renderer(model, SIZE[1], SIZE[0]), model, data
    except Exception as error:  # what PyOpenGL and MuJoCo raise differs by platform
        raise SystemExit(
            f"OpenGL: expected a library that renders (MUJOCO_GL), got {error}"
        ) from None


def draw_path(scene: Any, points: Array, width: float, colour: tuple[float, ...]) -> None:
    """Add a line through points (T, 3) [m] to MuJoCo's scene."""
    for start, end in pairwise(points):
        geom = scene.geoms[scene.ngeom]
        zeros, capsule = np.zeros(3), mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, capsule, zeros, zeros, np.zeros(9), np.array(colour, np.float32))
        mujoco.mjv_connector(geom, capsule, width, start, end)
        scene.ngeom += 1


def main(options: Options) -> None:
    """Drive, draw and write."""
    eye, model, data = renderer()
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = (-0.2, 1.65, 1.05), 5.0
    camera.azimuth, camera.elevation = 165.0, -12.0
    policy = load_policy(options.policy, M)
    pid = load_pids(M, GAINS, policy.net)[BY_HAND]
    goals = next(iter(read_commands(options.commands, M).values()))[:, None]
    step = max(1, round(M.rate / options.fps))
    start = tool_position(forward_kinematics(M, np.array(M.q_start)))
    wanted = start + np.cumsum(goals[:, 0], axis=0) * M.dt  # [m]
    traces: dict[str, Trace] = {}
    for name, controller in ((title(BY_HAND), pid), ("policy, trained with PPO", policy)):
        rng = np.random.default_rng(options.seed)
        traces[name] = rollout(M, controller, [M.q_start], goals, TaskConfig.noise, rng, PLANT)
    pictures = []
    for k in tqdm(range(0, len(goals), step), desc="draw", unit="frame", disable=None):
        halves = []
        for name, trace in traces.items():
            data.qpos[:] = trace.q[k, 0]
            mujoco.mj_forward(model, data)
            eye.update_scene(data, camera)
            taken = trace.p_tool[: k + 1, 0]  # (k + 1, 3)
            draw_path(eye.scene, wanted[::step], 0.012, GREY)
            draw_path(eye.scene, taken[::step], 0.02, BLUE)
            half = Image.new("RGB", (SIZE[0], SIZE[1] + CHART), "white")
            half.paste(Image.fromarray(eye.render()))
            error = np.linalg.norm(goals - trace.v_tool, axis=-1)[: k + 1, 0]
            x = np.arange(k + 1) * (SIZE[0] - 24) / len(goals) + 12
            y = SIZE[1] + CHART * (1 - np.minimum(error / HIGHEST, 1))
            pen = ImageDraw.Draw(half)
            outline = np.column_stack([[*x, x[-1], x[0]], [*y, *2 * [SIZE[1] + CHART]]])
            pen.polygon(outline.ravel().tolist(), "firebrick")
            pen.text((12, 10), name, "black", FONT)
            pen.text((12, 34), f"velocity error {1e3 * error.mean():.0f} mm/s", "black", FONT)
            halves.append(np.array(half))
        pair = Image.fromarray(np.hstack(halves))
        pictures.append(pair.quantize(96, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    first, *rest = pictures
    first.save(options.out, save_all=True, append_images=rest, duration=1e3 * step * M.dt, loop=0)
    print(f"{options.out}: {len(pictures)} pictures")
    for name, trace in traces.items():
        error = np.linalg.norm(goals - trace.v_tool, axis=-1).mean()
        print(f"{name}: mean velocity error {error:.4f} m/s")


if __name__ == "__main__":
    main(tyro.cli(Options))
