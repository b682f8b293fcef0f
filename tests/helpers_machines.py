"""Random machines, cheap actuator nets, a recording, scripted randomness and oracles for the tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.logs import Recording, velocity_of
from brokk_min.kinematics import forward_kinematics, jacobian
from brokk_min.machine import BROKK_170, Joint, Machine

GAIN = 3.0  # of `obedient_net`
POSE = np.array([1.5, 0.5, 0.58, 1.71, 1.24])  # the paper's q_s


def random_machine(rng: np.random.Generator, n: int) -> Machine:
    """A machine of `n` joints with at least one driven, far above the ground, of any geometry."""
    driven = rng.random(n) < 0.7
    driven[rng.integers(n)] = True
    joints = []
    for i in range(n):
        low, width = rng.uniform(-1.5, 0.5), rng.uniform(0.8, 2.0)
        slew = rng.random() < 0.3
        speed = rng.uniform(0.02, 0.1, 2)
        joints.append(
            Joint(
                name=f"axis_{i}",
                driven=bool(driven[i]),
                a=rng.uniform(0.1, 1.5),
                alpha=float(rng.choice([0.0, np.pi / 2, -np.pi / 2, 0.3])),
                d=rng.uniform(-0.2, 0.5),
                theta=rng.uniform(-np.pi, np.pi),
                q_min=low,
                q_max=low + width,
                cylinder_base=0.0 if slew else rng.uniform(0.5, 1.0),
                cylinder_rod=rng.uniform(0.15, 0.35),
                cylinder_angle=rng.uniform(0.3, 2.8 - width) - low,
                cylinder_area=0.005,
                speed_positive=speed[0],
                speed_negative=speed[1],
                q_dot_up=rng.uniform(0.1, 0.8),
                q_dot_down=rng.uniform(0.1, 0.8),
                encoder_node=i + 1,
            )
        )
    history = int(rng.integers(3, 14))
    return replace(
        BROKK_170,
        q_start=(),
        name=f"random{n}",
        joints=tuple(joints),
        history=history,
        velocity_samples=int(rng.integers(2, min(history, 5) + 1)),
        dead_zone=rng.uniform(0.0, 0.15),
        pwm_limit=int(rng.integers(40, 128)),
        delay=float(rng.choice([0.0, 0.02, 0.04, 0.12])),
        tool_speed=rng.uniform(0.1, 0.6),
        ground=-100.0,
    )


def small_net(
    machine: Machine, rng: np.random.Generator, joints: tuple[str, ...] = ()
) -> ActuatorNet:
    """Nets with random weights for `joints` (none: the driven ones): all inputs matter."""
    joints = joints or tuple(machine.names[i] for i in machine.driven)
    index = [machine.names.index(name) for name in joints]
    n, inputs = len(joints), 3 * machine.history
    middle = (machine.column("q_min") + machine.column("q_max"))[index] / 2
    fastest = machine.q_dot_max[index]
    mean, scale = np.zeros((n, 3, machine.history)), np.ones((n, 3, machine.history))
    mean[:, 0], scale[:, 0] = middle[:, None], 0.5
    scale[:, 1], scale[:, 2] = 0.2, 0.4
    weights = (
        rng.standard_normal((n, inputs, 32)) / inputs**0.5,
        0.1 * rng.standard_normal((n, 32)),
        rng.standard_normal((n, 32, 32)) / 32**0.5,
        0.1 * rng.standard_normal((n, 32)),
        rng.standard_normal((n, 32, 1)) / 4,
        0.1 * rng.standard_normal((n, 1)),
    )
    return ActuatorNet(
        joints=joints,
        history=machine.history,
        rate=machine.rate,
        velocity_samples=machine.velocity_samples,
        velocity_logged=False,
        machine=machine.name,
        seed=0,
        settings={},
        input_mean=mean.reshape(n, inputs).astype(np.float32),
        input_scale=scale.reshape(n, inputs).astype(np.float32),
        output_low=(-1.1 * fastest).astype(np.float32),
        output_high=(1.2 * fastest).astype(np.float32),
        q_low=machine.column("q_min")[index].astype(np.float32),
        q_high=machine.column("q_max")[index].astype(np.float32),
        weights=tuple(weight.astype(np.float32) for weight in weights),
    )


def obedient_net(machine: Machine) -> ActuatorNet:
    """Nets whose velocity depends on the newest command alone, see `obedient_velocity`."""
    net = small_net(machine, np.random.default_rng(0))
    weights = [np.zeros_like(weight) for weight in net.weights]
    weights[0][:, -1, 0], weights[1][:, 0] = 1.0, 2.0  # u + 2, never cut by the ReLU
    weights[2][:, 0, 0] = 1.0
    weights[4][:, 0, 0], weights[5][:, 0] = GAIN, -2.0 * GAIN
    scale, mean = np.ones_like(net.input_scale), np.zeros_like(net.input_mean)
    return replace(
        net, weights=tuple(weights), input_mean=mean, input_scale=scale, output_low=-net.output_high
    )


def obedient_velocity(machine: Machine, u: np.ndarray) -> np.ndarray:
    """What `obedient_net` says for commands `u` (..., n_driven), worked out by hand."""
    fastest = 1.2 * machine.q_dot_max[machine.driven]
    return fastest * (2 / (1 + np.exp(-GAIN * np.asarray(u, float))) - 1)


def damped_rates(machine: Machine, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Oracle of `joint_rates`: NumPy solves (J^T J + lambda^2 I) x = J^T v, lambda 6 % of the length."""
    J = jacobian(forward_kinematics(machine, np.asarray(q, float)))[..., machine.driven]
    damping = (0.06 * np.hypot(machine.column("a"), machine.column("d")).sum()) ** 2
    Jt = np.swapaxes(J, -1, -2)
    normal = Jt @ J + damping * np.eye(J.shape[-1])
    return np.linalg.solve(normal, (Jt @ np.asarray(v, float)[..., None]))[..., 0]


