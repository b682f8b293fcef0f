"""A machine as one frozen value: geometry, limits, valves, encoders, CAN identifiers.

To port the project means to write another `Machine`. Only `actuator` knows more of the Brokk: the
hydraulics of the plant that stands in for it. The numbers of `BROKK_170` come from the paper, or
are assumed (not the maker's data), or tuned (by our runs).
"""

from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]  # of any shape, float32 or float64
PWM_MAX = 127  # counts of full command; paper: [0,127] is positive, [255,128] negative


def require(fact: bool, field: str, wanted: str, got: Any) -> None:
    """ValueError "field: expected wanted, got got" unless `fact` holds.

    >>> require(False, "--seeds", "1 or more", 0)
    Traceback (most recent call last):
    ValueError: --seeds: expected 1 or more, got 0
    """
    if not fact:
        raise ValueError(f"{field}: expected {wanted}, got {got}")


def python_numbers(value: Any, place: str = "") -> None:
    """Make the numbers of a frozen dataclass Python's, because files cannot hold those of NumPy.

    Arrays become tuples. ValueError, with `place` and field: no number, or not a finite one.
    """
    for field in fields(value):
        found = getattr(value, field.name)
        plain = np.asarray(found).tolist()
        if field.type is int:
            require(isinstance(plain, int), place + field.name, "a whole number", found)
        if field.type is bool:
            require(isinstance(plain, bool), place + field.name, "True or False", found)
        if field.type is str:
            require(isinstance(plain, str), place + field.name, "a text", found)
        if field.type is float:
            finite = isinstance(plain, int | float) and bool(np.isfinite(plain))
            require(finite, place + field.name, "a finite number", found)
        object.__setattr__(value, field.name, tuple(plain) if isinstance(plain, list) else plain)


def is_row(value: Any, length: int) -> bool:
    """Are these so many finite numbers?"""
    row = np.asarray(value)
    return row.shape == (length,) and row.dtype.kind in "iuf" and bool(np.isfinite(row).all())


@dataclass(frozen=True)
class Joint:
    """One joint: a row of standard Denavit-Hartenberg parameters, its range, its drive.

    T = Rz(theta) Tz(d) Tx(a) Rx(alpha). The joint variable q is added to theta [rad], or to d [m]
    if the joint is prismatic; "rad" below means rad or m.
    """

    name: str
    driven: bool  # by the controller; a locked joint is set by the operator
    a: float  # m
    alpha: float  # rad
    d: float  # m
    theta: float  # rad
    q_min: float  # rad
    q_max: float  # rad
    q_dot_up: float  # rad/s, towards q_max at the command limit: the largest in the range
    q_dot_down: float  # rad/s, nominal speed towards q_min, a positive number
    encoder_node: int  # CANopen node id
    dead_zone: tuple[float, float] = (0.07, 0.07)  # up, down, of full command; paper: Sec. 3.3
    encoder_zero: int = 0  # reading of the encoder at q = 0 [counts]
    encoder_sign: Literal[-1, 1] = 1  # -1: the encoder counts down while q rises
    kind: Literal["revolute", "prismatic"] = "revolute"
    encoder_step: float = 1e-4  # m a count of a prismatic joint; others have `encoder_bits`

    def __post_init__(self) -> None:
        """ValueError: a field that is no number."""
        python_numbers(self, f"{self.name}.")


