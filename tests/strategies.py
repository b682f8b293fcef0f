"""Hypothesis strategies: machines that are no Brokk, and their poses."""

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from brokk_min.actuator import Cylinder, Hydraulics
from brokk_min.machine import BROKK_170, Joint, Machine

NUMBERS = itertools.count()
SHAPES = [(), (1,), (4,), (2, 3)]  # leading axes


def reals(low: float, high: float) -> st.SearchStrategy[float]:
    """Floats without subnormals, both ends allowed."""
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def joints(draw: st.DrawFn, index: int, driven: bool, limit: float) -> tuple[Joint, Cylinder]:
    """Any DH row and range; prismatic, a slew drive, or a triangle that closes over the range.

    Its dead zones are smaller than the largest command, `limit`.
    """
    zones, speeds = reals(0.0, min(0.3, 0.9 * limit)), reals(0.01, 0.2)
    q_min = draw(reals(-2.5, 1.5))
    width = draw(reals(0.3, 2.2))
    kind = draw(st.sampled_from(["revolute", "revolute", "prismatic"]))
    slew = draw(st.booleans()) or kind == "prismatic"
    start = draw(reals(0.25, np.pi - 0.25 - width))  # the triangle's angle at q_min
    cylinder = Cylinder(
        base=0.0 if slew else draw(reals(0.5, 1.2)),
        rod=draw(reals(0.1, 0.4)),
        angle=0.0 if slew else start - q_min,
        area=draw(reals(0.002, 0.02)),
        speed=(draw(speeds), draw(speeds)),
    )
    joint = Joint(
        name=f"joint {index}",
        driven=driven,
        a=draw(reals(-1.5, 1.5)),
        alpha=draw(st.one_of(st.sampled_from([0.0, np.pi / 2, -np.pi / 2]), reals(-3.0, 3.0))),
        d=draw(reals(-1.0, 1.0)),
        theta=draw(reals(-np.pi, np.pi)),
        q_min=q_min,
        q_max=q_min + width,
        dead_zone=(draw(zones), draw(zones)),
        q_dot_up=draw(reals(0.1, 1.0)),
        q_dot_down=draw(reals(0.1, 1.0)),
        encoder_node=index + 1,
        kind=kind,
        encoder_step=draw(reals(1e-5, 2e-3)),
    )
    return joint, cylinder


@st.composite
def machines(draw: st.DrawFn) -> Machine:
    """Machines of 2 to 6 joints, some of them locked, with valves and a pump of their own."""
    n = draw(st.integers(2, 6))
    driven = draw(st.lists(st.booleans(), min_size=n, max_size=n).filter(any))
    pwm_limit = draw(st.integers(20, 127))
    rows = [draw(joints(i, own, pwm_limit / 127)) for i, own in enumerate(driven)]
    hydraulics = Hydraulics(
        {joint.name: cylinder for joint, cylinder in rows},
        delay=draw(st.sampled_from([0.0, 0.005, 0.04, 0.1, 0.13])),
        tau_spool=draw(reals(0.01, 0.1)),
        tau_cylinder=draw(reals(0.01, 0.1)),
        tau_valve_up=draw(reals(0.02, 0.3)),
        tau_valve_down=draw(reals(0.02, 0.6)),
        valve_threshold=draw(reals(0.0, 0.9)),
        pump_flow=draw(reals(0.0002, 0.003)),
    )
    return replace(
        BROKK_170,
        name=f"machine {next(NUMBERS)}",  # caches of the package hash names
        joints=tuple(joint for joint, _ in rows),
        hydraulics=hydraulics,
        q_start=(),
        rate=draw(st.sampled_from([10.0, 20.0, 25.0, 50.0])),
        pwm_limit=pwm_limit,
        ground=draw(reals(-1.0, 1.0)),
        encoder_bits=draw(st.integers(8, 20)),
    )


def poses(machine: Machine, shape: tuple[int, ...] = ()) -> st.SearchStrategy[np.ndarray]:
    """Angles (*shape, n) within the machine's range, ends included, in a read-only array."""
    low, high = machine.column("q_min"), machine.column("q_max")

    def angles(fraction: np.ndarray) -> np.ndarray:
        q = np.clip(low + (high - low) * fraction, low, high)
        q.setflags(write=False)
        return q

    return npst.arrays(np.float64, (*shape, machine.n), elements=reals(0.0, 1.0)).map(angles)


@st.composite
def posed(draw: st.DrawFn, shapes: list[tuple[int, ...]] = SHAPES) -> tuple[Machine, np.ndarray]:
    """A machine and angles with some leading axes."""
    machine = draw(machines())
    return machine, draw(poses(machine, draw(st.sampled_from(shapes))))


@st.composite
def moving(
    draw: st.DrawFn, shapes: list[tuple[int, ...]] = SHAPES
) -> tuple[Machine, np.ndarray, np.ndarray]:
    """A machine, angles, and angular velocities of the same shape; both arrays read-only."""
    machine, q = draw(posed(shapes))
    q_dot = draw(npst.arrays(np.float64, q.shape, elements=reals(-1.0, 1.0)))
    q_dot.setflags(write=False)
    return machine, q, q_dot
