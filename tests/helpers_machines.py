"""Cheap actuator nets, a recording and oracles for the tests."""

from dataclasses import replace

import numpy as np

from brokk_min.actuator import ActuatorNet, hydraulics
from brokk_min.beyond.strong_pid import StrongGains
from brokk_min.env import Measured, measure
from brokk_min.evaluation import baselines, sequences
from brokk_min.fit import Log, Recording, velocity_of
from brokk_min.jacobian import Gains
from brokk_min.machine import BROKK_170, Machine, read_encoder

POSE = np.array([1.5, 0.5, 0.58, 1.71, 1.24])  # the paper's q_s
DRIVEN = [0, 2, 3, 4]  # joints of the Brokk


def coarse(machine: Machine, dt: float) -> Machine:
    """The machine with longer steps of Euler's rule [s]: faster to simulate."""
    return replace(machine, hydraulics=replace(hydraulics(machine), dt=dt))


LOW = replace(BROKK_170, name="low", ground=-100.0)  # no pose is in the ground


class Idle:
    """A controller that sends nothing."""

    def start(self, num):
        return None

    def __call__(self, measured, state):
        return np.zeros(measured.q.shape), None


def random_net(seed=0, n=3, history=13, rows=3):
    """Nets of the paper's size whose weights nobody fitted."""
    rng = np.random.default_rng(seed)
    inputs = rows * history
    sizes = ((inputs, 32), (32,), (32, 32), (32,), (32, 1), (1,))
    return ActuatorNet(
        joints=tuple(f"j{i}" for i in range(n)),
        history=history,
        rate=20.0,
        velocity_samples=4,
        machine="some",
        training={"seed": seed},
        input_mean=rng.uniform(-1, 1, (n, inputs)).astype(np.float32),
        input_scale=rng.uniform(0.1, 2, (n, inputs)).astype(np.float32),
        output_low=rng.uniform(-0.6, -0.1, n).astype(np.float32),
        output_high=rng.uniform(0.1, 0.6, n).astype(np.float32),
        weights=tuple((rng.standard_normal((n, *s)) / s[0] ** 0.5).astype("f4") for s in sizes),
    )


def small_net(machine, rng, joints=()):
    """`random_net` of `joints` of a machine (none: the driven ones): all inputs matter."""
    joints = joints or tuple(machine.names[i] for i in machine.driven)
    index = [machine.names.index(name) for name in joints]
    low, high = (machine.column(name)[index].astype(np.float32) for name in ("q_min", "q_max"))
    fastest = machine.q_dot_max[index].astype(np.float32)
    middle = np.stack([(low + high) / 2, 0 * low, 0 * low], axis=1)
    spread = np.repeat(np.float32([0.5, 0.2, 0.4]), machine.history)
    return replace(
        random_net(rng, len(joints), machine.history),
        joints=joints,
        rate=machine.rate,
        velocity_samples=machine.velocity_samples,
        machine=machine.name,
        training={},
        input_mean=middle.repeat(machine.history, axis=1),
        input_scale=np.tile(spread, (len(joints), 1)),
        output_low=np.float32(-1.1) * fastest,
        output_high=np.float32(1.2) * fastest,
    )


def obedient_net(machine):
    """Nets whose velocity depends on the newest command u alone, a sigmoid of 3 u."""
    net = small_net(machine, np.random.default_rng(0))
    weights = [np.zeros_like(weight) for weight in net.weights]
    weights[0][:, -1, 0], weights[1][:, 0] = 1.0, 2.0  # u + 2, never cut by the ReLU
    weights[2][:, 0, 0] = 1.0
    weights[4][:, 0, 0], weights[5][:, 0] = 3.0, -6.0  # 3 u
    scale, mean = np.ones_like(net.input_scale), np.zeros_like(net.input_mean)
    return replace(
        net, weights=tuple(weights), input_mean=mean, input_scale=scale, output_low=-net.output_high
    )


def constant_net(velocity, joints, rows=3):
    """Nets that say `velocity` whatever they see: no weights, sigmoid(0) = 1/2, the middle."""
    middle = np.array(velocity, np.float32)
    net = random_net(n=len(velocity), rows=rows)
    return replace(
        net,
        joints=joints,
        weights=tuple(np.zeros_like(w) for w in net.weights),
        output_low=middle - 1,
        output_high=middle + 1,
    )


def numbered_history() -> np.ndarray:
    """A history (5, 3, 13) of the Brokk in which every number differs."""
    joint, lag = np.arange(5)[:, None], np.arange(13)
    q = POSE[:, None] + 0.01 * (lag - 12)
    q_dot = 0.02 * joint + 0.001 * lag
    u = -0.1 * joint + 0.002 * lag
    return np.stack([q, q_dot, u], axis=1).astype(np.float32)


