"""How far from what the computer can do: updates of both learners, and kinematics.

    python -m benchmarks.limits [--json F]

Updates, PPO's and ours: operations per second of all products of matrices in an update, those of
the gradient and those of Muon, compared with the better rate of torch and NumPy on the same shapes.
Kinematics: compared with a loop over pinocchio. For the environment see `benchmarks.rollout`. Times
are of CPU, of one thread, so that other work counts little.
"""

from __future__ import annotations

import os
import time
import timeit
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import torch
import tyro

from benchmarks import write
from brokk_min import ppo
from brokk_min.identification.muon import ITERATIONS, Muon
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.checkpoint import use_fast_float32
from brokk_min.learning.episodes import GRADIENT_LEARNER
from brokk_min.learning.simulation_gradient import regression_loss
from brokk_min.machine import BROKK_170


@dataclass
class Options:
    repeats: int = 15  # Timed blocks; what is compared is timed in turn, the least time counts.
    block_s: float = 0.1  # Length of a block [s].
    json: Path | None = None  # Also write the figures here.


def seconds(calls: dict[str, Callable[[], Any]], options: Options) -> dict[str, float]:
    """Least time of each call [s], all timed in turn: other work can only add to it."""
    timers = {name: timeit.Timer(call, timer=time.process_time) for name, call in calls.items()}
    least = dict.fromkeys(calls, np.inf)
    for _ in range(options.repeats):
        for name, timer in timers.items():
            number = max(1, round(options.block_s / min(timer.repeat(2, 1))))
            least[name] = min(least[name], timer.timeit(number) / number)
    return least


def shapes(widths: tuple[int, ...], batch: int) -> list[tuple[int, int, int]]:
    """(m, k, n) of all products in a gradient of a net: forward, by weights, by inputs."""
    result = []
    for i, (a, b) in enumerate(pairwise(widths)):
        result += [(batch, a, b), (a, batch, b)]
        if i:
            result.append((batch, b, a))
    return result


def muon_shapes(widths: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """(m, k, n) of all products in a step of Muon: three for each matrix and iteration."""
    result = []
    for pair in pairwise(widths):
        a, b = sorted(pair)
        result += ITERATIONS * [(a, b, a), (a, a, a), (a, a, b)]
    return result


def update(
    loss_function: ppo.Loss, batch: int, optimize: Callable[..., torch.optim.Adam], options: Options
) -> dict[str, Any]:
    """One minibatch of `ppo.train`: loss, gradient, step. Work: all its products of matrices."""
    agent = ppo.Agent(223, 4, -1.8, critic=False)
    optimizer = optimize(agent.parameters(), 1e-3)
    mb = {"obs": torch.randn(batch, 223), "actions": torch.randn(batch, 4)}
    mb |= {"logprobs": torch.zeros(batch), "advantages": torch.randn(batch)}
    mb |= {"means": torch.randn(batch, 4), "targets": torch.randn(batch, 4)}

    def step() -> None:
        loss, _ = loss_function(agent, mb, ppo.PPOConfig())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
        optimizer.step()

    widths = (223, 256, 128, 64, 4)
    sizes = shapes(widths, batch) + (muon_shapes(widths) if optimize is Muon else [])
    rng = np.random.default_rng(0)
    arrays = []
    for m, k, n in sizes:
        a = rng.normal(size=(m, k)).astype(np.float32)
        b = rng.normal(size=(k, n)).astype(np.float32)
        arrays.append((a, b))
    tensors = [(torch.from_numpy(a), torch.from_numpy(b)) for a, b in arrays]
    calls = {
        "update": step,
        "torch": lambda: [a @ b for a, b in tensors],
        "numpy": lambda: [a @ b for a, b in arrays],
    }
    times = seconds(calls, options)
    work = sum(2 * m * k * n for m, k, n in sizes) / 1e9
    rates = {name: work / time for name, time in times.items()}
    return {
        "gflops": rates,
        "seconds": times["update"],
        "fraction_of_best": rates["update"] / max(rates["torch"], rates["numpy"]),
    }


def kinematics(options: Options) -> dict[str, float]:
    model = pinocchio.Model()
    place = pinocchio.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    for i in range(BROKK_170.n):  # as many joints; the time does not depend on where they are
        model.addJoint(i, pinocchio.JointModelRZ(), place, f"joint_{i}")
    frame = pinocchio.Frame("tool", BROKK_170.n, place, pinocchio.FrameType.OP_FRAME)
    tool = model.addFrame(frame)
    data = model.createData()
    axes = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    q = np.random.default_rng(0).uniform(0, 1, (4096, BROKK_170.n))

    def loop() -> None:
        for row in q[:1024]:
            pinocchio.computeJointJacobians(model, data, row)
            pinocchio.updateFramePlacement(model, data, tool)
            pinocchio.getFrameJacobian(model, data, tool, axes)

    def ours() -> None:
        jacobian(forward_kinematics(BROKK_170, q))

    times = seconds({"jacobian": ours, "pinocchio": loop}, options)
    return {
        "us_per_configuration": 1e6 * times["jacobian"] / len(q),
        "pinocchio_loop_us": 1e6 * times["pinocchio"] / 1024,
    }


def main(options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    use_fast_float32()
    ours = GRADIENT_LEARNER["minibatch_size"]
    adam = partial(torch.optim.Adam, fused=True)  # as `ppo.make_learner`
    result = {
        "load": os.getloadavg(),
        "ppo": update(ppo.ppo_loss, ppo.PPOConfig.minibatch_size, adam, options),
        "ours": update(regression_loss, ours, Muon, options),
        "ours_with_adam": update(regression_loss, ours, adam, options),
        "kinematics": kinematics(options),
    }
    write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