@dataclass(frozen=True)
class Machine:
    """Everything that distinguishes one machine from another."""

    name: str
    joints: tuple[Joint, ...]
    rate: float  # Hz, of control and logging
    pwm_limit: int  # counts of 127; no larger command leaves the program
    encoder_bits: int  # bits a turn, of revolute joints
    velocity_samples: int  # window of the velocity estimator
    history: int  # samples of q, q_dot and u that nets and policy read
    tool_speed: float  # m/s, largest goal velocity of the tool
    ground: float  # m, height of the ground in the base frame
    valve_frame_id: int  # CAN identifier of the valve frame
    controller_node: int  # CANopen node id of the valve controller
    q_start: tuple[float, ...] = ()  # rad, where experiments start; empty: mid-range
    hydraulics: Any = None  # `actuator.Hydraulics`, or a name in `actuator.HYDRAULICS`

    def __hash__(self) -> int:
        """By name, for speed alone: `lru_cache` would hash all fields at each call."""
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
    def names(self) -> tuple[str, ...]:
        """Joint names, in the order of every array of the package."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def driven(self) -> NDArray[np.intp]:
        """Indices of the driven joints, (n_driven,)."""
        return np.flatnonzero([joint.driven for joint in self.joints])

    @cached_property
    def locked(self) -> NDArray[np.intp]:
        """Indices of the joints that the operator sets and the controller leaves alone."""
        return np.flatnonzero([not joint.driven for joint in self.joints])

    @cached_property
    def dead_zones(self) -> NDArray[np.float64]:
        """Dead zones of each joint up and down, of full command, (n, 2)."""
        return self.column("dead_zone")

    @cached_property
    def encoder_step(self) -> NDArray[np.float64]:
        """Motion of each joint by one encoder count [rad], (n,)."""
        turn = 2 * np.pi / 2**self.encoder_bits
        return np.array([turn if j.kind == "revolute" else j.encoder_step for j in self.joints])

    @property
    def q_dot_max(self) -> NDArray[np.float64]:
        """Nominal speed of each joint at the command limit, of both ways the faster, (n,)."""
        return np.maximum(self.column("q_dot_up"), self.column("q_dot_down"))

    @lru_cache(maxsize=1024)  # noqa: B019
    def column(self, field: str) -> NDArray[np.float64]:
        """One numeric field of all joints, (n,), or (n, 2) of pairs; read-only."""
        column = np.array([getattr(joint, field) for joint in self.joints], float)
        column.setflags(write=False)
        return column

    def __post_init__(self) -> None:
        """ValueError: what cannot be a machine, with the field, what is wanted and what it got."""
        python_numbers(self)
        joints: Any = self.joints  # of a user, who may have given anything
        some = isinstance(joints, tuple) and joints and all(isinstance(j, Joint) for j in joints)
        require(bool(some), "joints", "a tuple of one Joint or more", joints)
        require(all([self.name, *self.names]), "name", "one of machine and joints", "none")
        slower = min(self.rate, self.tool_speed)
        require(slower > 0, "rate, tool_speed", "positive numbers", slower)
        bits = self.encoder_bits
        require(1 <= bits <= 32, "encoder_bits", "1 to 32", bits)
        for j in self.joints:
            pair = is_row(j.dead_zone, 2)
            require(pair, f"{j.name}.dead_zone", "a pair, up and down", j.dead_zone)
            slower = min(j.q_dot_up, j.q_dot_down)
            require(slower > 0, f"{j.name}.q_dot_up, q_dot_down", "positive numbers", slower)
            known = j.kind in ("revolute", "prismatic")
            require(known, f"{j.name}.kind", "revolute or prismatic", j.kind)
            signed = j.encoder_sign in (-1, 1)
            require(signed, f"{j.name}.encoder_sign", "-1 or 1", j.encoder_sign)
            require(j.q_min < j.q_max, f"{j.name}.q_max", f"above {j.q_min}", j.q_max)
            step = j.encoder_step
            require(step > 0, f"{j.name}.encoder_step", "a positive number", step)
        nodes = [*(joint.encoder_node for joint in self.joints), self.controller_node]
        require(all(1 <= node <= 127 for node in nodes), "CANopen nodes", "1 to 127", nodes)
        for what, values in (("names", [*self.names]), ("CANopen nodes", nodes)):
            require(len(set(values)) == len(values), "joints", f"different {what}", values)
        limit, zones, samples = self.pwm_limit, self.dead_zones, self.velocity_samples
        require(1 <= limit <= PWM_MAX, "pwm_limit", "1 to 127", limit)
        opens = bool(((zones >= 0) & (zones < limit / PWM_MAX)).all())  # else no valve ever does
        require(opens, "dead_zone", f"0 to {limit}/{PWM_MAX}", zones.tolist())
        require(2 <= samples <= self.history, "velocity_samples", "2 to history", samples)
        fits = self.q_start == () or is_row(self.q_start, self.n)
        fits = fits and all(j.q_min <= q <= j.q_max for j, q in zip(self.joints, self.q_start))
        require(fits, "q_start", f"{self.n} angles within their ranges", self.q_start)
        known = 0 < self.valve_frame_id < 0x800
        require(known, "valve_frame_id", "an identifier of 11 bits", self.valve_frame_id)


# Joints of the Brokk 170. Sources: all assumed, but the nominal speeds of q5 (paper, Sec. 3.2).
# fmt: off
_JOINTS = [
    # name driven  a [m]  alpha [rad]  d [m]  theta [rad]    q_min, q_max  up, down [rad/s]  node
    ("q1", True,   0.25,  np.pi / 2,   0.95,  0.0,           -2.14, 2.14,  0.20, 0.20,       1),
    ("q2", False,  1.15,  0.0,         0.0,   0.0,            0.0,  1.4,   0.15, 0.22,       2),
    ("q3", True,   1.25,  0.0,         0.0,   0.0,           -0.3,  1.6,   0.17, 0.28,       3),
    ("q4", True,   1.15,  0.0,         0.0,   -np.pi,         0.6,  2.9,   0.22, 0.38,       4),
    ("q5", True,   1.20,  0.0,         0.0,   -3 * np.pi / 4, 0.0,  2.0,   0.24, 0.47,       5),
]
# fmt: on
BROKK_170 = Machine(
    name="brokk170",
    joints=tuple(Joint(*row) for row in _JOINTS),
    rate=20.0,  # Hz; paper: Sec. 3.3
    pwm_limit=80,  # counts of 127; paper: Sec. 3.2
    encoder_bits=12,  # bits a turn; assumed
    velocity_samples=4,  # samples; tuned
    history=13,  # samples; paper: Table 1 (0.6 s)
    tool_speed=0.3,  # m/s; assumed
    ground=0.0,  # m; assumed
    valve_frame_id=0x210,  # CAN id; assumed
    controller_node=0x10,  # CANopen node id; assumed
    q_start=(1.5, 0.5, 0.58, 1.71, 1.24),  # rad; paper: Sec. 4.1
    hydraulics="brokk170",
)


class Measured(NamedTuple):
    """What a machine's sensors tell a controller, in physical units and the base frame."""

    v_goal: Array  # goal velocity of the tool [m/s], (..., 3)
    v_tool: Array  # measured velocity of the tool [m/s], (..., 3)
    q: Array  # newest angles [rad], (..., n)
    q_dot: Array  # newest velocities of the driven joints [rad/s], (..., n_driven)
    history: Array  # angles, velocities, commands of the driven joints, (..., n_driven, 3, H)


