"""A machine as one frozen value: geometry, limits, valves, cylinders, encoders, CAN ids.

To port means to write another `Machine`: nothing else knows a Brokk. Fields state their units,
`BROKK_170` its sources: paper, assumed (not the maker's data) or tuned (by runs of this project).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]  # of any shape, float32 or float64
PWM_MAX = 127  # counts of full command; paper: [0,127] is positive, [255,128] negative


def number(
    unit: str, low: float | str = -np.inf, high: float = np.inf, default: Any = dataclasses.MISSING
) -> Any:
    """A field with its unit and its range, both ends included; `low` may name another field."""
    return dataclasses.field(default=default, metadata={"unit": unit, "low": low, "high": high})


@dataclass(frozen=True)
class Joint:
    """One joint: its standard DH row Rz(theta) Tz(d) Tx(a) Rx(alpha), range and drive.

    Its variable q is added to theta [rad], or to d [m] of a prismatic joint. A cylinder (of the
    plant) spans a triangle: sides `cylinder_base` and `cylinder_rod` meet under `cylinder_angle`
    + q. A base of 0: a constant lever arm `cylinder_rod`; if that is 1, q is the cylinder's travel.
    """

    name: str
    driven: bool  # by the controller? (a locked joint is set by the operator)
    a: float = number("m")
    alpha: float = number("rad")
    d: float = number("m")
    theta: float = number("rad")
    q_min: float = number("rad or m")
    q_max: float = number("rad or m")
    q_dot_up: float = number("rad/s or m/s", 1e-9)  # fastest motion at the command limit, nominal:
    q_dot_down: float = number("rad/s or m/s", 1e-9)  # up, and down; both are positive
    encoder_node: int = number("CANopen node id", 1, 127)
    cylinder_base: float = number("m", 0, default=0.0)
    cylinder_rod: float = number("m", 1e-6, default=1.0)
    cylinder_angle: float = number("rad", default=0.0)
    cylinder_area: float = number("m^2", 1e-9, default=0.005)
    speed_positive: float = number("m/s", 0, default=0.0)  # of the cylinder at full command, up
    speed_negative: float = number("m/s", 0, default=0.0)  # and down; 0: worked out in `complete`
    encoder_zero: int = number("counts", default=0)  # the reading at q = 0
    encoder_sign: Literal[-1, 1] = 1  # -1: it counts down while q rises
    kind: Literal["revolute", "prismatic"] = "revolute"
    encoder_step: float = number("m a count", 1e-9, 1, 1e-4)  # if prismatic, else `encoder_bits`
    weight: float = number("1 or 1/m^2", 1e-9, 1e9, 1.0)  # in W; if prismatic 1/L^2, L of the arm
    dead_zone_up: float | None = number("of full command", 0, 0.99, None)  # None: the machine's
    dead_zone_down: float | None = number("of full command", 0, 0.99, None)

    def __post_init__(self) -> None:
        """ValueError: a bad number, an empty range, a triangle that closes over the range."""
        check_numbers(self, f"{self.name}.")
        if not self.q_min < self.q_max:
            raise ValueError(f"{self.name}.q_max: expected above {self.q_min}, got {self.q_max!r}")
        low, high = self.cylinder_angle + self.q_min, self.cylinder_angle + self.q_max
        closes = self.kind == "revolute" and 0 < low < high < np.pi
        if self.cylinder_base > 0 and not closes:
            expected = "expected the triangle of a revolute joint within (0, pi) over its range"
            raise ValueError(f"{self.name}.cylinder_angle: {expected}, got {low:.3f} to {high:.3f}")

    def complete(self, zones: Array, limit: float, counts: int) -> Joint:
        """With encoder step and, where 0, the cylinder speeds that give q_dot_up and q_dot_down."""
        full_up, full_down = self.cylinder_rod * (1 - zones) / (limit - zones)  # arm / opening
        up = self.speed_positive or self.q_dot_up * float(full_up)
        down = self.speed_negative or self.q_dot_down * float(full_down)
        step = self.encoder_step if self.kind == "prismatic" else 2 * np.pi / counts
        return replace(self, speed_positive=up, speed_negative=down, encoder_step=step)


@dataclass(frozen=True)
class Machine:
    """Everything that distinguishes one machine from another."""

    name: str
    joints: tuple[Joint, ...]
    rate: float = number("Hz", 1e-3)  # of control and logging
    pwm_limit: int = number("counts of 127", 1, PWM_MAX)  # largest command that leaves the program
    dead_zone: float = number("of full command", 0, 0.99)  # the least; nets and actions begin at it
    encoder_bits: int = number("bits a turn", 1, 32)  # of revolute joints
    velocity_samples: int = number("samples", 2, 100)  # window of the velocity estimator
    history: int = number("samples", "velocity_samples", 1000)  # of q, q_dot and u: nets, policy
    tool_speed: float = number("m/s", 1e-9)  # largest goal velocity of the tool
    ground: float = number("m")  # height of the ground in the base frame
    valve_frame_id: int = number("CAN id", 0, 0x7FF)
    controller_node: int = number("CANopen node id", 1, 127)  # of the valve controller
    largest_dead_zone: float = number("of full command", 0, 0.99, default=0.0)  # gate; 0: 1.5 zones
    dither: float = number("of full stroke", 0, 0.5, default=0.03)  # at rest, beyond the dead zone
    # Of the analytic plant alone; by default what is assumed of the Brokk, with any pump flow.
    delay: float = number("s", 0, default=0.040)  # to the valve, in whole plant_dt
    plant_dt: float = number("s", 1e-6, 1, 0.005)  # step of explicit Euler, at most each tau
    tau_spool: float = number("s", "plant_dt", default=0.030)  # time constant of the spool
    tau_cylinder: float = number("s", "plant_dt", default=0.030)  # of the cylinder's speed
    tau_valve_up: float = number("s", "plant_dt", default=0.15)  # of a valve's activation, rising
    tau_valve_down: float = number("s", "plant_dt", default=0.40)  # and falling
    valve_threshold: float = number("1", 0, 0.999, 0.80)  # a valve of less activation is closed
    spool_threshold: float = number("of full stroke", 0, 1, 0.01)  # above it a valve activates
    pump_flow: float = number("m^3/s", 1e-9, default=1.0)
    q_start: tuple[float, ...] = ()  # where experiments start; empty: the middle of the ranges
    plant: Any = None  # reset(machine, q) and step(machine, state, u); None: that of `actuator`

    def __post_init__(self) -> None:
        """ValueError: what cannot be a machine, with field, wanted and got."""
        check_numbers(self, "")
        if not any(joint.driven for joint in self.joints):
            raise ValueError("joints: expected at least one driven joint, got none")
        nodes = [*(joint.encoder_node for joint in self.joints), self.controller_node]
        for what, values in (("names", [*self.names]), ("CANopen nodes", nodes)):
            if len(set(values)) != len(values):
                raise ValueError(f"joints: expected different {what}, got {values}")
        least, most = self.dead_zones.min(), self.dead_zones.max()
        largest = self.largest_dead_zone or most
        if least < self.dead_zone:
            raise ValueError(f"dead_zone: expected at most a joint's {least}, got {self.dead_zone}")
        if largest < most:
            raise ValueError(f"largest_dead_zone: expected {most} or more, got {largest}")
        if not largest * PWM_MAX < self.pwm_limit:  # no valve would ever open
            raise ValueError(f"dead_zone: expected below {self.pwm_limit}/{PWM_MAX}, got {largest}")
        common = self.pwm_limit / PWM_MAX, 2**self.encoder_bits
        pairs = zip(self.joints, self.dead_zones, strict=True)
        joints = tuple(joint.complete(zones, *common) for joint, zones in pairs)
        object.__setattr__(self, "joints", joints)
        inside = [j.q_min <= q <= j.q_max for j, q in zip(joints, self.q_start, strict=False)]
        if self.q_start and not (len(self.q_start) == self.n and all(inside)):
            raise ValueError(f"q_start: expected {self.n} angles within ranges, got {self.q_start}")
        k = max(1, np.ceil(self.dt / self.plant_dt - 1e-6))  # Euler steps a tick
        if abs(self.dt / self.plant_dt - k) > 1e-6:
            raise ValueError(f"plant_dt: expected {self.dt / k}, a part of dt, got {self.plant_dt}")

    def __hash__(self) -> int:
        """By name: fast, for what `lru_cache` keeps per machine."""
        return hash(self.name)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return 1.0 / self.rate

    @property
    def encoder_step(self) -> NDArray[np.float64]:
        """Motion of each joint by one encoder count [rad or m], (n,)."""
        return self.column("encoder_step")

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names in the order of every array of the package."""
        return tuple(joint.name for joint in self.joints)

    @property
    @lru_cache  # noqa: B019
    def driven(self) -> NDArray[np.intp]:
        """Indices of the driven joints, shape (n_driven,)."""
        return np.flatnonzero([joint.driven for joint in self.joints])

    @property
    @lru_cache  # noqa: B019
    def locked(self) -> NDArray[np.intp]:
        """Indices of the joints that the operator sets and the controller leaves alone."""
        return np.flatnonzero([not joint.driven for joint in self.joints])

    @property
    @lru_cache  # noqa: B019
    def dead_zones(self) -> NDArray[np.float64]:
        """Dead zones of each joint up and down, of full command, (n, 2)."""
        pairs = [(joint.dead_zone_up, joint.dead_zone_down) for joint in self.joints]
        return np.array([[self.dead_zone if z is None else z for z in pair] for pair in pairs])

    @property
    def q_dot_max(self) -> NDArray[np.float64]:
        """Fastest motion of each joint at the command limit, either way [rad/s or m/s], (n,)."""
        return np.maximum(self.column("q_dot_up"), self.column("q_dot_down"))

    @lru_cache(maxsize=1024)  # noqa: B019
    def column(self, field: str) -> NDArray[np.float64]:
        """One numeric `Joint` field over all joints, shape (n,), read-only."""
        column = np.array([getattr(joint, field) for joint in self.joints], float)
        column.setflags(write=False)
        return column


