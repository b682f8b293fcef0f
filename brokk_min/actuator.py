"""The hydraulic actuators twice: the analytic plant that plays the machine, and the nets that learn it.

The plant's equations are known to `plant_step`, the tests and the evaluation; the learner sees logs alone.
Both are driven the same way, one tick of 1/rate seconds at a time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from brokk_min.logs import RETURN, Log, Recording, load_arrays, velocity_of, whole_file
from brokk_min.machine import PWM_MAX, Machine, estimate_velocity, limit_command, read_encoder

Array = NDArray[np.floating[Any]]
FORMAT = 1  # of net files
HORIZONS = (1, 5, 10, 30)  # s, of the free-run scores
STILL = 0.002  # rad, assumed: little more than a step of a 12-bit encoder
MAX_RETURN = 300.0  # s, assumed: a way back to the start that takes longer is broken off


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n); `pending` are commands on their way."""

    q: Array  # rad
    speed: Array  # cylinder speed, m/s
    spool: Array  # -1..1
    ready: Array  # 0..1
    pending: tuple[Array, ...]  # the newest commands not yet through, newest first


def plant_reset(machine: Machine, q: ArrayLike) -> PlantState:
    """The plant at rest at angles `q` [rad] (..., n)."""
    q = np.array(q, float)
    zero = np.zeros_like(q)
    ticks = np.ceil(round(machine.delay / machine.plant_dt) / round(machine.dt / machine.plant_dt))
    return PlantState(q, zero, zero, zero, (zero,) * int(ticks))


def lever_arm(machine: Machine, q: ArrayLike) -> Array:
    """Distance from pivot to cylinder axis [m] at angles `q` [rad] (..., n). Paper: eq1 (r)

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> lever_arm(BROKK_170, [0.0, 0.5, 0.5, 1.7, 1.0]).round(3)
        array([0.15 , 0.337, 0.299, 0.247, 0.197])
    """
    base, rod = machine.column("cylinder_base"), machine.column("cylinder_rod")
    angle = np.asarray(q) + machine.column("cylinder_angle")
    length = np.sqrt(base**2 + rod**2 - 2 * base * rod * np.cos(angle))
    arm: Array = np.where(base > 0, base * rod * np.sin(angle) / length, rod)
    return arm


def plant_step(machine: Machine, state: PlantState, u: ArrayLike) -> PlantState:
    """One tick of the analytic plant under the held command `u` [-1, 1] (..., n), by explicit Euler steps.

    Spool with dead zone, readiness of an idle valve, shared pump flow, cylinder speed, lever arm. A
    command reaches the valve after `machine.delay`.

    Paper: eq1 and Sec. 3.2 (range, direction, coupling, past movement)
    """
    m, dt = machine, machine.plant_dt
    q, speed, spool, ready, _ = state
    commands = (np.array(u, float), *state.pending)  # a copy: it outlives the call
    up, down = m.column("speed_positive"), m.column("speed_negative")
    q_min, q_max, area = m.column("q_min"), m.column("q_max"), m.column("cylinder_area")
    steps, lag = round(m.dt / dt), round(m.delay / dt)
    for i in range(steps):
        a = commands[-((i - lag) // steps)]
        opening = np.sign(a) * np.maximum(0.0, (np.abs(a) - m.dead_zone) / (1 - m.dead_zone))
        gate = np.clip((ready - m.ready_threshold) / (1 - m.ready_threshold), 0.0, 1.0)
        gate = np.sqrt(gate * gate * (3 - 2 * gate))  # 0 up to the threshold: smoothstep(0) = 0
        demand = np.where(spool > 0, up, down) * spool * gate
        flow = np.sum(np.abs(area * demand), axis=-1, keepdims=True)
        supply = np.minimum(1.0, m.pump_flow / np.maximum(flow, 1e-12))
        target = np.abs(spool) > m.spool_idle
        rate = np.where(target > ready, m.ready_up_time, m.ready_down_time)
        q_next = q + dt * speed / lever_arm(m, q)
        speed = speed + dt * (demand * supply - speed) / m.cylinder_time
        spool, ready = (spool + dt * (opening - spool) / m.spool_time, ready + dt * (target - ready) / rate)
        q = np.clip(q_next, q_min, q_max)
        outward = ((q >= q_max) & (speed > 0)) | ((q <= q_min) & (speed < 0))
        speed = np.where(outward, 0.0, speed)
    return PlantState(q, speed, spool, ready, commands[: len(state.pending)])


def plant_velocity(machine: Machine, state: PlantState) -> Array:
    """Joint velocity [rad/s] (..., n) of the plant. Paper: eq1."""
    return state.speed / lever_arm(machine, state.q)


def speed_limits(machine: Machine, q: ArrayLike) -> tuple[Array, Array]:
    """Fastest negative and positive velocity [rad/s] (..., n) that a joint alone can hold at angles `q`.

    At the command limit. Paper: eq1
    """
    opening = (machine.pwm_limit / PWM_MAX - machine.dead_zone) / (1 - machine.dead_zone)
    arm = lever_arm(machine, q)
    speeds = -machine.column("speed_negative"), machine.column("speed_positive")
    down, up = (opening * speed / arm for speed in speeds)
    return down, up


# --- excitation: how the machine is made to show what it does -------------------------------------


def sine_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """One sine of random amplitude (dead zone to limit) and frequency, (ticks,). Paper: Sec. 3.3."""
    amplitude = rng.uniform(machine.dead_zone, machine.pwm_limit / PWM_MAX)
    frequency, phase = rng.uniform(0.02, 0.5), rng.uniform(0, 2 * np.pi)
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * machine.dt * np.arange(ticks) + phase))