class Controller(Protocol):
    """What can drive a machine: a policy, the PIDs, an operator.

    What it knows from tick to tick is its state: one may drive several batches side by side.
    """

    def start(self, num: int) -> Any:
        """State of `num` controllers at rest."""

    def __call__(self, measured: Measured, state: Any, /) -> tuple[Array, Any]:
        """Commands u [-1, 1] (num, n), and the controllers' state of the next tick."""


def by_direction(u: Array, pairs: ArrayLike) -> Array:
    """`pairs[..., 0]`, up, where u (...) > 0, else `pairs[..., 1]`, down.

    >>> by_direction(np.array([0.5, -0.5]), [0.1, 0.2]).tolist()
    [0.1, 0.2]
    """
    pairs = np.asarray(pairs, u.dtype)
    return np.where(u > 0, pairs[..., 0], pairs[..., 1])


def valve_opening(u: ArrayLike, dead_zones: ArrayLike) -> NDArray[np.floating]:
    """Opening of valves in [-1, 1], sign(u) max(0, (|u| - zone) / (1 - zone)) of commands u (...).

    `dead_zones` (..., 2) are up and down of each command. Paper: Sec. 3.3 (7 %)

    >>> valve_opening([0.535, 0.07, -1.0], (0.07, 0.07)).round(3) + 0.0
    array([ 0.5,  0. , -1. ])
    """
    u = 1.0 * np.asarray(u)  # whole numbers become floats
    zone = by_direction(u, dead_zones)
    return np.asarray((u - np.clip(u, -zone, zone)) / (1 - zone))


def valve_command(opening: ArrayLike, dead_zones: ArrayLike) -> NDArray[np.floating]:
    """The command that opens a valve so far: the inverse of `valve_opening`, 0 for 0.

    >>> valve_command([0.5, 0.0, -1.0], (0.07, 0.07)).round(3)
    array([ 0.535,  0.   , -1.   ])
    """
    x = 1.0 * np.asarray(opening)
    zone = by_direction(x, dead_zones)
    return np.asarray(np.sign(x) * zone + (1 - zone) * x)


def limit_command(machine: Machine, u: ArrayLike) -> NDArray[np.floating]:
    """The command that reaches the valve: whole counts, clipped to the limit. Paper: Sec. 3.2

    >>> limit_command(BROKK_170, [1.0, 0.5, -1.0]) * 127
    array([ 80.,  64., -80.])
    """
    u = 1.0 * np.asarray(u)  # whole numbers become floats
    counts = np.clip(np.rint(u * PWM_MAX), -machine.pwm_limit, machine.pwm_limit)
    return np.asarray(counts / PWM_MAX, u.dtype)


def encode_pwm(u: ArrayLike) -> NDArray[np.uint8]:
    """Byte on the bus for a command `u` in [-1, 1] (...).

    With m = 127 u in whole counts: m >= 0 -> m, m < 0 -> 255 - |m|.

    Paper: Sec. 3.2 (the pairs 80/175 and 50/205 sum to 255). ValueError: `u` outside [-1, 1].

    >>> encode_pwm(np.array([80, -80, 50, -50, 0]) / 127).tolist()
    [80, 175, 50, 205, 0]
    """
    u = np.asarray(u, float)
    require(bool((np.abs(u) <= 1).all()), "u", "within [-1, 1]", u.tolist())
    counts = np.rint(u * PWM_MAX).astype(int)
    return np.asarray(np.where(counts < 0, 255 + counts, counts), np.uint8)


def decode_pwm(u_byte: ArrayLike) -> NDArray[np.float64]:
    """Command in [-1, 1] for a byte (...); 0 and 255: idle. Paper: Sec. 3.2

    >>> decode_pwm([80, 175, 0, 255]) * 127
    array([ 80., -80.,   0.,   0.])
    """
    u_byte = np.asarray(u_byte).astype(int)
    return np.asarray(np.where(u_byte > PWM_MAX, u_byte - 255, u_byte) / PWM_MAX)


def read_encoder(machine: Machine, q: ArrayLike) -> NDArray[np.floating]:
    """What encoders report for true angles `q` (..., n): whole counts, of the same float type.

    >>> read_encoder(BROKK_170, [0.0, 0.001, 0.002, 1.0, 0.0]).round(4)
    array([0.    , 0.0015, 0.0015, 1.0002, 0.    ])
    """
    q = 1.0 * np.asarray(q)
    return np.asarray(np.rint(q / machine.encoder_step) * machine.encoder_step, q.dtype)
