"""How far from what the computer can do: environment, PPO gradient and kinematics.

    python -m benchmarks.limits [--threads 2] [--json F] [--quick]

Environment: a step with observation and resets, compared with the products of its nets alone. PPO:
operations per second of the matrix products in a gradient, compared with the best rate of any
backend on the same shapes. Kinematics: compared with a loop over pinocchio.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import torch
import tyro

from benchmarks.rollout import random_net, write
from brokk_min import ppo
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170


@dataclass
class Options:
    threads: int = 2  # Threads of torch and OpenBLAS.
    repeats: int = 15  # Timed blocks; what is compared is timed in turn, the least time counts.
    num_envs: tuple[int, ...] = (64, 256, 1024, 4096)  # Environments side by side.
    quick: bool = False  # One short block each: to see that it runs.
    json: Path | None = None  # Also write the figures here.

    @property
    def block_s(self) -> float:
        return 0.02 if self.quick else 0.1


def seconds(calls: dict[str, Callable[[], Any]], options: Options) -> dict[str, float]:
    """Least time of each call [s], all timed in turn: other work can only add to it."""
    counts = {}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        counts[name] = max(1, round(options.block_s / (time.perf_counter() - start)))
    for _ in range(options.repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(counts[name]):
                call()
            times[name].append((time.perf_counter() - start) / counts[name])
    return {name: min(of_call) for name, of_call in times.items()}


def shapes(inputs: int, outputs: tuple[int, ...], batch: int) -> list[tuple[int, int, int]]:
    """(m, k, n) of all products in a gradient of nets: forward, by weights, by inputs."""
    result = []
    for last in outputs:
        for i, (a, b) in enumerate(pairwise((inputs, 256, 128, 64, last))):
            result += [(batch, a, b), (a, batch, b)]
            if i:
                result.append((batch, b, a))
    return result


def products(kind: str, sizes: list[tuple[int, int, int]]) -> Callable[[], Any]:
    """A call that does all products of `sizes` in float32."""
    rng = np.random.default_rng(0)
    pairs = []
    for m, k, n in sizes:
        a = rng.normal(size=(m, k)).astype(np.float32)
        b = rng.normal(size=(k, n)).astype(np.float32)
        pairs.append((a, b))
    if kind == "numpy":
        return lambda: [a @ b for a, b in pairs]
    tensors = [(torch.from_numpy(a), torch.from_numpy(b)) for a, b in pairs]
    if kind == "torch":
        return lambda: [a @ b for a, b in tensors]
    transposed = [(a, b.T.contiguous()) for a, b in tensors]
    linear = torch.ops.mkldnn._linear_pointwise
    return lambda: [linear(a, b, None, "none", [], "") for a, b in transposed]


def environment(num: int, options: Options) -> dict[str, float]:
    env = TaskVectorEnv(num, random_net(np.random.default_rng(0)))
    env.reset(seed=0)
    assert env.state is not None and env.net is not None
    net = env.net
    actions = np.random.default_rng(0).uniform(-1, 1, (num, 4)).astype(np.float32)
    history = env.state.history[:, env.machine.driven]
    calls = {"step": lambda: env.step(actions), "products": lambda: net.predict(history)}
    times = seconds(calls, options)
    return {
        "step_us": 1e6 * times["step"],
        "products_us": 1e6 * times["products"],
        "steps_per_second": num / times["step"],
        "step_over_products": times["step"] / times["products"],
    }


def gradient(options: Options) -> dict[str, Any]:
    """One minibatch of `ppo.train`: loss, gradient, step of Adam."""
    batch = ppo.PPOConfig.minibatch_size
    agent = ppo.Agent(171, 4, -1.8, critic=False)
    optimizer = torch.optim.Adam(agent.parameters(), fused=True)
    mb = {"obs": torch.randn(batch, 171), "actions": torch.randn(batch, 4)}
    mb |= {"logprobs": torch.zeros(batch), "advantages": torch.randn(batch)}

    def step() -> None:
        loss, _ = ppo.ppo_loss(agent, mb, ppo.PPOConfig())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
        optimizer.step()

    sizes = shapes(171, (4,), batch)
    work = sum(2 * m * k * n for m, k, n in sizes) / 1e9
    calls: dict[str, Callable[[], Any]] = {"gradient": step, "torch": products("torch", sizes)}
    calls["numpy"] = products("numpy", sizes)
    try:
        calls["onednn"] = products("onednn", sizes)
        calls["onednn"]()
    except (AttributeError, RuntimeError):  # a torch without it
        calls.pop("onednn", None)
    times = seconds(calls, options)
    rates = {name: work / times[name] for name in calls}
    best = max(rate for name, rate in rates.items() if name != "gradient")
    return {
        "gflops": rates,
        "seconds": times["gradient"],
        "fraction_of_best": rates["gradient"] / best,
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
    torch.set_num_threads(options.threads)
    if options.quick:
        options.repeats = 1
    result = {
        "threads": options.threads,
        "load": os.getloadavg(),
        "environment": {str(num): environment(num, options) for num in options.num_envs},
        "gradient": gradient(options),
        "kinematics": kinematics(options),
    }
    write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
