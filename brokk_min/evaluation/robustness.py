"""The machine and its encoders other than the controllers know them: what robustness is measured on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from brokk_min.env import Encoder
from brokk_min.machine import Array, Machine, read_encoder, valve_opening

Sensor = Callable[[np.random.Generator], Encoder]  # a fresh encoder for each rollout


def exact(rng: np.random.Generator) -> Encoder:
    """Encoders as they are: whole counts."""
    return read_encoder


def noisy(rng: np.random.Generator) -> Encoder:
    """Encoders with normal noise of one count."""
    return lambda machine, q: read_encoder(
        machine, q + machine.encoder_step * rng.standard_normal(q.shape)
    )


def lossy(rng: np.random.Generator) -> Encoder:
    """Encoders of which one sample in 20, of all joints of a machine, is lost: the last one stands again."""
    last: list[Array] = []

    def read(machine: Machine, q: Array) -> Array:
        lost = rng.random((*q.shape[:-1], 1)) < 0.05 * len(last)
        last[:] = [np.where(lost, last[0] if last else q, read_encoder(machine, q))]
        return last[0]

    return read


def variations(machine: Machine) -> dict[str, tuple[Machine, Sensor]]:
    """The machine other than its controllers know it; all figures assumed."""

    def valves(up: float, down: float) -> Machine:
        speeds = [(up * j.speed_positive, down * j.speed_negative) for j in machine.joints]
        joints = zip(machine.joints, speeds, strict=True)
        faster = (replace(j, speed_positive=a, speed_negative=b) for j, (a, b) in joints)
        return replace(machine, joints=tuple(faster))

    return {
        "nominal": (machine, exact),
        "supply flow -20 %": (replace(machine, pump_flow=0.8 * machine.pump_flow), exact),
        "supply flow -70 %": (replace(machine, pump_flow=0.3 * machine.pump_flow), exact),
        "valve gain -20 %": (valves(0.8, 0.8), exact),
        "valve gain +20 %": (valves(1.2, 1.2), exact),
        "up -15 %, down +15 %": (valves(0.85, 1.15), exact),
        "dead zone 5 %": (replace(machine, dead_zone=0.05), exact),
        "dead zone 10 %": (replace(machine, dead_zone=0.10), exact),
        "delay +25 ms": (replace(machine, delay=machine.delay + 0.025), exact),
        "delay +50 ms": (replace(machine, delay=machine.delay + 0.050), exact),
        "encoder noise of a count": (machine, noisy),
        "one sample in 20 lost": (machine, lossy),
    }


def supply_demand(machine: Machine, u: Array) -> Array:
    """Flow that commands (..., n) ask of the pump once spools follow, as a share of its own, (...).

    Paper: Sec. 4.2
    """
    opening = valve_opening(u, machine.dead_zone)
    fastest = (machine.column(name) for name in ("speed_positive", "speed_negative"))
    flow = np.abs(machine.column("cylinder_area") * np.where(opening > 0, *fastest) * opening)
    share: Array = flow.sum(axis=-1) / machine.pump_flow
    return share
