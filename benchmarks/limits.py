"""How far from what the machine could do: environment, PPO update and kinematics beside their limits.

    python -m benchmarks.limits [--threads 2] [--json F] [--quick]

Environment: step with observation and resets, beside the bare products and activations of its nets. Update:
operations of the matrix products a second, beside the best rate of any backend here on the same shapes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
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

from benchmarks.rollout import random_net
from brokk_min.env import TaskConfig
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.machine import BROKK_170
from brokk_min.ppo import PPOConfig, Training


@dataclass
class Options:
    threads: int = 2
    """Threads of torch and OpenBLAS."""
    repeats: int = 15
    """Timed blocks; what is compared is timed in turn, and the least time counts."""
    num_envs: tuple[int, ...] = (64, 256, 1024, 4096)
    """Environments side by side."""
    quick: bool = False
    """One short block each: to see that it runs."""
    numpy_products: bool = False
    """Only print NumPy's rate on the update's shapes; the program calls itself so."""
    json: Path | None = None
    """Also write the figures here."""


def seconds(calls: dict[str, Callable[[], Any]], repeats: int, block: float) -> dict[str, float]:
    """Least time of each call [s], all timed in turn: other work on the machine can only add to it."""
    counts, times = {}, {name: [] for name in calls}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        counts[name] = max(1, round(block / (time.perf_counter() - start)))
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(counts[name]):
                call()
            times[name].append((time.perf_counter() - start) / counts[name])
    return {name: float(min(found)) for name, found in times.items()}


def shapes(inputs: int, outputs: tuple[int, ...], batch: int) -> list[tuple[int, int, int]]:
    """(m, k, n) of all products in one gradient of nets with these outputs: forward, by weight, by input."""
    result = []
    for last in outputs:
        for i, (a, b) in enumerate(pairwise((inputs, 256, 128, 64, last))):
            result += [(batch, a, b), (a, batch, b)] + ([(batch, b, a)] if i else [])
    return result


def products(kind: str, sizes: list[tuple[int, int, int]]) -> Callable[[], Any]:
    """A call that does all products of `sizes` in float32."""
    rng = np.random.default_rng(0)
    pairs = [(rng.normal(size=(m, k)), rng.normal(size=(k, n))) for m, k, n in sizes]
    pairs = [(a.astype(np.float32), b.astype(np.float32)) for a, b in pairs]
    if kind == "numpy":
        return lambda: [a @ b for a, b in pairs]
    tensors = [(torch.from_numpy(a), torch.from_numpy(b)) for a, b in pairs]
    if kind == "torch":
        return lambda: [a @ b for a, b in tensors]
    turned = [(a, b.T.contiguous()) for a, b in tensors]
    linear = torch.ops.mkldnn._linear_pointwise
    return lambda: [linear(a, b, None, "none", [], "") for a, b in turned]


def environment(num: int, options: Options) -> dict[str, float]:
    env = TaskVectorEnv(num, random_net(np.random.default_rng(0)))
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (num, 4)).astype(np.float32)
    inputs = env.state.history[:, env.machine.driven]
    calls = {"step": lambda: env.step(actions), "products": lambda: env.net.predict(inputs)}
    found = seconds(calls, options.repeats, 0.02 if options.quick else 0.1)
    return {
        "step_us": 1e6 * found["step"],
        "products_us": 1e6 * found["products"],
        "steps_per_second": num / found["step"],
        "step_over_products": found["step"] / found["products"],
    }


def update(options: Options) -> dict[str, Any]:
    config = PPOConfig(threads=options.threads, horizon=8 if options.quick else 32)
    env = TaskVectorEnv(config.num_envs, random_net(np.random.default_rng(0)), config=TaskConfig())
    training = Training(env, config, 0)
    batch, _ = training._collect()
    rows = min(config.minibatch_size, len(batch["action"]))
    outputs = (4, 1) if training.critic else (4,)
    sizes = shapes(batch["observation"].shape[1], outputs, rows)
    gradients = config.epochs * len(batch["action"]) / rows
    work = sum(2 * m * k * n for m, k, n in sizes)
    calls = {"update": lambda: training._learn(batch), "torch": products("torch", sizes)}
    try:
        calls["onednn"] = products("onednn", sizes)
        calls["onednn"]()
    except (AttributeError, RuntimeError):  # a torch without it
        calls.pop("onednn", None)
    found = seconds(calls, options.repeats, 0.02 if options.quick else 0.1)
    rates = {f"products_{name}": work / found[name] / 1e9 for name in list(calls)[1:]}
    for core in ("",) if options.quick else ("", "Haswell", "SkylakeX"):
        rates[f"products_numpy{core and '_' + core}"] = numpy_rate(core, options, work)
    best = max(rates.values())
    rate = gradients * work / found["update"] / 1e9
    return {
        "gflops": rates | {"update": rate},
        "seconds": found["update"],
        "share_of_best": rate / best,
    }


def numpy_rate(core: str, options: Options, work: float) -> float:
    """GFLOP/s of NumPy with OpenBLAS's kernels for `core`; they are chosen at its start. 0: it cannot."""
    variables = os.environ | {"OPENBLAS_NUM_THREADS": str(options.threads)}
    variables |= {"OPENBLAS_CORETYPE": core} if core else {}
    arguments = [sys.executable, "-m", "benchmarks.limits", "--numpy-products"]
    arguments += ["--quick"] * options.quick + ["--repeats", str(options.repeats)]
    done = subprocess.run(arguments, env=variables, capture_output=True, text=True)
    return work / float(done.stdout) / 1e9 if done.returncode == 0 else 0.0


def kinematics(options: Options) -> dict[str, float]:
    m, model = BROKK_170, pinocchio.Model()
    for i in range(m.n):  # as many joints; the time does not depend on where they are
        place = pinocchio.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
        model.addJoint(i, pinocchio.JointModelRZ(), place, f"joint_{i}")
    tool = model.addFrame(pinocchio.Frame("tool", m.n, place, pinocchio.FrameType.OP_FRAME))
    data, q = model.createData(), np.random.default_rng(0).uniform(0, 1, (4096, m.n))

    def loop() -> None:  # to the same results: position and Jacobian along the base's axes
        for row in q[:1024]:
            pinocchio.computeJointJacobians(model, data, row)
            pinocchio.updateFramePlacement(model, data, tool)
            _ = data.oMf[tool].translation
            pinocchio.getFrameJacobian(
                model, data, tool, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )

    calls = {"jacobian": lambda: jacobian(forward_kinematics(m, q)), "pinocchio": loop}
    found = seconds(calls, options.repeats, 0.02 if options.quick else 0.1)
    return {
        "us_per_configuration": 1e6 * found["jacobian"] / len(q),
        "pinocchio_loop_us": 1e6 * found["pinocchio"] / 1024,
    }


def main(options: Options) -> dict[str, Any]:
    torch.set_num_threads(options.threads)
    if options.quick:
        options.repeats, options.num_envs = 1, options.num_envs[:2]
    if options.numpy_products:
        call = products("numpy", shapes(171, (4,), PPOConfig.minibatch_size))
        print(seconds({"numpy": call}, options.repeats, 0.02 if options.quick else 0.1)["numpy"])
        return {}
    result = {
        "threads": options.threads,
        "load": os.getloadavg(),
        "environment": {str(num): environment(num, options) for num in options.num_envs},
        "update": update(options),
        "kinematics": kinematics(options),
    }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