def check_numbers(owner: Any, label: str = "") -> None:
    """ValueError: a number not finite, not whole or out of its range; a choice not offered."""
    hints = get_type_hints(type(owner))
    for field in dataclasses.fields(owner):
        value, hint = getattr(owner, field.name), hints[field.name]
        values = (True, False) if hint is bool else get_args(hint)
        if get_origin(hint) in (None, Literal) and values and value not in values:
            raise ValueError(f"{label}{field.name}: expected one of {values}, got {value!r}")
        if "unit" not in field.metadata or (value is None and type(None) in values):
            continue
        kind = "whole" if int in (hint, *values) else "finite"
        types: Any = (int, np.integer) if kind == "whole" else (int, float, np.integer, np.floating)
        if isinstance(value, bool) or not isinstance(value, types) or not abs(value) < np.inf:
            raise ValueError(f"{label}{field.name}: expected a {kind} number, got {value!r}")
        low, high = field.metadata["low"], field.metadata["high"]
        low = getattr(owner, low) if isinstance(low, str) else low
        if not low <= value <= high:
            raise ValueError(f"{label}{field.name}: expected {low} to {high}, got {value!r}")


def as_floats(values: ArrayLike) -> NDArray[np.floating]:
    """An array of floats; its float type is kept, whole numbers become float64."""
    array = np.asarray(values)
    return array if array.dtype.kind == "f" else array.astype(float)


