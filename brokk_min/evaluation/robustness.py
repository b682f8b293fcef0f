"""Robustness: machines that differ from the one that the controllers were made for."""

from collections.abc import Sequence
from dataclasses import replace

from brokk_min.evaluation.baselines import with_dead_zone
from brokk_min.evaluation.metrics import Controllers, Mean, evaluate, means
from brokk_min.evaluation.sequences import Commands
from brokk_min.machine import Array, Machine


def scale_valves(machine: Machine, up: float, down: float) -> Machine:
    """The machine with other cylinder speeds up and down."""
    speeds = machine.cylinder_speeds * [up, down]
    pairs = zip(machine.joints, speeds.tolist(), strict=True)
    return replace(machine, joints=tuple(replace(j, cylinder_speed=tuple(s)) for j, s in pairs))


def variations(machine: Machine) -> dict[str, Machine]:
    """Machines unknown to the controllers, by name; all numbers assumed."""
    return {
        "nominal": machine,
        "supply flow -70 %": replace(machine, pump_flow=0.3 * machine.pump_flow),
        "valve gain -20 %": scale_valves(machine, 0.8, 0.8),
        "valve gain +20 %": scale_valves(machine, 1.2, 1.2),
        "up -15 %, down +15 %": scale_valves(machine, 0.85, 1.15),
        "dead zone 5 %": with_dead_zone(machine, 0.05),
        "dead zone 10 %": with_dead_zone(machine, 0.10),
        "delay +50 ms": replace(machine, delay=machine.delay + 0.050),
    }


def robustness(
    machine: Machine,
    controllers: Controllers,
    sequences: Sequence[Commands],
    starts: Array,
    seed: int,
) -> dict[str, dict[str, Mean]]:
    """Mean velocity error [m/s] with its interval, by variation and controller. Paper: Sec. 4.2"""
    result: dict[str, dict[str, Mean]] = {}
    for name, varied in variations(machine).items():
        runs, _ = evaluate(varied, controllers, sequences, starts, seed)
        result[name] = {c: of["all"]["velocity_error_mean"] for c, of in means(runs).items()}
    return result
