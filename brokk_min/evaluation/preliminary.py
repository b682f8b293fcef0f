"""What is measured before nets are trusted: preliminary tests and sim-to-real gap.

The paper's tests are put to a machine (the analytic plant) and to its nets side by side. Angles are exact
and velocities are means over a tick, without encoder and estimator: what is compared is the motion.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from brokk_min import kinematics
from brokk_min.actuator import ActuatorNet, select_nets
from brokk_min.evaluation.figures import Panel, plot_panels
from brokk_min.identification import excitation, fitting
from brokk_min.identification import validation as scores
from brokk_min.identification.fitting import FitConfig
from brokk_min.identification.logs import RETURN, Log
from brokk_min.identification.validation import (
    Simulator,
    named_times,
    net_simulator,
    plant_simulator,
    response_times,
    step_velocity,
    steps,
)
from brokk_min.machine import BROKK_170, PWM_MAX, Array, Machine, encode_pwm

STARTS = {
    BROKK_170.name: (1.5, 0.5, 0.58, 1.71, 1.24)
}  # rad, paper: q_s; other machines start mid range
SWEEP_S = 40.0  # s, assumed: long enough for the slower sweep of the Brokk's slowest joint
GAP_S, GAP_RUNS = 30.0, 20  # s, paper; sequences that the figure's one is compared with


def driven_mover(machine: Machine, net: ActuatorNet) -> Simulator:
    """Nets for the driven joints of a machine; the others rest."""
    move = net_simulator(select_nets(machine, net))

    def all_joints(q: Array, u: Array) -> Array:
        angles = np.repeat(q[None], len(u) + 1, axis=0)
        angles[..., machine.driven] = move(q[..., machine.driven], u[..., machine.driven])
        return angles

    return all_joints


def movers(machine: Machine, net: ActuatorNet) -> dict[str, Simulator]:
    """Both, by the names they have in figures."""
    return {"machine": plant_simulator(machine), "nets": driven_mover(machine, net)}


# --- preliminary tests ------------------------------------------------------------------------------


def sweeps(machine: Machine, move: Simulator, joint: int, u: Array) -> list[Array]:
    """A joint from stop to stop under each row of constant commands `u` (k, n), the others from mid range.

    Returns:
        Angle [rad] and velocity [rad/s] until it stands, (2, T) for each row.

    Paper: Sec. 3.2 (actuation range, direction; coupling where the others have commands)
    """
    low, high = machine.column("q_min"), machine.column("q_max")
    q = np.tile((low + high) / 2, (len(u), 1))
    q[:, joint] = np.where(u[:, joint] > 0, low[joint], high[joint])
    angles = move(q, np.tile(u, (round(SWEEP_S * machine.rate), 1, 1)))[..., joint].T
    velocities = np.diff(angles) * machine.rate
    ends = [1 + int(np.max(np.flatnonzero(v), initial=0)) for v in velocities]
    return [
        np.array([q[1 : t + 1], v[:t]]) for q, v, t in zip(angles, velocities, ends, strict=True)
    ]


def other_commands(machine: Machine, joint: int) -> Array:
    """The driven joints beside `joint` at the limit: all down but the last up. Paper: u1, u3 175, u4 80"""
    u, others = np.zeros(machine.n), machine.driven[machine.driven != joint]
    u[others] = -machine.pwm_limit / PWM_MAX
    u[others[-1:]] *= -1
    return u


# --- sim-to-real gap --------------------------------------------------------------------------------


class Gap(NamedTuple):
    """The same commands on machine and nets: nets minus machine, (T, runs, ...)."""

    q: Array  # rad, (..., n)
    q_dot: Array  # rad/s
    p_tool: Array  # m, (..., 3)
    v_tool: Array  # m/s


def sim_to_real(machine: Machine, net: ActuatorNet, seed: int) -> Gap:
    """Play sequences of 30 s that move several joints at once from q_s. Paper: Sec. 4.1, Fig. 5"""
    middle = (machine.column("q_min") + machine.column("q_max")) / 2
    start = np.array(STARTS.get(machine.name, middle))
    log = excitation.task_log(machine, GAP_RUNS * 5 // 4, GAP_S, np.random.default_rng(seed), start)
    u = np.stack(
        [r.u for i, r in enumerate(log.recordings) if i % 5 < 4], axis=1
    )  # driven joints move
    motion = []
    for move in movers(machine, net).values():
        q = move(np.tile(start, (GAP_RUNS, 1)), u)
        p = kinematics.tool_position(kinematics.forward_kinematics(machine, q))
        motion.append(
            (q[1:], np.diff(q, axis=0) * machine.rate, p[1:], np.diff(p, axis=0) * machine.rate)
        )
    plant, nets = motion
    return Gap(*(simulated - real for real, simulated in zip(plant, nets, strict=True)))


# --- the paper's two figures and their numbers --------------------------------------------------------


class Tests(NamedTuple):
    """The preliminary tests of one mover: angle and velocity (2, T) by label, and a step of `joint`."""

    sweeps: dict[str, Array]  # by PWM byte
    coupling: dict[str, Array]
    angles: Array  # around steps of the driven joints, see `steps`


def preliminary_tests(machine: Machine, move: Simulator) -> Tests:
    """All preliminary tests with the last driven joint, the paper's q5. Paper: Sec. 3.2, Fig. 2"""
    joint, limit = int(machine.driven[-1]), machine.pwm_limit
    slow, level = (
        round(5 / 8 * limit),
        np.full(machine.n, limit / PWM_MAX),
    )  # 50 and 80 of the Brokk
    counts, others = np.array([slow, limit, -limit, -slow, limit]), other_commands(machine, joint)
    u = np.where(np.arange(5)[:, None] < 4, 0.0, others)
    u[:, joint] = counts / PWM_MAX
    *alone, together = sweeps(machine, move, joint, u)
    by_byte = {f"u = {encode_pwm(c / PWM_MAX)}": s for c, s in zip(counts, alone, strict=False)}
    before = (level + machine.dead_zone) / 2
    ends = machine.column("q_min"), machine.column("q_max")
    angles = steps(move, *ends, level, before, max(round(1.5 * machine.rate), 2 * machine.history))
    return Tests(by_byte, {"alone": alone[1], "with the others": together}, angles)