def valve_opening(u: ArrayLike, dead_zone: ArrayLike) -> NDArray[np.floating]:
    """Opening of a valve in [-1, 1] under a command `u`: what lies beyond the dead zone.

    Shape and float type of `u`; `dead_zone` is a fraction of full command, or (..., 2): one for up
    and one for down of each `u` (...). Paper: Sec. 3.3 (7 %)

    Example:
        >>> valve_opening([-1.0, 0.05, 0.535], 0.07).round(3)
        array([-1. ,  0. ,  0.5])
    """
    u = as_floats(u)
    zone = side(u, dead_zone)
    return np.asarray((u - np.clip(u, -zone, zone)) / (1 - zone))


def valve_command(opening: ArrayLike, dead_zone: ArrayLike) -> NDArray[np.floating]:
    """The command that opens a valve so far: the inverse of `valve_opening`, 0 for 0."""
    x = as_floats(opening)
    zone = side(x, dead_zone)
    return np.asarray(np.sign(x) * zone + (1 - zone) * x)


def side(u: Array, pairs: ArrayLike) -> Array:
    """Of `pairs` (..., 2) those for up where u (...) > 0, else those for down; or one number."""
    pairs = np.asarray(pairs, u.dtype)
    return np.where(u > 0, pairs[..., 0], pairs[..., 1]) if pairs.ndim else pairs


