"""Fit a net; the error of one step misleads (90 minutes).

An actuator net reads the history of a joint, 13 angles, velocities and commands, and gives the mean
velocity over the coming tick. It learns that from logs: the paper takes two layers of 32, ReLU, the
mean squared error and Adam.

How good is it? The error of one step is the first figure that comes to mind. Most of it is the
encoder's noise, and a velocity changes little in 50 ms. So a model that knows nothing, "as fast as
just now", looks decent. A policy trains on something else: on a net that goes on from its own
outputs, tick after tick. That is a free run. There a small bias adds up, and noise does not.

Write the fit (PyTorch, about fifteen lines; scale the inputs!) and the free run. The check records
joint q5 of the plant, fits your net twice, once without its history, and prints both errors.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from brokk_min.actuator import (
    PLANT,
    ActuatorNet,
    NetState,
    append_command,
    append_sample,
    initial_history,
)
from brokk_min.machine import BROKK_170, Array, read_encoder
from exercises.verdict import WrongAnswer, expect

SOLUTION = "brokk_min/fit.py: fit; brokk_min/actuator.py: ActuatorNet"
H, DT, WINDOW = BROKK_170.history, BROKK_170.dt, BROKK_170.velocity_samples
Predict = Callable[[Array], Array]  # inputs (N, 39) -> velocities [rad/s] (N,)


def fit(inputs: Array, targets: Array) -> Predict:
    """A model of targets [rad/s] (N,) by inputs (N, 39): 13 angles, 13 velocities, 13 commands."""
    raise NotImplementedError


def free_run(predict: Predict, history: Array, q: Array, commands: Array) -> Array:
    """Angles [rad] (T, m) of m joints under the commands (T, m), by a model on its own outputs.

    `history` (m, 3, H) ends with the angles `q` [rad] (m,) and is without the first command. Each
    tick: `append_command`, predict, move on by DT, `append_sample` (both of brokk_min.actuator).
    """
    raise NotImplementedError


def record(seed: int, ticks: int = 300, runs: int = 16) -> tuple[Array, Array, Array]:
    """Inputs (T, runs, 39), encoder angles (T + 1, runs), commands (T, runs) of q5.

    A command holds for 0.5 s; four of ten are zero, the others lead back to the middle.
    """
    rng = np.random.default_rng(seed)
    poses = np.tile([0.0, 0.5, 0.5, 1.7, 1.0], (runs, 1))
    poses[:, 4] = rng.uniform(0.3, 1.7, runs)
    state = PLANT.reset(BROKK_170, poses)
    angles = [read_encoder(BROKK_170, state.q)[:, 4]]
    history = initial_history(angles[0], H)
    commands, inputs = [], []
    for t in range(ticks):
        if t % 10 == 0:
            u = rng.uniform(0.1, 0.63, runs) * np.sign(1 - angles[-1]) * (rng.random(runs) > 0.4)
        inputs.append(append_command(history, u).reshape(runs, -1))
        state = PLANT.step(BROKK_170, state, u[:, None] * np.eye(5)[4])
        angles.append(read_encoder(BROKK_170, state.q)[:, 4])
        history = append_sample(history, u, angles[-1], WINDOW, DT)
        commands.append(u)
    return np.array(inputs), np.array(angles), np.array(commands)


def rms(error: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def check_free_run(free_run: Callable[..., Array]) -> None:
    """By hand, then against the package."""
    rng = np.random.default_rng(0)
    q = np.array([0.5, 1.0])
    history = initial_history(q, H)
    commands = rng.uniform(-1, 1, (5, 2))
    angles = free_run(lambda x: np.full(len(x), 2.0), history, q, commands)
    wanted = [0.6, 0.7, 0.8, 0.9, 1.0]
    expect("free run at 2 rad/s from 0.5 rad", np.asarray(angles)[:, 0], wanted)
    angles = free_run(lambda x: x[:, -1], history, q, commands)
    why = "The model must read the command of the tick itself, not the one before."
    expect("free run at the newest command", angles, q + DT * np.cumsum(commands, axis=0), why)
    weights = rng.normal(0, 0.2, 3 * H)
    net: Any = SimpleNamespace(velocity_samples=WINDOW)  # a linear model of the driven joints
    net.predict = lambda h: h.reshape(len(h), -1) @ weights
    driven, pose = BROKK_170.driven, np.array([0.0, 0.7, 0.7, 1.7, 1.0])
    first = initial_history(pose[driven], H)
    state, wanted = NetState(pose, first), []
    commands = np.zeros((5, BROKK_170.n))
    commands[:, driven] = rng.uniform(-0.3, 0.3, (5, 4))
    for u in commands:
        state = ActuatorNet.step(net, BROKK_170, state, u)
        wanted.append(state.q[driven])
    angles = free_run(lambda x: x @ weights, first, pose[driven], commands[:, driven])
    expect("free run of a linear model", angles, np.array(wanted))


def check(fit: Callable[[Array, Array], Predict], free_run: Callable[..., Array]) -> None:
    """The free run by hand, then three models on recordings that they have not seen."""
    check_free_run(free_run)
    inputs, angles, _ = record(0)
    targets = np.diff(angles, axis=0) / DT
    x, y = inputs.reshape(-1, 3 * H), targets.ravel()
    newest = np.arange(3 * H) % H == H - 1  # the columns of the newest sample
    net, blind = fit(x, y), fit(x * newest, y)
    models: dict[str, Predict] = {
        "as fast as just now": lambda x: x[:, 2 * H - 1],
        "yours, newest sample": lambda x: blind(x * newest),
        "yours, 13 samples": net,
    }
    inputs, angles, commands = record(1)
    targets = np.diff(angles, axis=0) / DT
    first, ticks = 100, 100  # free runs of 5 s
    history = inputs[first].reshape(-1, 3, H).copy()
    history[:, 2] = inputs[first - 1].reshape(-1, 3, H)[:, 2]  # without the first command
    table = {}
    print("model                    one step [rad/s]   after 5 s [rad]")
    for name, predict in models.items():
        answer = np.asarray(predict(inputs.reshape(-1, 3 * H)))
        expect(f"{name}: shape of the predictions", answer.shape, targets.ravel().shape)
        one_step = rms(answer - targets.ravel())
        runs = free_run(predict, history, angles[first], commands[first : first + ticks])
        drift = float(np.median(np.abs(np.asarray(runs)[-1] - angles[first + ticks])))
        table[name] = one_step, drift
        print(f"{name:24} {one_step:10.4f} {drift:20.3f}")
    (naive_step, naive), _, (step, drift) = table.values()
    if not step < 0.8 * naive_step:
        got = f"{step:.4f} against {naive_step:.4f} rad/s"
        raise WrongAnswer(f"one step: expected below 0.8 of the first model's error, got {got}")
    if not drift < 0.25 * naive:
        got = f"{drift:.3f} against {naive:.3f} rad"
        raise WrongAnswer(f"after 5 s: expected below 0.25 of the first model's error, got {got}")
