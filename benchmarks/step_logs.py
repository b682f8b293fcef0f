"""Step-response logs of excavators, drawn by a seed, and the scores of nets fitted to them.

    python -m benchmarks.step_logs FOLDER [first seed] [last seed] [options of fit ...]

Each recording has steps of one joint (boom, arm, bucket) up and down with one duty, at 100 Hz, a
few minutes in all. `brokk-min fit` fits nets to five duties and scores them on two others. The
equations are not those of the package's plant; all ranges are assumed. Every other machine logs
velocities.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min.identification.logs import Log, Recording, write_log
from brokk_min.machine import Array

JOINTS = ("boom", "arm", "bucket")
DUTIES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
RATE = 100.0  # Hz
DT = 1 / RATE


def draw_machine(rng: np.random.Generator) -> dict[str, Any]:
    """Numbers of a machine, per joint (3,), or per joint and direction, up and down (3, 2)."""
    sides = (3, 2)
    return {
        "delay": rng.uniform(0.2, 0.6, sides),  # s, of a valve that opens
        "close": rng.uniform(0.4, 0.9, sides),  # delay of one that closes, of `delay`
        "dead_zone": rng.uniform(0.0, 0.35, sides),  # of full duty
        "exponent": rng.uniform(0.6, 1.6, sides),  # of the valve's curve
        "largest": rng.uniform(0.75, 1.2, sides),  # opening
        "fastest": [[0.4], [0.6], [1.0]] * rng.uniform(0.7, 1.3, sides),  # rad/s
        "omega": rng.uniform([6.0, 6.0, 5.0], [12.0, 12.0, 9.0]),  # rad/s, of the oil
        "zeta": rng.uniform([0.6, 0.6, 0.25], [1.0, 1.0, 0.5]),  # its damping
        "load": rng.uniform(0.05, 0.3, 3),  # of the speed, by gravity
        "lever": rng.uniform(0.1, 0.35, 3),  # of the speed, by the cylinder's lever arm
        "low": np.array([-0.6, -2.4, -2.2]) + rng.uniform(-0.2, 0.2, 3),  # rad
        "range": np.array([1.4, 1.7, 2.4]) + rng.uniform(-0.2, 0.2, 3),  # rad
        "cushion": rng.uniform(0.02, 0.15, 3),  # rad before a stop in which the joint brakes
        "repeats": rng.integers(1, 3),
        "hold": rng.uniform([1.5, 2.5], [2.5, 4.5]),  # s, shortest and longest step
        "noise_q": rng.uniform(0.0005, 0.002),  # rad
        "noise_q_dot": rng.uniform(0.005, 0.02),  # rad/s
        "engine": rng.uniform(0.002, 0.01),  # rad/s, vibration at 12 Hz
    }


def steps(machine: dict[str, Any], duty: float, rng: np.random.Generator) -> Array:
    """Command (T,) up and down, once or twice, with pauses."""
    parts = [np.zeros(100)]
    for side in [1, -1] * machine["repeats"]:
        parts.append(np.full(int(RATE * rng.uniform(*machine["hold"])), side * duty))
        parts.append(np.zeros(int(RATE * rng.uniform(1.5, 2.5))))
    return np.concatenate(parts)


def openings(machine: dict[str, Any], j: int, u: Array) -> Array:
    """Opening (T, 2) of the valve of joint `j` up and down, after its delays."""
    result = []
    for side, sign in enumerate((1, -1)):
        command = np.maximum(sign * u, 0)
        late = int(RATE * machine["delay"][j, side])
        soon = int(late * machine["close"][j, side])
        later = [np.concatenate([np.zeros(k), command[: len(u) - k]]) for k in (late, soon)]
        zone = machine["dead_zone"][j, side]
        x = np.clip((np.minimum(*later) - zone) / (1 - zone), 0, machine["largest"][j, side])
        result.append(x ** machine["exponent"][j, side])
    return np.stack(result, axis=1)


def steady_speed(machine: dict[str, Any], j: int, opening: Array, q: Array) -> float:
    """Speed of joint `j` [rad/s] after a while, at angles `q` (3,)."""
    level = np.cos(q[: j + 1].sum())  # 1: the link is horizontal
    low, width = machine["low"][j], machine["range"][j]
    lever = 1 + machine["lever"][j] * np.sin(q[j] - low - width / 2)
    load = 1 - machine["load"][j] * level * np.array([1, -1])
    speed = float(lever * (machine["fastest"][j] * opening * load) @ [1, -1])
    left = low + width - q[j] if speed > 0 else q[j] - low
    return speed * float(np.clip(left / machine["cushion"][j], 0.1, 1))


def record(
    machine: dict[str, Any], j: int, duty: float, rng: np.random.Generator, name: str
) -> Recording:
    """Steps of joint `j` at one duty, as an encoder and a gyroscope have them."""
    command = steps(machine, duty, rng)
    opening = openings(machine, j, command) * (1 + 0.03 * rng.standard_normal())  # warmth
    low, high = machine["low"], machine["low"] + machine["range"]
    start = rng.uniform(0.1, 0.9, 3)
    start[j] = rng.uniform(0.02, 0.25)
    q = low + start * machine["range"]
    omega, zeta = machine["omega"][j], machine["zeta"][j]
    v = a = 0.0
    angles, speeds = np.tile(q, (len(command), 1)), np.zeros((len(command), 3))
    for t in range(len(command)):  # v'' = omega^2 (steady - v) - 2 zeta omega v'
        angles[t, j], speeds[t, j] = q[j], v
        a += DT * (omega**2 * (steady_speed(machine, j, opening[t], q) - v) - 2 * zeta * omega * a)
        v += DT * a
        q[j] += DT * v
        if not low[j] <= q[j] <= high[j]:
            q[j], v, a = np.clip(q[j], low[j], high[j]), 0.0, 0.0
    time = DT * np.arange(len(command))[:, None]
    speeds += machine["engine"] * np.sin(2 * np.pi * (12 * time + rng.uniform(size=3)))
    speeds += machine["noise_q_dot"] * rng.standard_normal(speeds.shape)
    angles += machine["noise_q"] * rng.standard_normal(angles.shape)
    u = np.zeros_like(angles)
    u[:, j] = command
    return Recording(name, u, angles, speeds)


def make_logs(folder: Path, seed: int) -> tuple[Path, Path]:
    """Write the logs of one machine: to fit to, to score on."""
    rng = np.random.default_rng(seed)
    machine = draw_machine(rng)
    order = rng.permutation(DUTIES)
    paths = []
    for part, duties in (("train", np.sort(order[2:])), ("test", np.sort(order[:2]))):
        recordings = [
            record(machine, j, duty, rng, f"{joint}_{duty:.0%}")
            for j, joint in enumerate(JOINTS)
            for duty in duties
        ]
        paths.append(folder / f"{part}_{seed}.npz")
        write_log(paths[-1], Log(JOINTS, tuple(recordings), seed % 2 == 1, RATE))
    return paths[0], paths[1]


def ratios(folder: Path, seed: int, options: list[str]) -> dict[str, list[float]]:
    """Errors of free runs of nets by those of the linear model, (3,) of each horizon."""
    train, test = make_logs(folder, seed)
    net, scores = folder / f"net_{seed}.npz", folder / f"fit_{seed}.json"
    fit = [sys.executable, "-m", "brokk_min", "fit", str(train), "--test", str(test), *options]
    subprocess.run([*fit, "--out", str(net), "--json", str(scores)], check=True)
    joints = json.loads(scores.read_text())["joints"]
    return {
        horizon: [
            joints[j]["free_run"][horizon]["velocity_rmse"]
            / joints[j]["linear"]["free_run"][horizon]["velocity_rmse"]
            for j in JOINTS
        ]
        for horizon in ("1", "5", "10")
        if all(horizon in joints[j]["free_run"] for j in JOINTS)  # some recordings are short
    }


def main() -> None:
    """Logs, nets and ratios of some machines."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    first, last = (int(seed) for seed in (sys.argv[2:4] or (0, 3)))
    rows = []
    for seed in range(first, last + 1):
        rows.append(ratios(folder, seed, sys.argv[4:]))
        for horizon, row in rows[-1].items():
            print(f"machine {seed}, {horizon:>2} s:", *(f"{x:.2f}" for x in row), flush=True)
    print("median, 5 s:", *np.median([row["5"] for row in rows], axis=0).round(2))


if __name__ == "__main__":
    main()
