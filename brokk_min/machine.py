"""A machine as one frozen value: geometry, limits, valves, cylinders, encoders, CAN ids.

Porting to another machine means writing another `Machine`; nothing else in the package knows a
Brokk. Every number carries its unit (in the class) and its source (in the value):
`paper`, `maker`, `assumed` or `tuned`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]  # of any shape, float32 or float64
SOURCES = ("paper", "maker", "assumed", "tuned")
PWM_MAX = 127  # counts of full command; paper: [0,127] is positive, [255,128] negative


def _number(
    unit: str, low: float = -np.inf, high: float = np.inf, default: Any = dataclasses.MISSING
) -> Any:
    """A dataclass field with its unit and its range, both ends included; `int` means whole."""
    return dataclasses.field(default=default, metadata={"unit": unit, "low": low, "high": high})


def _numbers(owner: Machine | Joint | type[Joint] | type[Machine]) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(owner) if "unit" in field.metadata]


def _check_number(field: dataclasses.Field[Any], label: str, value: Any) -> None:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not ((whole or isinstance(value, float | np.floating)) and np.isfinite(value)):
        raise ValueError(f"{label}: expected a finite number, got {value!r}")
    if field.type == "int" and not whole:
        raise ValueError(f"{label}: expected a whole number, got {value!r}")
    low, high = field.metadata["low"], field.metadata["high"]
    if not low <= value <= high:
        raise ValueError(f"{label}: expected {low} to {high}, got {value!r}")


@dataclass(frozen=True)
class Joint:
    """One revolute joint: its standard DH row Rz(q + theta) Tz(d) Tx(a) Rx(alpha), range and drive.

    A cylinder spans a triangle: sides `cylinder_base` and `cylinder_rod` meet at the pivot under
    the angle `cylinder_angle + q`. A base of 0 means a slew drive with constant lever arm `rod`.
    """

    name: str
    driven: bool  # does the controller move it? (a locked joint is set by the operator)
    a: float = _number("m")
    alpha: float = _number("rad")
    d: float = _number("m")
    theta: float = _number("rad")
    q_min: float = _number("rad")
    q_max: float = _number("rad")
    cylinder_base: float = _number("m", 0)
    cylinder_rod: float = _number("m", 1e-6)
    cylinder_angle: float = _number("rad")
    cylinder_area: float = _number("m^2", 1e-9)
    speed_positive: float = _number("m/s", 1e-9)  # of the cylinder at full command
    speed_negative: float = _number("m/s", 1e-9)
    q_dot_up: float = _number(
        "rad/s", 1e-9
    )  # fastest positive motion at the command limit, as logs show it
    q_dot_down: float = _number("rad/s", 1e-9)  # fastest negative motion, a positive number
    encoder_node: int = _number("CANopen node id", 1, 127)
    encoder_zero: int = _number("counts", default=0)  # what the encoder says at q = 0
    encoder_sign: int = _number("1", -1, 1, default=1)  # -1: it counts down while q rises

    def check_range(self) -> None:
        """Refuse an empty range, one over which the cylinder's triangle does not stay open, no sign."""
        if self.encoder_sign == 0:
            raise ValueError(f"{self.name}.encoder_sign: expected -1 or 1, got 0")
        if not self.q_min < self.q_max:
            raise ValueError(
                f"{self.name}.q_max: expected above q_min = {self.q_min}, got {self.q_max!r}"
            )
        low, high = self.cylinder_angle + self.q_min, self.cylinder_angle + self.q_max
        if self.cylinder_base > 0 and not 0 < low < high < np.pi:
            raise ValueError(
                f"{self.name}.cylinder_angle: expected the triangle's angle within (0, pi) "
                f"over the joint's range, got {low:.3f} to {high:.3f}"
            )