def rich_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """Sines over a wide band, steps, fast random holds, stop and go out of rests; small noise, (ticks,).

    Steps last up to 10 s, so that joints also run through to their stops. Levels are drawn up to a third
    above the limit: cut there, a quarter are at the limit, as a policy's.
    """
    limit, idle = 4 / 3 * machine.pwm_limit / PWM_MAX, 5 * machine.ready_down_time
    parts: list[Array] = []
    while sum(map(len, parts)) < ticks:
        kind = rng.choice(["sine", "step", "holds", "go"], p=[0.25, 0.15, 0.25, 0.35])
        length = int(rng.uniform(0.5, 10.0 if kind == "step" else 4.0) / machine.dt)
        time = machine.dt * np.arange(length)
        amplitude = rng.uniform(machine.dead_zone, limit)
        if kind == "sine":
            frequency = np.exp(rng.uniform(np.log(0.05), np.log(4.0)))
            part = rng.uniform(-0.3, 0.3) * limit + amplitude * np.sin(
                2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi)
            )
        elif kind == "step":
            part = np.full(length, rng.choice([-1, 1]) * amplitude)
        elif kind == "holds":
            hold = int(rng.integers(1, 8))
            part = np.repeat(rng.uniform(-limit, limit, length // hold + 1), hold)[:length]
        else:  # out of rests, in half of the cases with a restless hand within the dead zone
            part = rng.choice([0, 1]) * rng.uniform(0, machine.dead_zone) * rng.uniform(-1, 1, length)
            at = 0
            while at < length:
                rest = np.exp(rng.uniform(np.log(0.05), np.log(3.0)))
                at += int((idle if rng.random() < 0.5 else rest) / machine.dt)
                move = int(rng.uniform(0.1, 1.0) / machine.dt)
                part[at : at + move] = rng.uniform(-limit, limit)
                at += move
        if kind != "go" and rng.random() < 0.5:
            part = part + rng.uniform(0, 0.08) * rng.standard_normal(length)
        parts.append(part)
    return np.concatenate(parts)[:ticks]


EXCITATIONS = {"sine": sine_command, "rich": rich_command}


class _Recorder:
    """The plant as a log sees it: commands in, encoder angles out, (rows, n) each tick, all kept."""

    def __init__(self, machine: Machine, q: Array) -> None:
        self.machine, self.state = machine, plant_reset(machine, q)
        self.u: list[Array] = []
        self.q = [read_encoder(machine, q)]  # one more than commands: the newest angle is not logged yet

    def play(self, u: Array) -> None:
        """One tick under the wanted commands `u`."""
        self.u.append(limit_command(self.machine, u))
        self.state = plant_step(self.machine, self.state, self.u[-1])
        self.q.append(read_encoder(self.machine, self.state.q))

    def recording(self, name: str, row: int, start: int = 0, end: int | None = None) -> Recording:
        """Ticks `start` to `end` of one row, with estimated velocities."""
        end = len(self.u) if end is None else end
        u, q = (np.array([tick[row] for tick in tape[start:end]]) for tape in (self.u, self.q))
        return Recording(name, u, q, velocity_of(q, self.machine.velocity_samples, self.machine.rate))


def collect(
    machine: Machine, hours: float, excitation: str, rng: np.random.Generator, leg_s: float = 30.0
) -> Log:
    """Record the analytic plant, one actuator at a time, `hours` for each, ways back not counted.

    A recording starts with `history` samples of an idle valve, then drives for `leg_s` or until the joint
    meets its limit; in rich excitation it may push there for a second in all. The way back to its start,
    and the rest there until the valve is idle, is named `..._return` and dropped by `read_log`. The
    paper's sines start at home (mid range), rich excitation at random angles. Paper: Sec. 3.3
    """
    if excitation not in EXCITATIONS:
        raise ValueError(f"excitation: expected one of {list(EXCITATIONS)}, got {excitation!r}")
    if not 0 < hours < np.inf:
        raise ValueError(f"hours: expected above 0, got {hours}")
    wanted = max(machine.history + 2, round(hours * 3600 * machine.rate))  # samples of each joint
    side_by_side = int(np.clip(wanted // 300, 1, 100))
    counted = np.zeros(machine.n, int)
    recordings: list[list[Recording]] = [[] for _ in machine.joints]
    with tqdm(total=wanted * machine.n, desc=f"record ({excitation})", unit="sample", disable=None) as bar:
        while counted.min() < wanted:
            joint = np.repeat(np.flatnonzero(counted < wanted), side_by_side)
            recorder, back, home = _drive_legs(machine, joint, excitation, rng, round(leg_s * machine.rate))
            for row, j in enumerate(joint):
                if leg := min(back[row], wanted - counted[j]):
                    name = f"{machine.names[j]}_{len(recordings[j]) // 2:03d}"
                    recordings[j].append(recorder.recording(name, row, 0, leg))
                    recordings[j].append(recorder.recording(name + RETURN, row, back[row], home[row]))
                    counted[j] += leg
                    bar.update(leg)
    kept = tuple(recording for of_joint in recordings for recording in of_joint)
    return Log(machine.names, kept, rate=machine.rate)


def _drive_legs(
    machine: Machine, joint: NDArray[np.intp], excitation: str, rng: np.random.Generator, ticks: int
) -> tuple[_Recorder, NDArray[np.intp], NDArray[np.intp]]:
    """Drive joint `joint[k]` of row k until it meets its limit or `ticks` are over, then back to its start.

    Returns:
        What was recorded, and the ticks (rows,) at which the ways back begin and end.
    """
    low, high, row = machine.column("q_min"), machine.column("q_max"), np.arange(len(joint))
    q = np.tile((low + high) / 2, (len(row), 1))
    low, high = low[joint], high[joint]
    if excitation == "rich":  # a tenth of the legs begins at either stop
        past = (high - low) / 8
        q[row, joint] = np.clip(rng.uniform(low - past, high + past), low, high)
    start, near, length = q[row, joint], 2 * machine.encoder_step, machine.history + ticks
    commands = np.zeros((len(row), length))
    commands[:, machine.history :] = [EXCITATIONS[excitation](rng, machine, ticks) for _ in row]
    slow = (machine.dead_zone + machine.pwm_limit / PWM_MAX) / 2
    rest = round(5 * machine.ready_down_time * machine.rate)  # ticks until a valve is idle again
    back = np.full(len(row), length)  # tick at which each way back begins
    rested = np.zeros(len(row), int)  # ticks at rest after it
    met = np.zeros(len(row), int)  # ticks at a limit
    push = machine.rate * (excitation == "rich")  # allowed ones
    recorder = _Recorder(machine, q)
    while rested.min() < rest and len(recorder.u) < length + MAX_RETURN * machine.rate:
        tick, angle = len(recorder.u), recorder.q[-1][row, joint]
        at_limit = (angle < low + near) | (angle > high - near)
        met += at_limit
        back[at_limit & (met > push) & (machine.history + machine.rate < tick) & (tick < back)] = tick
        arrived = (np.abs(angle - start) < max(0.06, near)) | (rested > 0)
        rested += arrived & (tick >= back)
        homeward = np.where(arrived, 0.0, slow * np.sign(start - angle))
        u = np.zeros_like(q)
        u[row, joint] = np.where(tick < back, commands[:, min(tick, length - 1)], homeward)
        recorder.play(u)
    return recorder, back, len(recorder.u) - rested + rest


# --- history: what the nets, the policy and the hardware remember of the last 13 samples -----------


def rest_history(q: ArrayLike, samples: int) -> Array:
    """History of a joint that stood still at `q` [rad] (..., n): shape (..., n, 3, samples).

    Rows: angle [rad], velocity [rad/s], command [-1, 1]; newest sample last. The newest command is
    the one sent a tick before the newest angle was measured. Paper: Table 1

    Example:
        >>> rest_history(np.array([0.5, 1.0]), 3)[1]
        array([[1., 1., 1.],
               [0., 0., 0.],
               [0., 0., 0.]])
    """
    q = np.asarray(q)
    history = np.zeros((*q.shape, 3, samples), q.dtype)
    history[..., 0, :] = q[..., None]
    return history


def push_command(history: Array, u: ArrayLike) -> Array:
    """History (..., n, 3, H) and the command `u` (..., n) of this tick: the nets' input. Paper: Table 1"""
    result = history.copy()
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def push_angle(history: Array, q: ArrayLike, velocity: Callable[[Array], Array]) -> Array:
    """History (..., n, 3, H) of `push_command` with the next measured angle `q` (..., n) appended.

    `velocity` turns the angles in the history (..., n, H) into the newest velocity (..., n) [rad/s].
    """
    result = history.copy()
    result[..., :2, :-1] = history[..., :2, 1:]
    result[..., 0, -1] = q
    result[..., 1, -1] = velocity(result[..., 0, :])
    return result


# --- nets -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ActuatorNet:
    """One small net a joint, run in NumPy: history in, mean velocity over the coming tick out.

    Paper: Table 1 and Sec. 3.3 (39 inputs, two hidden layers of 32, ReLU, sigmoid output)

    Weights are stacked over joints: (n, 3 H, 32), (n, 32), (n, 32, 32), (n, 32), (n, 32, 1), (n, 1).
    """

    joints: tuple[str, ...]
    history: int  # H, samples of q, q_dot and u
    rate: float  # Hz
    velocity_samples: int  # window of the velocity estimator that made the inputs
    velocity_logged: bool  # trained on q_dot columns of a log instead
    machine: str  # name of the machine, or of the log
    seed: int
    settings: dict[str, float]
    input_mean: Array  # (n, 3 H)
    input_scale: Array  # (n, 3 H)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
    q_low: Array  # (n,) rad, smallest angle of the training log: the simulation stops there
    q_high: Array  # (n,) rad
    weights: tuple[Array, ...]

    def select(self, joints: Sequence[str]) -> ActuatorNet:
        """The same nets for some joints, in the order given.

        Raises:
            ValueError: a joint without a net.
        """
        if not set(joints) <= set(self.joints):
            raise ValueError(f"joints: expected nets for {list(joints)}, got {list(self.joints)}")
        index = [self.joints.index(name) for name in joints]
        arrays = {name: getattr(self, name)[index] for name in _NET_ARRAYS}
        weights = tuple(weight[index] for weight in self.weights)
        return replace(self, joints=tuple(joints), weights=weights, **arrays)

    def predict(self, history: Array) -> Array:
        """Mean velocity over the coming tick [rad/s] (..., n), so that q(t+dt) = q(t) + dt * velocity.

        `history` is what `push_command` left, (..., n, 3, H). A joint that had no command and moved less than
        `STILL` during all of it stands, where a net alone would creep.
        """
        still = ~history[..., 2, :].any(axis=-1) & (np.abs(history[..., 0, -1] - history[..., 0, 0]) < STILL)
        velocity = self.velocity(history)
        velocity[still] = 0.0
        return velocity

    def velocity(self, history: Array) -> Array:
        """What the nets alone say, as `predict`."""
        return self._layers(history)[0]

    def slope(self, history: Array) -> tuple[Array, Array]:
        """What the nets alone say, and its derivative by the history, (..., n, 3, H)."""
        velocity, fraction, second, first = self._layers(history)
        w1, _, w2, _, w3, _ = self._folded
        by = (self.output_high - self.output_low)[:, None, None] * fraction * (1 - fraction)
        by = by @ w3.swapaxes(1, 2) * (second > 0)
        by = by @ w2.swapaxes(1, 2) * (first > 0)
        return velocity, (by @ w1.swapaxes(1, 2)).swapaxes(0, 1).reshape(history.shape)

    def _layers(self, history: Array) -> tuple[Array, ...]:
        """Velocity as `velocity`, then what the layers say, (n, batch, units), the last first."""
        n, inputs = len(self.joints), 3 * self.history
        if history.shape[-3:] != (n, 3, self.history):
            raise ValueError(f"history: expected (..., {n}, 3, {self.history}), got {history.shape}")
        x = history.reshape(-1, n, inputs).swapaxes(0, 1)  # (n, batch, 3 H)
        w1, b1, w2, b2, w3, b3 = self._folded
        first = np.maximum(x @ w1 + b1, 0)
        second = np.maximum(first @ w2 + b2, 0)
        fraction = 1 / (1 + np.exp(-(second @ w3 + b3)))
        low, high = self.output_low[:, None], self.output_high[:, None]
        velocity: Array = (low + (high - low) * fraction[..., 0]).T
        return velocity.reshape(history.shape[:-2]), fraction, second, first

    @cached_property
    def _folded(self) -> tuple[Array, ...]:
        """Weights with the normalisation of the inputs folded into the first layer."""
        w1, b1, w2, b2, w3, b3 = self.weights
        scaled = w1 / self.input_scale[..., None]
        shift = b1 - np.einsum("ni,nih->nh", self.input_mean, scaled)
        return scaled, shift[:, None], w2, b2[:, None], w3, b3[:, None]

    def step(self, history: Array, q: Array, u: ArrayLike) -> tuple[Array, Array]:
        """One tick of the simulation: history (..., n, 3, H), angle and command (..., n) -> the next.

        No joint goes further than it went in training.
        """
        history = push_command(history, u)
        predicted = self.predict(history)
        free, before = q + predicted / self.rate, q
        q = np.clip(free, np.minimum(q, self.q_low), np.maximum(q, self.q_high))

        def velocity(angles: Array) -> Array:
            if self.velocity_logged:
                return np.where(q == free, predicted, (q - before) * self.rate)
            return estimate_velocity(angles, self.velocity_samples, 1 / self.rate)

        return push_angle(history, q, velocity), q


_NET_ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")


def net_arrays(net: ActuatorNet) -> dict[str, Any]:
    """Nets as named arrays, a JSON header among them: what a file holds."""
    plain = {f.name: getattr(net, f.name) for f in fields(net) if f.name not in (*_NET_ARRAYS, "weights")}
    text = json.dumps({"format": FORMAT, "kind": "actuator net", **plain})
    arrays = {name: getattr(net, name) for name in _NET_ARRAYS}
    arrays |= {f"weight_{i}": weight for i, weight in enumerate(net.weights)}
    return {"header": np.array(text), **arrays}


def fingerprint(net: ActuatorNet) -> str:
    """Hash of the nets, header and all: what was trained or tuned with them says so by it."""
    digest = hashlib.sha256()
    for name, array in net_arrays(net).items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def net_from_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> ActuatorNet:
    """Nets from `net_arrays`; ValueError, naming `path`, for another format or arrays that do not fit."""
    header = load_header(path, arrays, "actuator net", FORMAT)
    try:
        header["joints"] = tuple(header["joints"])
        weights = tuple(arrays[f"weight_{i}"] for i in range(6))
        header |= {name: arrays[name] for name in _NET_ARRAYS}
        net = ActuatorNet(**header, weights=weights)
        n, inputs, hidden = len(net.joints), 3 * net.history, weights[0].shape[-1]
        wanted = [(n, inputs, hidden), (n, hidden), (n, hidden, hidden), (n, hidden), (n, hidden, 1), (n, 1)]
        wanted += [(n, inputs), (n, inputs), (n,), (n,), (n,), (n,)]
        found = [array.shape for array in (*weights, *(arrays[name] for name in _NET_ARRAYS))]
        if found != wanted:
            raise ValueError(f"shapes {found} instead of {wanted}")
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a complete actuator net, got {error!r}") from error
    return net


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    with whole_file(path) as file:
        np.savez(file, **net_arrays(net))


def load_net(path: Path) -> ActuatorNet:
    """Read nets that `save_net` wrote; ValueError as in `net_from_arrays`."""
    return net_from_arrays(path, load_arrays(path))


def load_header(path: Path, arrays: dict[str, Any], kind: str, version: int) -> dict[str, Any]:
    """The JSON header of a file of ours, checked for kind and format version, without those two."""
    try:
        header = dict(json.loads(str(arrays["header"])))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a file with a JSON header, got {error!r}") from error
    got = header.pop("kind", None), header.pop("format", None)
    if got != (kind, version):
        raise ValueError(f"{path}: expected ({kind}, format {version}), got {got}")
    return header


@dataclass(frozen=True)
class FitConfig:
    """How the nets are fitted."""

    steps: int = 10000
    """Adam steps."""
    batch_size: int = 1024
    """Windows a joint in each step."""
    learning_rate: float = 4e-3
    """Of Adam at the start; falls to zero along a cosine, and again from a quarter for free runs."""
    noise: float = 0.1
    """Standard deviation of the noise on the velocity inputs, in units of the velocities' own."""
    hidden: int = 32
    """Units in each of the two hidden layers (paper: 32)."""
    history: int = 13
    """Samples of angle, velocity and command that the nets see (paper: 13)."""
    rollout: int = 8
    """Ticks that the nets run freely in the last third of the steps, which learn from that (paper: 1)."""


PAPER_RECIPE: dict[str, Any] = {"noise": 0.0, "rollout": 1}  # Sec. 3.3


def fit(log: Log, config: FitConfig, seed: int, velocity_samples: int, machine: str = "") -> ActuatorNet:
    """Fit one net a joint to a log. Paper: Sec. 3.3 (MSE, Adam)

    One-step errors first, then short free runs, in which a bias adds up while the noise of encoders does
    not. What `ActuatorNet.step` cuts off at a stop is no error: nets need not brake before it. The same
    `seed` gives the same bits on the same machine. `velocity_samples` is the window of the estimator that
    supplied the velocities of `log`, `machine` a name for the file.

    Raises:
        ValueError: a joint that never moves long enough to be learned.
    """
    training = training_set(log, config.history, config.rollout)
    estimator = None if log.velocity_logged else velocity_samples
    weights = _train(training, config, seed, estimator)
    return ActuatorNet(
        joints=log.joints,
        history=config.history,
        rate=log.rate,
        velocity_samples=velocity_samples,
        velocity_logged=log.velocity_logged,
        machine=machine,
        seed=seed,
        settings=asdict(config),
        weights=weights,
        **{name: getattr(training, name).astype(np.float32) for name in _NET_ARRAYS},
    )


def _train(training: TrainingSet, config: FitConfig, seed: int, estimator: int | None) -> tuple[Array, ...]:
    """Weights of all nets, one Adam step for all of them at a time; `estimator` as in `_rollout_loss`."""
    import torch

    n, inputs, hidden = *training.input_mean.shape, config.hidden
    generator = torch.Generator().manual_seed(seed)
    weights: list[torch.Tensor] = []
    for rows, columns in [(inputs, hidden), (hidden, hidden), (hidden, 1)]:
        bound = (6 / rows) ** 0.5  # He's uniform bound for ReLU
        weights.append((torch.rand(n, rows, columns, generator=generator) * 2 - 1) * bound)
        weights.append(torch.zeros(n, columns))
    for weight in weights:
        weight.requires_grad_()
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate)
    runs_free = config.rollout > 1 and all(map(len, training.far_ends))
    turn = round(0.65 * config.steps) if runs_free else config.steps

    def fall(step: int) -> float:
        done = step / turn if step < turn else (step - turn) / max(config.steps - turn, 1)
        return (0.5 if step < turn else 0.125) * (1 + float(np.cos(np.pi * done)))

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, fall)
    arrays = (training.series, training.target.T)
    tapes = [torch.tensor(array, dtype=torch.float32).flatten(-2) for array in arrays]  # joint after joint
    first = torch.arange(n)[:, None] * len(training.target)
    for step in tqdm(range(config.steps), desc="fit nets", unit="step", disable=None):
        far = step >= turn
        ends = training.far_ends if far else training.ends
        batch = -(-config.batch_size // 4) if far else config.batch_size
        picks = [torch.randint(len(end), (batch,), generator=generator) for end in ends]
        at = torch.tensor(np.stack([end[pick] for end, pick in zip(ends, picks, strict=True)])) + first
        ticks = config.rollout if far else 1
        loss = _rollout_loss(training, config, weights, tapes, at, ticks, estimator, generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    if not all(torch.isfinite(weight).all() for weight in weights):
        raise ValueError("weights: expected finite numbers at the end of the fit, got nan or inf")
    return tuple(weight.detach().numpy() for weight in weights)


def _rollout_loss(
    training: TrainingSet,
    config: FitConfig,
    weights: list[Any],
    tapes: list[Any],
    at: Any,
    ticks: int,
    estimator: int | None,
    generator: Any,
) -> Any:
    """Mean square of how far free runs from the windows that end `at` (n, batch) are off.

    After each tick, in units of the outputs' range and ticks: the error of the velocities so far, added up.
    A joint goes no further than its stops, as in `ActuatorNet.step`.

    Args:
        tapes: inputs (3, n N) and wanted velocities (n N,) [rad/s], joint after joint.
        estimator: samples of the velocity estimator; None: velocities are the nets' own outputs.
    """
    import torch

    series, target = tapes
    n, history = len(at), config.history
    mean, scale, low, high = (torch.tensor(array).float() for array in training[3:7])
    mean, scale = mean.reshape(n, 1, 3, history), scale.reshape(n, 1, 3, history)
    window = series.unfold(-1, history + ticks - 1, 1)[:, at - (history - 1)]  # (3, n, batch, H + ticks - 1)
    q, q_dot, u = window[0, ..., :history], window[1, ..., :history], window[2]
    if config.noise:
        shape = (*at.shape, history)
        noise = torch.randn(*shape, generator=generator) + torch.randn(*shape[:2], 1, generator=generator)
        q_dot = q_dot + config.noise * scale[:, :, 1] * noise
    stops = [torch.tensor(array).float()[:, None] for array in (training.q_low, training.q_high)]
    off, loss = torch.zeros(()), torch.zeros(())
    for k in range(ticks):
        x = (torch.stack([q, q_dot, u[..., k : k + history]], dim=2) - mean) / scale
        x = x.flatten(2)
        for i in (0, 2):
            x = torch.relu(torch.baddbmm(weights[i + 1][:, None], x, weights[i]))
        y = torch.sigmoid(torch.baddbmm(weights[5][:, None], x, weights[4]))[..., 0]
        room = [(stop - q[..., -1]) * training.rate for stop in stops]
        velocity = torch.clamp(low[:, None] + (high - low)[:, None] * y, *room)
        off = off + (velocity - target[at + k]) / (high - low)[:, None]
        loss = loss + (off**2).mean(dim=1).sum() / ticks
        if k + 1 < ticks:
            q = torch.cat([q[..., 1:], (q[..., -1] + velocity / training.rate)[..., None]], dim=-1)
            if estimator:
                eye, dt = np.eye(estimator), 1 / training.rate
                slope = torch.tensor(estimate_velocity(eye, estimator, dt)).float()
                velocity = (q[..., -estimator:] * slope).sum(dim=-1)
            q_dot = torch.cat([q_dot[..., 1:], velocity[..., None]], dim=-1)
    return loss


class TrainingSet(NamedTuple):
    """What models are fitted to: the windows of H samples of each joint, and their statistics."""

    series: Array  # (3, n, N): angle, velocity and command of all recordings, end to end
    target: Array  # (N, n) rad/s, see `end_to_end`
    ends: list[NDArray[np.intp]]  # newest samples of each joint's windows
    input_mean: Array  # (n, 3 H)
    input_scale: Array  # (n, 3 H)
    output_low: Array  # (n,) rad/s
    output_high: Array  # (n,) rad/s
    q_low: Array  # (n,) rad
    q_high: Array  # (n,) rad
    far_ends: list[NDArray[np.intp]]  # as `ends`, with `rollout` samples after them
    rate: float  # of the samples [Hz]


def training_set(log: Log, history: int, rollout: int = 1) -> TrainingSet:
    """Windows of the recordings in which a joint moves; its statistics are of those alone.

    Raises:
        ValueError: a joint that never moves long enough to be learned.
    """
    samples = end_to_end(log)
    every, far = (samples.starts(history - 1, ahead, 1) for ahead in (1, rollout))
    ends, far_ends = ([at[moves] for moves in samples.moves[at].T] for at in (every, far))
    for name, end, target in zip(log.joints, ends, samples.target.T, strict=True):
        if not len(end) or np.ptp(target[end]) == 0:
            raise ValueError(
                f"joint {name}: expected a recording of {history + 1} samples or more in which it "
                "moves, got none"
            )
    series = np.stack([samples.whole.q.T, samples.whole.q_dot.T, samples.whole.u.T])
    mean = np.array([series[:, j, end].mean(axis=1) for j, end in enumerate(ends)])
    scale = np.array([series[:, j, end].std(axis=1) for j, end in enumerate(ends)])
    scale = np.where(scale > 1e-9, scale, 1.0)  # a channel that never changes
    low = np.array([samples.target[end, j].min() for j, end in enumerate(ends)])
    high = np.array([samples.target[end, j].max() for j, end in enumerate(ends)])
    margin = 0.05 * (high - low) + 1e-6  # rad/s; never none, where a joint knows one speed
    low, high = low - margin, high + margin
    mean, scale = np.repeat(mean, history, axis=1), np.repeat(scale, history, axis=1)
    ranges = samples.whole.q.min(axis=0), samples.whole.q.max(axis=0)
    return TrainingSet(series, samples.target, ends, mean, scale, low, high, *ranges, far_ends, log.rate)


class Samples(NamedTuple):
    """The recordings of a log end to end, N samples in all; windows must not cross their seams."""

    whole: Recording
    target: Array  # (N, n), see `end_to_end`
    moves: NDArray[np.bool_]  # (N, n): in a recording in which the joint moves or is commanded
    lengths: list[int]  # of the recordings

    def starts(self, before: int, after: int, step: int) -> NDArray[np.intp]:
        """Every `step`-th sample of each recording with `before` samples before and `after` after it."""
        seams = np.cumsum([0, *self.lengths])
        pieces = zip(seams, self.lengths, strict=False)
        return np.concatenate([seam + np.arange(before, length - after, step) for seam, length in pieces])


def end_to_end(log: Log) -> Samples:
    """Join recordings, with what a net is to say at each sample.

    That is the mean velocity [rad/s] over the coming tick, (q(t+dt) - q(t)) / dt, from encoder angles;
    where the log has velocities of its own, q_dot(t+dt). The last sample of a recording has none.
    """
    kinds = ([getattr(r, kind) for r in log.recordings] for kind in Recording._fields[1:])
    whole = Recording("", *(np.concatenate(arrays) for arrays in kinds))
    if log.velocity_logged:
        target = np.roll(whole.q_dot, -1, axis=0)
    else:
        target = np.diff(whole.q, axis=0, append=0) * log.rate
    lengths = [len(r.q) for r in log.recordings]
    moves = [np.ptp(r.u, axis=0) + np.ptp(r.q, axis=0) > 0 for r in log.recordings]
    return Samples(whole, target, np.repeat(moves, lengths, axis=0), lengths)


class LinearModel(ActuatorNet):
    """A linear model of the nets' inputs within the nets' range: what a net must beat.

    Weights (n, 3 H) and (n,), for standardised inputs.
    """

    def velocity(self, history: Array) -> Array:
        """What the model says, as `ActuatorNet.predict`."""
        x = history.reshape(*history.shape[:-2], -1)
        slope, offset = self.weights
        velocity = (((x - self.input_mean) / self.input_scale) * slope).sum(axis=-1) + offset
        return np.asarray(np.clip(velocity, self.output_low, self.output_high))


def fit_linear(net: ActuatorNet, log: Log, penalty: float = 1e-3) -> LinearModel:
    """Ridge regression on the inputs, targets and recordings that `net` was fitted to.

    Args:
        penalty: on squared weights, in units of the mean squared error of standardised inputs.
    """
    training, history = training_set(log, net.history), net.history
    slopes, offsets = [], []
    for j, ends in enumerate(training.ends):
        size = 3 * history + 1
        gram, moment = np.zeros((size, size)), np.zeros(size)
        for chunk in np.array_split(ends, -(-len(ends) // 8192)):  # bounds the memory
            x = training.series[:, j, chunk[:, None] + np.arange(1 - history, 1)].swapaxes(0, 1)
            x = (x.reshape(len(chunk), -1) - training.input_mean[j]) / training.input_scale[j]
            x = np.column_stack([x, np.ones(len(chunk))])
            gram, moment = gram + x.T @ x, moment + x.T @ training.target[chunk, j]
        ridge = penalty * len(ends) * np.eye(size)
        ridge[-1, -1] = 0.0  # the offset is free
        *slope, offset = np.linalg.solve(gram + ridge, moment)
        slopes.append(slope)
        offsets.append(offset)
    header = {f.name: getattr(net, f.name) for f in fields(net)} | {"settings": {"penalty": penalty}}
    return LinearModel(**header | {"weights": (np.array(slopes, np.float32), np.array(offsets, np.float32))})


# --- scores ---------------------------------------------------------------------------------------


def free_run(
    net: ActuatorNet, recording: Recording, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Run the nets on their own predictions under the recorded commands.

    Each segment of `ticks` begins at one of the samples `starts` (s,), with H samples or more before it.

    Returns:
        Angle [rad] and velocity [rad/s] after each tick, (ticks, s, n) both.
    """
    rows = starts[:, None] + np.arange(1 - net.history, 1)
    history = np.stack([recording.q[rows], recording.q_dot[rows], recording.u[rows - 1]])
    history = history.transpose(1, 3, 0, 2).astype(np.float32)  # (s, n, 3, H)
    q: Array = recording.q[starts]
    trace = []
    for k in range(ticks):
        history, q = net.step(history, q, recording.u[starts + k])
        trace.append((q, history[..., 1, -1]))
    angles, velocities = np.moveaxis(np.array(trace), 1, 0)
    return angles, velocities


def score(net: ActuatorNet, log: Log) -> dict[str, Any]:
    """One-step, persistence and free-run errors of nets on recordings, as in the fit JSON.

    Each joint is scored on the recordings in which it is commanded or moves. `one_step_rmse` is the error
    of the next tick's prediction from the recorded history against what the nets are fitted to: the mean
    velocity over that tick by the encoders, or the next velocity of a log that has velocities.
    `persistence_rmse` is the error of the newest velocity in that history against the same target.

    Free runs start every `horizon` seconds of each recording; `velocity_rmse` is over all their samples,
    between velocities as the history shows them (estimated or logged), `position_error_median` is the
    median over segments of |angle error| at their end.

    Raises:
        ValueError: joints or velocities of another kind than the nets', or no recording long enough.
    """
    if log.joints != net.joints:
        raise ValueError(f"joints: expected {list(net.joints)}, got {list(log.joints)}")
    if log.rate != net.rate:
        raise ValueError(f"rate: expected {net.rate:g} Hz, got {log.rate:g} Hz")
    if log.velocity_logged != net.velocity_logged:
        raise ValueError(f"velocity_logged: expected {net.velocity_logged}, got {log.velocity_logged}")
    samples = end_to_end(log)
    if not len(samples.starts(net.history, 1, 1)):
        got = samples.lengths[:9]
        raise ValueError(f"log: expected a recording above {net.history + 1} samples, got {got}")
    result: dict[str, Any] = {name: {"free_run": {}} for name in log.joints}
    for horizon in tqdm((1 / net.rate, *HORIZONS), desc="score nets", unit="horizon", disable=None):
        ticks = round(horizon * net.rate)
        starts = samples.starts(net.history, ticks, ticks)
        if not len(starts):
            continue
        q_error, v_error = run_errors(net, samples, starts, ticks)
        mine = samples.moves | ~samples.moves.any(axis=0)  # a joint that rests everywhere: at rest
        for j, scored in enumerate(mine[starts].T):
            if not scored.any():
                continue
            entry = result[log.joints[j]]
            if ticks == 1:
                error = v_error if net.velocity_logged else q_error * net.rate
                same = samples.whole.q_dot[starts, j] - samples.target[starts, j]
                entry |= {"one_step_rmse": _rms(error[0, scored, j]), "persistence_rmse": _rms(same[scored])}
            else:
                end = float(np.median(np.abs(q_error[-1, scored, j])))
                run = {"velocity_rmse": _rms(v_error[:, scored, j]), "position_error_median": end}
                entry["free_run"][str(horizon)] = run
    return result


def run_errors(
    net: ActuatorNet, samples: Samples, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Errors of angle [rad] and velocity [rad/s] in free runs from `starts` (s,), (ticks, s, n) both."""
    chunks = np.array_split(starts, -(-len(starts) // 8192))  # bounds the memory
    runs = [free_run(net, samples.whole, chunk, ticks) for chunk in chunks]
    angles, velocities = (np.concatenate(run, axis=1) for run in zip(*runs, strict=True))
    later = starts + np.arange(1, ticks + 1)[:, None]
    return angles - samples.whole.q[later], velocities - samples.whole.q_dot[later]


def recording_errors(net: ActuatorNet, log: Log, seconds: float) -> Array:
    """Velocity RMSE [rad/s] (recordings, n) of one free run of up to `seconds` from the start of each.

    nan: a joint that rests in this recording but not in all, or `history` + 1 samples or fewer.
    """
    samples, lengths = end_to_end(log), np.array([len(r.q) for r in log.recordings])
    ticks = np.minimum(lengths - net.history - 1, round(seconds * net.rate))  # of each run
    result = np.full((len(lengths), len(net.joints)), np.nan)
    if not (long := np.flatnonzero(ticks > 0)).size:
        return result
    starts, most = (np.cumsum(lengths) - lengths)[long] + net.history, int(ticks.max())
    tail = ((0, most), (0, 0))  # shorter runs go on into what follows, unscored
    whole = Recording("", *(np.pad(array, tail, mode="edge") for array in samples.whole[1:]))
    _, velocities = free_run(net, whole, starts, most)
    error = velocities - whole.q_dot[starts + np.arange(1, most + 1)[:, None]]
    scored = (np.arange(most)[:, None] < ticks[long])[..., None]
    rms = np.sqrt(np.sum(np.where(scored, error, 0.0) ** 2, axis=0) / ticks[long, None])
    moves = samples.moves | ~samples.moves.any(axis=0)  # a joint that rests everywhere is scored at rest
    result[long] = np.where(moves[starts], rms, np.nan)
    return result


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def task_log(
    machine: Machine, runs: int, seconds: float, rng: np.random.Generator, start: ArrayLike | None = None
) -> Log:
    """Recordings under commands like a policy's: reversals, small corrections, driven joints together.

    In every fifth recording the locked joints move instead: the machine lets them move only alone.
    Smoothed random levels held for 0.5 to 5 s, towards the nearer end of the range less often, so
    that the joints stay off their stops. For scoring only; no net is fitted to them. All begin at the
    angles `start` (n,), or each at random ones.
    """
    q_min, q_max = machine.column("q_min"), machine.column("q_max")
    shape, limit = (runs, machine.n), machine.pwm_limit / PWM_MAX
    drawn = rng.uniform(0.8 * q_min + 0.2 * q_max, 0.2 * q_min + 0.8 * q_max, shape)
    start = drawn if start is None else np.tile(start, (runs, 1))
    level, command, left = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    smoothing, noise = rng.uniform(0.05, 0.6, shape), rng.uniform(0, 0.06, shape)
    locked_turn = (np.arange(runs) % 5 == 4)[:, None]
    moving = np.isin(np.arange(machine.n), machine.locked) == locked_turn
    recorder = _Recorder(machine, start)
    for _ in range(round(seconds * machine.rate)):
        fraction = (recorder.q[-1] - q_min) / (q_max - q_min)
        up = rng.random(shape) > np.clip(1.5 * fraction - 0.25, 0, 1)
        drawn = np.where(up, 1, -1) * rng.uniform(0, limit, shape) * (rng.random(shape) < 0.85)
        near = np.where(up, fraction > 0.9, fraction < 0.1)
        level = np.where((left <= 0) | (near & (level * (2 * up - 1) > 0)), drawn, level)
        left = np.where(left <= 0, rng.uniform(0.5, 5.0, shape), left) - machine.dt
        command = command + smoothing * (level - command)
        jitter = noise * rng.standard_normal(shape) * (level != 0)
        recorder.play(moving * (command + jitter))
    return Log(
        machine.names, tuple(recorder.recording(f"task_{i:02d}", i) for i in range(runs)), rate=machine.rate
    )