def run(machine: Machine, net: ActuatorNet, seed: int) -> dict[str, Any]:
    """Numbers of both figures, for JSON [rad/s, s, rad, m, m/s]. Paper: Sec. 3.2 and 4.1

    The sim-to-real gap is that of the first sequence, as in the figure, with its spread over all.
    """
    tests = {name: preliminary_tests(machine, move) for name, move in movers(machine, net).items()}
    plant, nets = tests.values()
    names, driven = [machine.names[i] for i in machine.driven], machine.driven
    return {
        "joint": names[-1],
        "sweep": {u: _sweep_numbers(plant.sweeps[u], nets.sweeps[u]) for u in plant.sweeps},
        "coupling_rms": {name: _apart(*t.coupling.values()) for name, t in tests.items()},
        "response_time": {
            name: named_times(response_times(t.angles, machine.rate)[..., driven], names)
            for name, t in tests.items()
        },
        "sim_to_real": _gap_numbers(machine, sim_to_real(machine, net, seed)),
    }


def _sweep_numbers(plant: Array, nets: Array) -> dict[str, float]:
    peaks = (float(np.abs(s[1]).max()) for s in (plant, nets))
    return {
        "machine_peak": next(peaks),
        "nets_peak": next(peaks),
        "difference_rms": _apart(plant, nets),
    }


def _apart(one: Array, two: Array) -> float:
    """RMS difference of two sweeps' velocities at the same angles, the outer twentieths left out."""
    at = np.linspace(one[0].min(), one[0].max(), 102)[6:-6]
    curves = (np.interp(at, *s[:, np.argsort(s[0], kind="stable")]) for s in (one, two))
    return float(np.sqrt(np.mean((next(curves) - next(curves)) ** 2)))