@dataclass(frozen=True)
class Machine:
    """Everything that distinguishes one machine from another.

    ValueError: on creation, for a field out of its range: its name, what is allowed and what came.

    Example:
        >>> BROKK_170.n, [joint.name for joint in BROKK_170.joints if joint.driven]
        (5, ['q1', 'q3', 'q4', 'q5'])
    """

    name: str
    joints: tuple[Joint, ...]
    sources: Mapping[str, str] = dataclasses.field(hash=False)  # name of a number -> one of SOURCES
    rate: float = _number("Hz", 1e-3)  # control and logging rate
    pwm_limit: int = _number(
        "counts of 127", 1, PWM_MAX
    )  # largest command that may leave the program
    dead_zone: float = _number("of full command", 0, 0.99)
    delay: float = _number("s", 0)
    tau_spool: float = _number("s", 1e-6)
    tau_cylinder: float = _number("s", 1e-6)
    tau_valve_up: float = _number("s", 1e-6)
    tau_valve_down: float = _number("s", 1e-6)
    valve_threshold: float = _number("1", 0, 0.999)
    spool_threshold: float = _number("of full stroke", 0, 1)
    pump_flow: float = _number("m^3/s", 1e-9)
    plant_dt: float = _number("s", 1e-6, 1)  # explicit Euler step of the analytic plant
    encoder_bits: int = _number("bits a turn", 1, 32)
    velocity_samples: int = _number("samples", 2, 100)  # window of the causal velocity estimator
    history: int = _number("samples", 2, 1000)  # of q, q_dot and u that the nets and the policy see
    tool_speed: float = _number("m/s", 1e-9)  # largest tool speed an operator may ask for
    ground: float = _number("m")  # height of the ground in the base frame
    valve_frame_id: int = _number("CAN id", 0, 0x7FF)
    controller_node: int = _number("CANopen node id", 1, 127)  # of the valve controller
    q_start: tuple[float, ...] = ()  # rad, where experiments start; empty: the middle of the ranges

    def __post_init__(self) -> None:
        """Refuse what cannot be a machine, naming field, wanted and got."""
        if not any(joint.driven for joint in self.joints):
            raise ValueError("joints: expected at least one driven joint, got none")
        object.__setattr__(self, "sources", dict(self.sources))  # a copy of its own
        owners: list[tuple[Machine | Joint, str]] = [(self, "")]
        owners += [(joint, f"{joint.name}.") for joint in self.joints]
        for owner, where in owners:
            for field in _numbers(owner):
                _check_number(field, where + field.name, getattr(owner, field.name))
                if (source := self.sources.get(field.name)) not in SOURCES:
                    raise ValueError(
                        f"sources[{field.name!r}]: expected one of {SOURCES}, got {source!r}"
                    )
        for joint in self.joints:
            joint.check_range()
        nodes = [joint.encoder_node for joint in self.joints]
        for what, values in (("names", [*self.names]), ("encoder nodes", nodes)):
            if len(set(values)) != len(values):
                raise ValueError(f"joints: expected different {what}, got {values}")
        if self.controller_node in nodes:
            raise ValueError(
                f"controller_node: expected none of {nodes}, got {self.controller_node}"
            )
        if not self.dead_zone * PWM_MAX < self.pwm_limit:  # no valve would ever open
            limit = f"{self.pwm_limit}/{PWM_MAX}"
            raise ValueError(
                f"dead_zone: expected below the command limit {limit}, got {self.dead_zone!r}"
            )
        steps = self.dt / self.plant_dt
        if abs(steps - round(steps)) > 1e-6 or steps < 0.5:
            raise ValueError(
                f"plant_dt: expected 1/rate = {self.dt} to be a multiple, got {self.plant_dt}"
            )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return 1.0 / self.rate

    @property
    def encoder_step(self) -> float:
        """Angle of one encoder count [rad]."""
        return float(2 * np.pi / 2**self.encoder_bits)

    @cached_property
    def driven(self) -> NDArray[np.intp]:
        """Indices of the driven joints, shape (n_driven,)."""
        return np.flatnonzero([joint.driven for joint in self.joints])

    @cached_property
    def locked(self) -> NDArray[np.intp]:
        """Indices of the joints that the operator sets and the controller leaves alone."""
        return np.flatnonzero([not joint.driven for joint in self.joints])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Joint names in the order of every array of the package."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def q_dot_max(self) -> NDArray[np.float64]:
        """Fastest motion of each joint at the command limit, of the faster direction [rad/s], (n,)."""
        return np.maximum(self.column("q_dot_up"), self.column("q_dot_down"))

    @cached_property
    def _columns(self) -> dict[str, NDArray[np.float64]]:
        columns = {
            f.name: np.array([getattr(j, f.name) for j in self.joints], float)
            for f in _numbers(Joint)
        }
        for column in columns.values():
            column.setflags(write=False)
        return columns

    def column(self, field: str) -> NDArray[np.float64]:
        """One numeric `Joint` field over all joints, shape (n,), read-only.

        Example:
            >>> BROKK_170.column("a")
            array([0.25, 1.15, 1.25, 1.15, 1.2 ])
        """
        return self._columns[field]