def steady(q, v_goal, q_dot=0.0, u=0.0, machine: Machine = BROKK_170) -> Measured:
    """Measurements without noise of machines (num, n) in steady motion at `q_dot`."""
    q = np.atleast_2d(np.asarray(q, float))
    history = np.zeros((*q.shape, 3, machine.history))
    history[..., 1, :] = np.broadcast_to(q_dot, q.shape)[..., None]
    ticks = np.arange(1 - machine.history, 1)
    history[..., 0, :] = q[..., None] + history[..., 1, :] * machine.dt * ticks
    history[..., 2, :] = u
    return measure(machine, history, np.broadcast_to(np.asarray(v_goal, float), (len(q), 3)))


def opened(opening: np.ndarray, up: float = 0.07, down: float = 0.07) -> np.ndarray:
    """Counts by hand: dead zone, then the opening, in whole counts up to 80."""
    zone = np.where(opening > 0, up, down)
    counts = np.rint(127 * np.sign(opening) * (zone + (1 - zone) * np.abs(opening)))
    return np.clip(counts, -80, 80)


def line(name, start, slope, ticks, u=0.5):
    q = np.full((ticks, 1), start) + slope * np.arange(ticks)[:, None] / 20
    return Recording(name, np.full((ticks, 1), u), q, velocity_of(q, 4))


def simple_system(seed, recordings, ticks=300):
    """Two first-order joints, q_ddot = (gain u - q_dot) / tau, turned back at +-0.8 rad."""
    rng = np.random.default_rng(seed)
    gain, tau, shape = np.array([0.5, 1.0]), np.array([0.15, 0.3]), (recordings, 2)
    q, q_dot = rng.uniform(-0.5, 0.5, shape), np.zeros(shape)
    u_log, q_log = np.zeros((2, ticks, *shape))
    for tick in range(ticks):
        if tick % 8 == 0:
            u = np.where(np.abs(q) > 0.8, -np.sign(q) * 0.6, rng.uniform(-1, 1, shape))
        u_log[tick], q_log[tick] = u, q
        for _ in range(10):
            q, q_dot = q + 0.005 * q_dot, q_dot + 0.005 * (gain * u - q_dot) / tau
    parts = zip(u_log.swapaxes(0, 1), q_log.swapaxes(0, 1), strict=True)
    result = [Recording(f"r{i}", u, q, velocity_of(q, 4)) for i, (u, q) in enumerate(parts)]
    return Log(("boom", "stick"), tuple(result))


def is_replay(recording, plant, start):
    """Does a plant have the recorded angles under the recorded commands?"""
    state = plant.reset(BROKK_170, start)
    for u, q in zip(recording.u, recording.q, strict=True):
        np.testing.assert_allclose(q, read_encoder(BROKK_170, state.q), atol=1e-9)
        state = plant.step(BROKK_170, state, u)


def closed_form(q):
    """Tool position [m] of the Brokk in closed form, and the height of its lowest link end."""
    q1, e2 = q[..., 0], q[..., 1]
    e3 = e2 + q[..., 2]
    e4 = e3 + q[..., 3] - np.pi
    e5 = e4 + q[..., 4] - 3 * np.pi / 4
    r, z, heights = 0.25, 0.95, [0.95 + 0 * q1]
    for length, e in zip((1.15, 1.25, 1.15, 1.20), (e2, e3, e4, e5), strict=True):
        r, z = r + length * np.cos(e), z + length * np.sin(e)
        heights.append(z)
    return np.stack([r * np.cos(q1), r * np.sin(q1), z], -1), np.min(heights, axis=0)


def pids(machine, net):
    """All baselines with gains that take no trials."""
    one, n = np.ones(1), np.ones(len(machine.driven))
    pid = Gains(1.0 * n, 8.0 * n, 0.05 * n, 0.4 * one)
    names = (baselines.RAW, baselines.BY_HAND, baselines.OPTIMISED)
    more = 0.015 * one, 1.0 * one, 2.0 * one, 0.26 * one
    strong = StrongGains(0.2 * n, 0.5 * n, 0.02 * n, 0.1 * one, *more)
    return baselines.baselines(
        machine, net, dict.fromkeys(names, pid) | {baselines.STRONGEST: strong}
    )


def short_axes(ticks, before=0):
    """Sequences along x, y and z of so many ticks, from `before` ticks before the first motion."""
    axes = sequences.axis_sequences(BROKK_170)
    first = [np.flatnonzero(axis.goals.any(axis=1))[0] - before for axis in axes]
    return [axis._replace(goals=axis.goals[i : i + ticks]) for i, axis in zip(first, axes)]


def one_by_one(calls, needs=None, scheduler=None):
    """`jobs.side_by_side` in this process."""
    done = {}
    for name, call in calls.items():
        done[name] = call(*(done[other] for other in (needs or {}).get(name, ())))
    return done
