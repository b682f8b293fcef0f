"""A film of the machine in MuJoCo while a policy drives it: beside the window's drawing, in 3-D.

    python -m examples.mujoco_film --policy policy.npz --out film.gif

The policy follows the goals of a commands CSV. MuJoCo's renderer needs OpenGL; on a computer
without a screen set MUJOCO_GL=egl.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image
from tqdm import tqdm

try:
    import mujoco
except Exception as error:  # of PyOpenGL, if MUJOCO_GL names a library that is not there
    raise SystemExit(f"MUJOCO_GL: expected an OpenGL library that is there, got {error}") from None

from brokk_min.can.operator_input import read_commands
from brokk_min.evaluation.rollout import rollout
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170 as M
from brokk_min.settings import TaskConfig
from brokk_min.viewer.drawing import Scene, draw
from examples.mujoco_brokk import PLANT, build

SIZE = (480, 360)  # px, of each half


@dataclass
class Options:
    """A film of the machine in MuJoCo."""

    policy: Path  # that drives.
    out: Path  # GIF to write.
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


def main(options: Options) -> None:
    """Drive, draw and write."""
    eye, model, data = renderer()
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = (0.0, 1.5, 0.9), 6.5
    camera.azimuth, camera.elevation = 155.0, -12.0
    controller = load_policy(options.policy, M)
    goals = next(iter(read_commands(options.commands, M).values()))[:, None]
    rng = np.random.default_rng(options.seed)
    trace = rollout(M, controller, [M.q_start], goals, TaskConfig.noise, rng, PLANT)
    step = max(1, round(M.rate / options.fps))
    pictures = []
    for k in tqdm(range(0, len(goals), step), desc="draw", unit="frame", disable=None):
        path, status = trace.p_tool[: k + 1, 0], f"{k * M.dt:.1f} s"
        now = trace.q[k, 0], trace.u[k, 0], goals[k, 0], trace.v_tool[k, 0]
        drawn = np.array(draw(M, Scene(*now, path, "PPO on MuJoCo", status), SIZE))
        data.qpos[:] = trace.q[k, 0]
        mujoco.mj_forward(model, data)
        eye.update_scene(data, camera)
        pictures.append(
            Image.fromarray(np.hstack([drawn, eye.render()])).quantize(
                128, Image.Quantize.FASTOCTREE
            )
        )
    first, *rest = pictures
    first.save(options.out, save_all=True, append_images=rest, duration=1e3 * step * M.dt, loop=0)
    print(f"{options.out}: {len(pictures)} pictures")


if __name__ == "__main__":
    main(tyro.cli(Options))