def as_floats(values: ArrayLike) -> NDArray[np.floating]:
    """An array of floats; its float type is kept, whole numbers become float64."""
    array = np.asarray(values)
    return array if array.dtype.kind == "f" else array.astype(float)


def lengths(vectors: Array) -> Array:
    """Euclidean lengths (...) of vectors (..., k).

    Example:
        >>> lengths(np.array([[3.0, 4.0, 0.0]]))
        array([5.])
    """
    result: Array = np.sqrt(np.add.reduce(vectors * vectors, axis=-1))
    return result


def limit_command(machine: Machine, u: ArrayLike) -> NDArray[np.floating]:
    """The command [-1, 1] that reaches the valve: whole PWM counts, clipped to +-pwm_limit/127.

    Shape and float type of `u`. Paper: Sec. 3.2 (65 %)

    Example:
        >>> limit_command(BROKK_170, [-1.0, 0.1]) * 127
        array([-80.,  13.])
    """
    u = as_floats(u)
    counts = np.clip(np.rint(u * PWM_MAX), -machine.pwm_limit, machine.pwm_limit)
    limited: NDArray[np.floating] = (counts / PWM_MAX).astype(u.dtype)
    return limited


def valve_opening(u: ArrayLike, dead_zone: float) -> NDArray[np.floating]:
    """Opening of a valve in [-1, 1] under a command `u`: what lies beyond the dead zone.

    Shape and float type of `u`; `dead_zone` is a share of full command. Paper: Sec. 3.2 (7 %)

    Example:
        >>> valve_opening([-1.0, 0.05, 0.535], 0.07).round(3)
        array([-1. ,  0. ,  0.5])
    """
    u = as_floats(u)
    opening: NDArray[np.floating] = (u - np.clip(u, -dead_zone, dead_zone)) / (1 - dead_zone)
    return opening


def encode_pwm(u: ArrayLike) -> NDArray[np.uint8]:
    """Byte on the bus for a command `u` in [-1, 1] (...): m >= 0 -> m, m < 0 -> 255 - |m|.

    Paper: Sec. 3.2 (the pairs 80/175 and 50/205 sum to 255)

    ValueError: a command outside [-1, 1] or not a number.

    Example:
        >>> encode_pwm(np.array([80, -80, 50, -50, 0]) / 127).tolist()
        [80, 175, 50, 205, 0]
    """
    u = np.asarray(u, float)
    if not np.all(np.abs(u) <= 1):
        raise ValueError(f"u: expected within [-1, 1], got {u[~(np.abs(u) <= 1)].flat[0]}")
    counts = np.rint(u * PWM_MAX).astype(int)
    return np.asarray(np.where(counts < 0, 255 + counts, counts), np.uint8)


def decode_pwm(u_byte: ArrayLike) -> NDArray[np.float64]:
    """Signed command in [-1, 1] for a byte; 0 and 255 both mean idle. Shape (...).

    Paper: Sec. 3.2

    Example:
        >>> decode_pwm([80, 175, 0, 255]) * 127
        array([ 80., -80.,   0.,   0.])
    """
    u_byte = np.asarray(u_byte).astype(int)
    if not np.all((u_byte >= 0) & (u_byte <= 255)):
        raise ValueError(
            f"u_byte: expected 0 to 255, got {u_byte[(u_byte < 0) | (u_byte > 255)].flat[0]}"
        )
    counts = np.where(u_byte > PWM_MAX, u_byte - 255, u_byte)
    return np.asarray(counts / PWM_MAX, float)


