"""The hydraulic actuators twice: the analytic plant that plays the machine, and the nets that learn it.

The plant is known only to this file's `Plant`, to the tests and to the evaluation; the learner sees logs
alone. Both are driven the same way, one tick of 1/rate seconds at a time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from brokk_min.logs import RATE, RETURN, Log, Recording, load_arrays, whole_file
from brokk_min.machine import Machine, estimate_velocity, limit_command, read_encoder

Array = NDArray[np.floating[Any]]
FORMAT = 1  # of net files
HORIZONS = (1, 5, 10, 30)  # s, of the free-run scores


class PlantState(NamedTuple):
    """State of the analytic plant, arrays (..., n); `pending` are commands on their way."""

    q: Array  # rad
    speed: Array  # cylinder speed, m/s
    spool: Array  # -1..1
    ready: Array  # 0..1
    pending: tuple[Array, ...]  # the newest commands not yet through, newest first


def plant_reset(machine: Machine, q: ArrayLike) -> PlantState:
    """The plant at rest at angles `q` [rad] (..., n).

    Example:
        >>> from brokk_min.machine import BROKK_170
        >>> plant_reset(BROKK_170, np.zeros((3, 5))).spool.shape
        (3, 5)
    """
    q = np.array(q, float)
    zero = np.zeros_like(q)
    ticks = -(-round(machine.delay / machine.plant_dt) // _substeps(machine))
    return PlantState(q, zero, zero, zero, (zero,) * ticks)


def _substeps(machine: Machine) -> int:
    return max(1, round(machine.dt / machine.plant_dt))


def lever_arm(machine: Machine, q: ArrayLike) -> Array:
    """Distance from pivot to cylinder axis [m] at angles `q` [rad] (..., n).

    Paper: eq1 (r)

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
    """One tick of the analytic plant under the held command `u`, by explicit Euler steps.

    Spool with dead zone, readiness of an idle valve, shared pump flow, cylinder speed, lever arm.

    Paper: eq1 and Sec. 3.2 (range, direction, coupling, past movement)

    Args:
        machine: parameters of the plant.
        state: before the tick, arrays (..., n).
        u: command in [-1, 1] of full, shape (..., n), reaching the valve after `machine.delay`.

    Returns:
        The state 1/rate seconds later.
    """
    m, dt = machine, machine.plant_dt
    q, speed, spool, ready, _ = state
    commands = (np.array(u, float), *state.pending)  # a copy: it outlives the call
    up, down = m.column("speed_positive"), m.column("speed_negative")
    q_min, q_max, area = m.column("q_min"), m.column("q_max"), m.column("cylinder_area")
    steps, lag = _substeps(m), round(m.delay / dt)
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
    """Steady joint velocities [rad/s] of the plant at the two command limits, (..., n) each.

    Args:
        machine: n joints.
        q: angles [rad], (..., n), on which the lever arms depend.

    Returns:
        Fastest negative and fastest positive velocity of a joint that moves alone. Paper: eq1
    """
    opening = (machine.pwm_limit / 127 - machine.dead_zone) / (1 - machine.dead_zone)
    arm = lever_arm(machine, q)
    speeds = -machine.column("speed_negative"), machine.column("speed_positive")
    down, up = (opening * speed / arm for speed in speeds)
    return down, up


# --- excitation: how the machine is made to show what it does -------------------------------------


def sine_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """One sine of random amplitude (dead zone to limit) and frequency, (ticks,). Paper: Sec. 3.3."""
    amplitude = rng.uniform(machine.dead_zone, machine.pwm_limit / 127)
    frequency, phase = rng.uniform(0.02, 0.5), rng.uniform(0, 2 * np.pi)
    return amplitude * np.sin(2 * np.pi * frequency * machine.dt * np.arange(ticks) + phase)


def rich_command(rng: np.random.Generator, machine: Machine, ticks: int) -> Array:
    """Sines over a wide band, held steps, fast random holds and pauses, small noise, (ticks,)."""
    limit = machine.pwm_limit / 127
    parts: list[Array] = []
    while sum(map(len, parts)) < ticks:
        length = int(rng.uniform(0.5, 4.0) / machine.dt)
        time = machine.dt * np.arange(length)
        kind = rng.choice(["sine", "step", "holds", "pause"], p=[0.3, 0.3, 0.25, 0.15])
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
        else:
            part = np.zeros(length)
        if kind != "pause" and rng.random() < 0.5:
            part = part + rng.uniform(0, 0.08) * rng.standard_normal(length)
        parts.append(part)
    return np.concatenate(parts)[:ticks]