class RowRandom:
    """A generator with one source a row, so that a batch draws what its rows would draw alone.

    Right only where every draw is for all rows at once; it refuses any other.
    """

    def __init__(self, sources: list[np.random.Generator]) -> None:
        self.sources = sources

    def _rows(self, shape: int | tuple[int, ...]) -> tuple[int, ...]:
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        if shape[0] != len(self.sources):
            raise AssertionError(f"a draw for {shape[0]} of {len(self.sources)} rows")
        return (1, *shape[1:])

    def random(self, size: int | tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        return np.concatenate([s.random(self._rows(size), dtype) for s in self.sources])

    def standard_normal(self, size: int | tuple[int, ...]) -> np.ndarray:
        return np.concatenate([s.standard_normal(self._rows(size)) for s in self.sources])

    def integers(
        self, low: int, high: int, size: int | tuple[int, ...], dtype: type = np.int64
    ) -> np.ndarray:
        return np.concatenate(
            [s.integers(low, high, self._rows(size), dtype) for s in self.sources]
        )

    def uniform(self, low: float, high: float, size: int | tuple[int, ...]) -> np.ndarray:
        return np.concatenate([s.uniform(low, high, self._rows(size)) for s in self.sources])


def random_net(seed: int = 0, n: int = 3, history: int = 13, hidden: int = 32) -> ActuatorNet:
    rng = np.random.default_rng(seed)
    inputs = 3 * history

    def draw(*shape: int) -> np.ndarray:
        return (rng.standard_normal(shape) / shape[1] ** 0.5).astype(np.float32)

    return ActuatorNet(
        joints=tuple(f"j{i}" for i in range(n)),
        history=history,
        rate=20.0,
        velocity_samples=4,
        velocity_logged=False,
        machine="some",
        seed=seed,
        settings={"steps": 5},
        input_mean=rng.uniform(-1, 1, (n, inputs)).astype(np.float32),
        input_scale=rng.uniform(0.1, 2, (n, inputs)).astype(np.float32),
        output_low=rng.uniform(-0.6, -0.1, n).astype(np.float32),
        output_high=rng.uniform(0.1, 0.6, n).astype(np.float32),
        q_low=np.full(n, -2.0, np.float32),
        q_high=np.full(n, 2.0, np.float32),
        weights=(
            draw(n, inputs, hidden), draw(n, hidden), draw(n, hidden, hidden), draw(n, hidden),
            draw(n, hidden, 1), draw(n, 1),
        ),
    )  # fmt: skip


def constant_net(velocity: list[float], logged: bool, joints: tuple[str, ...]) -> ActuatorNet:
    """Nets that say `velocity` whatever they see: no weights, sigmoid(0) = 1/2, the middle."""
    middle = np.array(velocity, np.float32)
    net = random_net(n=len(velocity))
    return replace(
        net,
        joints=joints,
        velocity_logged=logged,
        weights=tuple(np.zeros_like(w) for w in net.weights),
        output_low=middle - 1,
        output_high=middle + 1,
        q_low=np.full(len(velocity), -1e3, np.float32),
        q_high=np.full(len(velocity), 1e3, np.float32),
    )


def line(name: str, start: float, slope: float, ticks: int, u: float = 0.5) -> Recording:
    q = np.full((ticks, 1), start) + slope * np.arange(ticks)[:, None] / 20
    return Recording(name, np.full((ticks, 1), u), q, velocity_of(q, 4))


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


def parts(machine, seen):
    """Observations cut up: goal (3), tool velocity (3), locked angles, histories (n, 3, H), two rates."""
    rest, driven, samples = len(machine.locked), len(machine.driven), machine.history
    cuts = np.cumsum([3, 3, rest, 2 * samples * driven, samples * driven, driven])
    assert seen.shape[-1] == cuts[-1] + driven
    goal, tool, angles, moving, sent, rates, late = np.split(seen, cuts, axis=-1)
    moving, sent = (a.reshape(*a.shape[:-1], driven, -1, samples) for a in (moving, sent))
    return goal, tool, angles, np.concatenate([moving, sent], axis=-2), rates, late