def read_encoder(machine: Machine, q: ArrayLike) -> NDArray[np.floating]:
    """What the encoders report for true angles `q` [rad]: whole counts, same shape and float type.

    Example:
        >>> read_encoder(BROKK_170, [0.0, 0.001, 1.0]) / BROKK_170.encoder_step
        array([  0.,   1., 652.])
    """
    q = as_floats(q)
    counts: NDArray[np.floating] = np.rint(q / machine.encoder_step)
    return (counts * machine.encoder_step).astype(q.dtype)


def estimate_velocity(q: ArrayLike, samples: int, dt: float) -> NDArray[np.floating]:
    """Causal velocity [rad/s] (...): slope of the line through the newest `samples` angles `q` (..., T).

    The one estimator of the package: logs, environment and hardware all call it. A difference over
    one tick of a 12-bit encoder comes in steps of 0.031 rad/s at 20 Hz; four samples have a third
    of its noise and lag by 1.5 ticks.

    Example:
        >>> estimate_velocity([0.0, 0.1, 0.2, 0.3], samples=4, dt=0.05).round(6)
        np.float64(2.0)
    """
    q = as_floats(q)
    if samples < 2 or q.shape[-1] < samples:
        raise ValueError(f"q: expected at least {max(2, samples)} samples, got {q.shape}")
    lags = np.arange(samples) - (samples - 1) / 2
    weights = (lags / (lags @ lags * dt)).astype(q.dtype)
    velocity: NDArray[np.floating] = np.einsum("...t,t", q[..., -samples:], weights)
    return velocity


def _brokk_170() -> Machine:
    """The machine of the paper: ranges and links are plausible, not the maker's data."""
    pi = float(np.pi)
    #         name driven  a     alpha   d     theta         q_min  q_max
    rows = [
        ("q1", True, 0.25, pi / 2, 0.95, 0.0, -2.14, 2.14),
        ("q2", False, 1.15, 0.0, 0.0, 0.0, 0.0, 1.4),
        ("q3", True, 1.25, 0.0, 0.0, 0.0, -0.3, 1.6),
        ("q4", True, 1.15, 0.0, 0.0, -pi, 0.6, 2.9),
        ("q5", True, 1.20, 0.0, 0.0, -3 * pi / 4, 0.0, 2.0),
    ]
    #   base  rod   angle  area    speed+  speed-  up    down
    drives = [
        (0.00, 0.15, 0.00, 0.0040, 0.0498, 0.0498, 0.20, 0.20),
        (1.00, 0.35, 0.45, 0.0100, 0.0588, 0.0802, 0.15, 0.22),
        (0.90, 0.30, 0.80, 0.0090, 0.0453, 0.0825, 0.17, 0.28),
        (0.80, 0.25, -0.30, 0.0060, 0.0370, 0.0662, 0.22, 0.38),
        (0.60, 0.20, 0.40, 0.0040, 0.0425, 0.0833, 0.24, 0.47),
    ]
    pairs = enumerate(zip(rows, drives, strict=True), 1)
    joints = tuple(Joint(*row, *drive, node) for node, (row, drive) in pairs)
    paper = dict.fromkeys(["rate", "pwm_limit", "dead_zone", "history"], "paper")
    every = [field.name for owner in (Joint, Machine) for field in _numbers(owner)]
    return Machine(
        name="brokk170",
        joints=joints,
        sources=dict.fromkeys(every, "assumed") | paper | {"velocity_samples": "tuned"},
        rate=20.0,
        pwm_limit=80,
        dead_zone=0.07,
        delay=0.040,
        tau_spool=0.030,
        tau_cylinder=0.030,
        tau_valve_up=0.15,
        tau_valve_down=0.40,
        valve_threshold=0.80,
        spool_threshold=0.01,
        pump_flow=0.00105,
        plant_dt=0.005,
        encoder_bits=12,
        velocity_samples=4,
        history=13,
        tool_speed=0.3,
        ground=0.0,
        valve_frame_id=0x210,
        controller_node=0x10,
        q_start=(1.5, 0.5, 0.58, 1.71, 1.24),  # paper: q_s
    )


BROKK_170 = _brokk_170()