def _gap_numbers(machine: Machine, gap: Gap) -> dict[str, Any]:
    position = np.linalg.norm(gap.p_tool, axis=-1).mean(axis=0)  # m, of each run
    velocity = np.sqrt(np.mean(np.sum(gap.v_tool**2, axis=-1), axis=0))
    joints = {
        machine.names[j]: {
            "velocity_rmse": float(np.sqrt(np.mean(gap.q_dot[:, 0, j] ** 2))),
            "position_error_mean": float(np.abs(gap.q[:, 0, j]).mean()),
            "position_error_max": float(np.abs(gap.q[:, 0, j]).max()),
        }
        for j in machine.driven
    }
    tool = {"position_error_mean": float(position[0]), "velocity_rmse": float(velocity[0])}
    spread = {
        "median": float(np.median(position)),
        "max": float(position.max()),
        "runs": len(position),
    }
    return {"tool": tool, "joints": joints, "tool_position_error_mean_of_runs": spread}


def paper_recipe(
    machine: Machine, test: Log, hours: float, config: FitConfig, seed: int
) -> dict[str, dict[str, Any]]:
    """Scores on `test` and gap of nets by the paper's recipe (sines, errors of one step), for JSON.

    Paper: Sec. 3.3
    """
    log = excitation.collect(machine, hours, "sine", np.random.default_rng(seed))
    legs = tuple(r for r in log.recordings if not r.name.endswith(RETURN))
    config = replace(config, **fitting.PAPER_RECIPE)
    net = fitting.fit(
        log._replace(recordings=legs), config, seed, machine.velocity_samples, machine.name
    )
    gap = _gap_numbers(machine, sim_to_real(machine, net, seed))
    return {"test": scores.score(net, test), "sim_to_real": gap}


def plots(machine: Machine, net: ActuatorNet, seed: int) -> dict[str, Any]:
    """The paper's Fig. 2, machine above nets, and Fig. 5, by the names of their files."""
    return {"preliminary": _plot_tests(machine, net), "sim_to_real": _plot_gap(machine, net, seed)}


def _plot_tests(machine: Machine, net: ActuatorNet) -> Any:
    name = machine.names[machine.driven[-1]]
    angle, velocity, rows = f"{name} [rad]", f"velocity {name} [rad/s]", []
    for of, move in movers(machine, net).items():
        tests = preliminary_tests(machine, move)
        v = step_velocity(tests.angles, machine.rate)[:, :, 0, machine.driven[-1]]
        time = (np.arange(len(v)) + 0.5 - len(v) / 2) * machine.dt
        stepping = {"from idle": (time, v[:, 0]), "while moving": (time, v[:, 1])}
        row = [
            Panel(f"{of}: range and direction", angle, velocity, tests.sweeps),
            Panel(f"{of}: coupling", angle, velocity, tests.coupling),
            Panel(f"{of}: past movement", "time after the step [s]", velocity, stepping),
        ]
        rows.append(row)
    return plot_panels(rows)


def _plot_gap(machine: Machine, net: ActuatorNet, seed: int) -> Any:
    gap, names = sim_to_real(machine, net, seed), [machine.names[i] for i in machine.driven]
    time = np.arange(1, len(gap.q) + 1) * machine.dt

    def panel(what: str, values: Array, labels: Sequence[str]) -> Panel:
        curves = {label: (time, y) for label, y in zip(labels, values[:, 0].T, strict=True)}
        return Panel("nets - machine", "time [s]", what, curves)

    tool = [
        panel("tool velocity [m/s]", gap.v_tool, "xyz"),
        panel("tool position [m]", gap.p_tool, "xyz"),
    ]
    q, q_dot = gap.q[..., machine.driven], gap.q_dot[..., machine.driven]
    joints = [panel("joint velocity [rad/s]", q_dot, names), panel("joint angle [rad]", q, names)]
    return plot_panels([tool, joints])