# Joints of the Brokk 170. Sources: all assumed, but the fastest motions of q5 (paper, Sec. 3.2).
# fmt: off
_DH = [
    # name driven  a [m]  alpha [rad]  d [m]  theta [rad]    q_min, q_max [rad]
    ("q1", True,   0.25,  np.pi / 2,   0.95,  0.0,           -2.14, 2.14),
    ("q2", False,  1.15,  0.0,         0.0,   0.0,            0.0,  1.4),
    ("q3", True,   1.25,  0.0,         0.0,   0.0,           -0.3,  1.6),
    ("q4", True,   1.15,  0.0,         0.0,   -np.pi,         0.6,  2.9),
    ("q5", True,   1.20,  0.0,         0.0,   -3 * np.pi / 4, 0.0,  2.0),
]
_DRIVES = [
    # up, down [rad/s]  node  base, rod [m]  angle [rad]  area [m^2]  speed +, - [m/s]
    (0.20, 0.20,        1,    0.00, 0.15,     0.00,       0.0040,     0.0498, 0.0498),
    (0.15, 0.22,        2,    1.00, 0.35,     0.45,       0.0100,     0.0588, 0.0802),
    (0.17, 0.28,        3,    0.90, 0.30,     0.80,       0.0090,     0.0453, 0.0825),
    (0.22, 0.38,        4,    0.80, 0.25,    -0.30,       0.0060,     0.0370, 0.0662),
    (0.24, 0.47,        5,    0.60, 0.20,     0.40,       0.0040,     0.0425, 0.0833),
]
# fmt: on

BROKK_170 = Machine(
    name="brokk170",
    joints=tuple(Joint(*dh, *drive) for dh, drive in zip(_DH, _DRIVES, strict=True)),  # type: ignore[arg-type]
    rate=20.0,  # Hz; paper: Sec. 3.3
    pwm_limit=80,  # counts of 127; paper: Sec. 3.2
    dead_zone=0.07,  # of full command; paper: Sec. 3.3
    pump_flow=0.00105,  # m^3/s; assumed
    encoder_bits=12,  # bits a turn; assumed
    velocity_samples=4,  # samples; tuned
    history=13,  # samples; paper: Table 1 (0.6 s)
    tool_speed=0.3,  # m/s; assumed
    ground=0.0,  # m; assumed
    valve_frame_id=0x210,  # CAN id; assumed
    controller_node=0x10,  # CANopen node id; assumed
    q_start=(1.5, 0.5, 0.58, 1.71, 1.24),  # rad; paper: Sec. 4.1
)


def limit_command(machine: Machine, u: ArrayLike) -> NDArray[np.floating]:
    """The command that reaches the valve: whole counts, clipped to the limit. Paper: Sec. 3.2"""
    u = as_floats(u)
    counts = np.clip(np.rint(u * PWM_MAX), -machine.pwm_limit, machine.pwm_limit)
    return np.asarray(counts / PWM_MAX, u.dtype)


def encode_pwm(u: ArrayLike) -> NDArray[np.uint8]:
    """Byte on the bus for a command `u` in [-1, 1] (...): m >= 0 -> m, m < 0 -> 255 - |m|.

    ValueError: `u` outside [-1, 1]. Paper: Sec. 3.2 (the pairs 80/175 and 50/205 sum to 255)

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
    """Command in [-1, 1] for a byte (...); 0 and 255: idle. ValueError: no byte. Paper: Sec. 3.2"""
    u_byte = np.asarray(u_byte).astype(int)
    wrong = (u_byte < 0) | (u_byte > 255)
    if wrong.any():
        raise ValueError(f"u_byte: expected 0 to 255, got {u_byte[wrong].flat[0]}")
    return np.asarray(np.where(u_byte > PWM_MAX, u_byte - 255, u_byte) / PWM_MAX)


def read_encoder(machine: Machine, q: ArrayLike) -> NDArray[np.floating]:
    """What encoders report for true angles `q` (..., n): whole counts, of the same float type."""
    q = as_floats(q)
    return np.asarray(np.rint(q / machine.encoder_step) * machine.encoder_step, q.dtype)