Command = Callable[[np.random.Generator, Machine, int], Array]
EXCITATIONS: dict[str, Command] = {"sine": sine_command, "rich": rich_command}


def collect(
    machine: Machine, hours: float, excitation: str, rng: np.random.Generator, leg_s: float = 30.0
) -> Log:
    """Record the analytic plant, one actuator at a time, `hours` for each, returns not counted.

    A leg ends at the joint's limit or after `leg_s`; the joint then returns (recordings named
    `..._return`, dropped by `read_log`) and rests before the next leg. The sine excitation of the
    paper starts every leg at home (mid range), the rich one at random angles.

    Paper: Sec. 3.3

    Args:
        machine: what to record.
        hours: driving time for each actuator [h].
        excitation: a key of `EXCITATIONS`.
        rng: draws commands and starts.
        leg_s: longest leg [s].

    Returns:
        Angles as the encoders read them, commands in whole PWM counts.
    """
    if excitation not in EXCITATIONS:
        raise ValueError(f"excitation: expected one of {list(EXCITATIONS)}, got {excitation!r}")
    if machine.rate != RATE:
        raise ValueError(f"rate: expected {RATE:g} Hz as in every log, got {machine.rate:g} Hz")
    if not 0 < hours < np.inf:
        raise ValueError(f"hours: expected above 0, got {hours}")
    wanted = max(machine.history + 2, round(hours * 3600 * machine.rate))
    rows = int(np.clip(wanted // 1200, 1, 100))
    joint = np.repeat(np.arange(machine.n), rows)
    legs = _Legs(
        machine, EXCITATIONS[excitation], excitation == "rich", joint, rng, round(leg_s * machine.rate)
    )
    state = plant_reset(machine, np.tile(legs.home, (len(joint), 1)))
    us: list[Array] = []
    qs: list[Array] = []
    leg: list[Any] = []
    counted = np.zeros(len(joint), int)
    with tqdm(total=wanted, desc=f"record ({excitation})", unit="tick", disable=None) as bar:
        while counted.min() < -(-wanted // rows):
            q = read_encoder(machine, state.q)
            u = limit_command(machine, legs.command(q))
            for tape, value in ((us, u), (qs, q), (leg, legs.number.copy())):
                tape.append(value)
            counted += legs.number % 2 == 0
            state = plant_step(machine, state, u)
            bar.update(rows * min(1, counted.min() - bar.n // rows))
    return _cut(machine, joint, np.array(us), np.array(qs), np.array(leg), -(-wanted // rows))


class _Legs:
    """Bookkeeping of many parallel recordings: even leg numbers drive, odd ones return."""

    def __init__(
        self,
        machine: Machine,
        command: Command,
        random_start: bool,
        joint: NDArray[np.intp],
        rng: np.random.Generator,
        ticks: int,
    ) -> None:
        self.machine, self.make, self.random_start, self.joint = (machine, command, random_start, joint)
        self.rng, self.ticks, self.each = rng, ticks, np.arange(len(joint))
        self.q_min, self.q_max = machine.column("q_min"), machine.column("q_max")
        self.home = (self.q_min + self.q_max) / 2
        self.number, self.tick = np.zeros(len(joint), int), np.zeros(len(joint), int)
        self.tape = np.stack([command(rng, machine, ticks) for _ in joint])
        self.goal = self.home[joint].copy()
        self.rest = np.zeros(len(joint), int)

    def command(self, q: Array) -> Array:
        """Commands (rows, n) for measured angles (rows, n); moves the legs on."""
        machine, joint = self.machine, self.joint
        angle, step = q[self.each, joint], 2 * machine.encoder_step
        driving = self.number % 2 == 0
        at_limit = (angle < self.q_min[joint] + step) | (angle > self.q_max[joint] - step)
        ended = driving & ((self.tick >= self.ticks) | (at_limit & (self.tick > machine.rate)))
        arrived = ~driving & (self.rest > machine.rate)
        for row in np.flatnonzero(ended):
            j = joint[row]
            low, high = self.q_min[j], self.q_max[j]
            self.goal[row] = self.rng.uniform(low, high) if self.random_start else self.home[j]
        for row in np.flatnonzero(arrived):
            self.tape[row] = self.make(self.rng, machine, self.ticks)
        self.number += ended | arrived
        self.tick[ended | arrived], self.rest[ended | arrived] = 0, 0
        driving = self.number % 2 == 0
        error = self.goal - angle
        near = np.abs(error) < np.maximum(0.06, step)
        self.rest = np.where(~driving & (near | (self.rest > 0)), self.rest + 1, 0)
        back = np.where(self.rest > 0, 0.0, np.sign(error) * 0.35)
        u = np.zeros_like(q)
        tape = self.tape[self.each, np.minimum(self.tick, self.ticks - 1)]
        u[self.each, joint] = np.where(driving, tape, back)
        self.tick += 1
        return u


def _cut(
    machine: Machine, joint: NDArray[np.intp], u: Array, q: Array, leg: NDArray[np.int_], wanted: int
) -> Log:
    """Cut tapes (ticks, rows, n) into named recordings, `wanted` driving ticks a row."""
    recordings = []
    for row, j in enumerate(joint):
        driven = 0
        for number in range(leg[-1, row] + 1):
            ticks = np.flatnonzero(leg[:, row] == number)
            if number % 2 == 0:
                ticks = ticks[: wanted - driven]
                driven += len(ticks)
            name = f"{machine.names[j]}_{row % (len(joint) // machine.n):02d}_{number // 2:03d}"
            zero = np.zeros((len(ticks), machine.n))
            piece = Recording(name + RETURN * (number % 2), u[ticks, row], q[ticks, row], zero)
            recordings.append(piece)
            if driven == wanted:
                break
    return Log(machine.names, tuple(recordings))


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
    """History (..., n, 3, H) with the command `u` (..., n) of this tick appended: the nets' input."""
    result = history.copy()
    result[..., 2, :-1] = history[..., 2, 1:]
    result[..., 2, -1] = u
    return result


def push_angle(history: Array, q: ArrayLike, velocity: Callable[[Array], Array]) -> Array:
    """History (..., n, 3, H) with the next measured angle `q` (..., n) and its velocity appended.

    Args:
        history: as `push_command` left it.
        q: measured angle [rad].
        velocity: turns the new angle row (..., n, H) into the newest velocity (..., n) [rad/s].
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
        missing = [name for name in joints if name not in self.joints]
        if missing:
            raise ValueError(f"joints: expected nets for {list(joints)}, got {list(self.joints)}")
        index = [self.joints.index(name) for name in joints]
        arrays = {name: getattr(self, name)[index] for name in _NET_ARRAYS}
        weights = tuple(weight[index] for weight in self.weights)
        return replace(self, joints=tuple(joints), weights=weights, **arrays)

    def predict(self, history: Array) -> Array:
        """Mean velocity over the coming tick [rad/s], so that q(t+dt) = q(t) + dt * velocity.

        Args:
            history: shape (..., n, 3, H) after `push_command`.

        Returns:
            Shape (..., n).
        """
        n, inputs = len(self.joints), 3 * self.history
        if history.shape[-3:] != (n, 3, self.history):
            raise ValueError(f"history: expected (..., {n}, 3, {self.history}), got {history.shape}")
        x = history.reshape(-1, n, inputs).swapaxes(0, 1)  # (n, batch, 3 H)
        w1, b1, w2, b2, w3, b3 = self._folded
        x = np.maximum(x @ w1 + b1, 0)
        x = np.maximum(x @ w2 + b2, 0)
        fraction = 1 / (1 + np.exp(-(x @ w3 + b3)[..., 0]))
        low, high = self.output_low[:, None], self.output_high[:, None]
        velocity: Array = (low + (high - low) * fraction).T
        return velocity.reshape(history.shape[:-2])

    @property
    def _folded(self) -> tuple[Array, ...]:
        """Weights with the input normalisation folded into the first layer, computed once."""
        if "folded" not in self.__dict__:
            w1, b1, w2, b2, w3, b3 = self.weights
            scaled = w1 / self.input_scale[..., None]
            shift = b1 - np.einsum("ni,nih->nh", self.input_mean, scaled)
            self.__dict__["folded"] = (scaled, shift[:, None], w2, b2[:, None], w3, b3[:, None])
        folded: tuple[Array, ...] = self.__dict__["folded"]
        return folded

    def velocity(self, predicted: Array) -> Callable[[Array], Array]:
        """How the nets' input velocity follows from angles (or, trained on q_dot, from `predicted`)."""
        if self.velocity_logged:
            return lambda angles: predicted
        return lambda angles: estimate_velocity(angles, self.velocity_samples, 1 / self.rate)

    def step(self, history: Array, q: Array, u: ArrayLike) -> tuple[Array, Array]:
        """One tick of the simulation: history (..., n, 3, H), angle and command (..., n) -> the next."""
        history = push_command(history, u)
        predicted = self.predict(history)
        q = np.clip(q + predicted / self.rate, np.minimum(q, self.q_low), np.maximum(q, self.q_high))
        return push_angle(history, q, self.velocity(predicted)), q


_NET_ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")


def net_arrays(net: ActuatorNet) -> dict[str, NDArray[Any]]:
    """Nets as named arrays, a JSON header among them: what a file holds."""
    plain = {f.name: getattr(net, f.name) for f in fields(net) if f.name not in (*_NET_ARRAYS, "weights")}
    text = json.dumps({"format": FORMAT, "kind": "actuator net", **plain})
    arrays = {name: getattr(net, name) for name in _NET_ARRAYS}
    arrays |= {f"weight_{i}": weight for i, weight in enumerate(net.weights)}
    return {"header": np.array(text), **arrays}


def net_from_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> ActuatorNet:
    """Nets from `net_arrays`; `path` is for the messages.

    Raises:
        ValueError: another format, or arrays that do not fit the header.
    """
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
        np.savez(file, **net_arrays(net))  # type: ignore[arg-type]


def load_net(path: Path) -> ActuatorNet:
    """Read nets that `save_net` wrote.

    Raises:
        ValueError: no such file, another format, or arrays that do not fit the header.
    """
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

    steps: int = 4000
    """Adam steps."""
    batch_size: int = 512
    """Windows a joint in each step."""
    learning_rate: float = 4e-3
    """Of Adam at the start; falls to zero along a cosine."""
    noise: float = 0.2
    """Standard deviation of the noise on the velocity inputs, in units of the velocities' own."""
    hidden: int = 32
    """Units in each of the two hidden layers (paper: 32)."""
    history: int = 13
    """Samples of angle, velocity and command that the nets see (paper: 13)."""


def fit(log: Log, config: FitConfig, seed: int, velocity_samples: int, machine: str = "") -> ActuatorNet:
    """Fit one net a joint to the one-step targets of a log. Paper: Sec. 3.3 (MSE, Adam)

    Args:
        log: training recordings.
        config: settings.
        seed: of weights and batches; the same seed gives the same bits on the same machine.
        velocity_samples: window of the estimator that supplied the velocities of `log`.
        machine: name kept in the file.

    Raises:
        ValueError: a joint that never moves long enough to be learned.
    """
    import torch

    data, target, ends = _windows(log, config.history)
    mean, scale = _statistics(data, ends, config.history)
    low, high = np.array([[f(target[e]) for e in ends] for f in (np.min, np.max)])
    margin = 0.05 * (high - low)
    low, high = low - margin, high + margin

    generator = torch.Generator().manual_seed(seed)
    n, inputs, hidden = len(log.joints), 3 * config.history, config.hidden
    sizes = [(inputs, hidden), (hidden, hidden), (hidden, 1)]
    weights: list[torch.Tensor] = []
    for rows, columns in sizes:
        bound = (6 / rows) ** 0.5  # He's uniform bound for ReLU
        weights.append((torch.rand(n, rows, columns, generator=generator) * 2 - 1) * bound)
        weights.append(torch.zeros(n, columns))
    for weight in weights:
        weight.requires_grad_()
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)

    series, targets = torch.tensor(data, dtype=torch.float32), torch.tensor(target)
    lags = torch.arange(1 - config.history, 1)
    centre, width = torch.tensor(mean)[:, None].float(), torch.tensor(scale)[:, None].float()
    floor, span = torch.tensor(low)[:, None], torch.tensor(high - low)[:, None]
    choices = [torch.tensor(e) for e in ends]
    for _ in tqdm(range(config.steps), desc="fit nets", unit="step", disable=None):
        picks = [torch.randint(len(c), (config.batch_size,), generator=generator) for c in choices]
        at = torch.stack([c[pick] for c, pick in zip(choices, picks, strict=True)])
        x = series[:, at[..., None] + lags].permute(1, 2, 0, 3).reshape(n, -1, inputs)
        x = (x - centre) / width
        if config.noise:
            x[..., config.history : 2 * config.history] += config.noise * (
                torch.randn(n, config.batch_size, config.history, generator=generator)
                + torch.randn(n, config.batch_size, 1, generator=generator)
            )
        for i in (0, 2):
            x = torch.relu(torch.baddbmm(weights[i + 1][:, None], x, weights[i]))
        y = torch.sigmoid(torch.baddbmm(weights[5][:, None], x, weights[4]))[..., 0]
        wanted = ((targets[at] - floor) / span).float()
        loss = ((y - wanted) ** 2).mean(dim=1).sum()
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step()
        schedule.step()
    if not all(torch.isfinite(weight).all() for weight in weights):
        raise ValueError("weights: expected finite numbers at the end of the fit, got nan or inf")
    return ActuatorNet(
        joints=log.joints,
        history=config.history,
        rate=RATE,
        velocity_samples=velocity_samples,
        velocity_logged=log.velocity_logged,
        machine=machine,
        seed=seed,
        settings=asdict(config),
        input_mean=mean.astype(np.float32),
        input_scale=scale.astype(np.float32),
        output_low=low.astype(np.float32),
        output_high=high.astype(np.float32),
        q_low=np.min([r.q.min(axis=0) for r in log.recordings], axis=0).astype(np.float32),
        q_high=np.max([r.q.max(axis=0) for r in log.recordings], axis=0).astype(np.float32),
        weights=tuple(weight.detach().numpy() for weight in weights),
    )


def _windows(log: Log, history: int) -> tuple[Array, Array, list[NDArray[np.intp]]]:
    """Series (3, N) of all joints end to end, targets (N,), and where each joint's windows end.

    Windows never cross recordings, and only recordings in which the joint moves are used. Nothing is
    copied `history` times: training gathers windows from the series batch by batch.
    """
    series: list[Array] = []
    targets: list[Array] = []
    ends: list[NDArray[np.intp]] = []
    offset = 0
    for j, name in enumerate(log.joints):
        found: list[NDArray[np.intp]] = [np.empty(0, int)]
        for r in log.recordings:
            if len(r.q) < history + 1 or np.ptp(r.q[:, j]) == 0 == np.ptp(r.u[:, j]):
                continue
            following = r.q_dot[1:, j] if log.velocity_logged else np.diff(r.q[:, j]) * RATE
            series.append(np.stack([r.q[:, j], r.q_dot[:, j], r.u[:, j]]))
            targets.append(np.append(following, 0.0))
            found.append(offset + np.arange(history - 1, len(r.q) - 1))
            offset += len(r.q)
        ends.append(np.concatenate(found))
        if not len(ends[-1]) or np.ptp(np.concatenate(targets)[ends[-1]]) == 0:
            raise ValueError(
                f"joint {name}: expected a recording of {history + 1} samples or more in which it "
                "moves, got none"
            )
    return np.concatenate(series, axis=1), np.concatenate(targets), ends


def _statistics(data: Array, ends: list[NDArray[np.intp]], history: int) -> tuple[Array, Array]:
    """Mean and scale of each input (n, 3 H), the same for all samples of a channel."""
    mean = np.array([data[:, e].mean(axis=1) for e in ends])
    scale = np.array([data[:, e].std(axis=1) for e in ends])
    scale = np.where(scale > 1e-9, scale, 1.0)  # a channel that never changes
    return np.repeat(mean, history, axis=1), np.repeat(scale, history, axis=1)


# --- scores ---------------------------------------------------------------------------------------


def free_run(
    net: ActuatorNet, recording: Recording, starts: NDArray[np.intp], ticks: int
) -> tuple[Array, Array]:
    """Run the nets on their own predictions under the recorded commands.

    Args:
        net: n joints.
        recording: its joints in the order of the net.
        starts: sample at which each segment starts, at least H, shape (s,).
        ticks: length of a segment.

    Returns:
        Angle [rad] and velocity [rad/s] at the `ticks` samples after each start, (ticks, s, n) both.
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

    Each joint is scored on the recordings in which it is commanded or moves. Free runs start every
    `horizon` seconds of each recording; `velocity_rmse` is over all their samples,
    `position_error_median` is the median over segments of |angle error| at their end.

    Raises:
        ValueError: joints that do not match, or no recording long enough for one step.
    """
    if log.joints != net.joints:
        raise ValueError(f"joints: expected {list(net.joints)}, got {list(log.joints)}")
    lengths = [len(r.q) for r in log.recordings]
    offsets = np.cumsum([0, *lengths])
    whole = Recording(
        "", *(np.concatenate([getattr(r, k) for r in log.recordings]) for k in Recording._fields[1:])
    )

    moves = np.array([np.ptp(r.u, axis=0) + np.ptp(r.q, axis=0) > 0 for r in log.recordings])
    moves |= ~moves.any(axis=0)  # a joint that rests everywhere is scored at rest

    def segments(ticks: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Starts (s,) of segments, and in which of them each joint moves (s, n)."""
        pieces = [np.arange(net.history, length - ticks, ticks) for length in lengths]
        where = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
        return np.concatenate(pieces).astype(int) + offsets[where], moves[where]

    joints: dict[str, Any] = {name: {"free_run": {}} for name in log.joints}
    starts, used = segments(1)
    if not len(starts):
        raise ValueError(f"log: expected a recording above {net.history + 1} samples, got {lengths[:9]}")
    chunks = np.array_split(starts, -(-len(starts) // 8192))
    one = np.concatenate([free_run(net, whole, chunk, 1)[1][0] for chunk in chunks])
    for j, name in enumerate(log.joints):
        mine = used[:, j]
        truth, last = whole.q_dot[starts + 1, j][mine], whole.q_dot[starts, j][mine]
        joints[name]["one_step_rmse"] = _rms(one[mine, j] - truth)
        joints[name]["persistence_rmse"] = _rms(last - truth)
    for horizon in HORIZONS:
        ticks = round(horizon * net.rate)
        starts, used = segments(ticks)
        if not len(starts):
            continue
        angles, velocities = free_run(net, whole, starts, ticks)
        later = starts + np.arange(1, ticks + 1)[:, None]
        q_error, v_error = angles - whole.q[later], velocities - whole.q_dot[later]
        for j, name in enumerate(log.joints):
            if (mine := used[:, j]).any():
                joints[name]["free_run"][str(horizon)] = {
                    "velocity_rmse": _rms(v_error[:, mine, j]),
                    "position_error_median": float(np.median(np.abs(q_error[-1, mine, j]))),
                }
    return joints


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def task_log(machine: Machine, runs: int, seconds: float, rng: np.random.Generator) -> Log:
    """Recordings under commands like a policy's: reversals, small corrections, driven joints together.

    In every fifth recording the locked joints move instead: the machine lets them move only alone.

    Smoothed random levels held for 0.5 to 5 s, towards the nearer end of the range less often, so
    that the joints stay off their stops. For scoring only; no net is fitted to them.
    """
    q_min, q_max = machine.column("q_min"), machine.column("q_max")
    shape, limit = (runs, machine.n), machine.pwm_limit / 127
    state = plant_reset(machine, rng.uniform(0.8 * q_min + 0.2 * q_max, 0.2 * q_min + 0.8 * q_max, shape))
    level, command, left = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    smoothing, noise = rng.uniform(0.05, 0.6, shape), rng.uniform(0, 0.06, shape)
    locked_turn = (np.arange(runs) % 5 == 4)[:, None]
    moving = np.isin(np.arange(machine.n), machine.locked) == locked_turn
    us, qs = [], []
    for _ in range(round(seconds * machine.rate)):
        fraction = (state.q - q_min) / (q_max - q_min)
        up = rng.random(shape) > np.clip(1.5 * fraction - 0.25, 0, 1)
        drawn = np.where(up, 1, -1) * rng.uniform(0, limit, shape) * (rng.random(shape) < 0.85)
        near = np.where(up, fraction > 0.9, fraction < 0.1)
        level = np.where((left <= 0) | (near & (level * (2 * up - 1) > 0)), drawn, level)
        left = np.where(left <= 0, rng.uniform(0.5, 5.0, shape), left) - machine.dt
        command = command + smoothing * (level - command)
        jitter = noise * rng.standard_normal(shape) * (level != 0)
        u = limit_command(machine, moving * (command + jitter))
        us.append(u)
        qs.append(read_encoder(machine, state.q))
        state = plant_step(machine, state, u)
    zero = np.zeros((len(us), machine.n))
    tapes = zip(np.array(us).swapaxes(0, 1), np.array(qs).swapaxes(0, 1), strict=True)
    return Log(machine.names, tuple(Recording(f"task_{i:02d}", u, q, zero) for i, (u, q) in enumerate(tapes)))
