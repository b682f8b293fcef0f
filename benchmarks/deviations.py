"""What the deviations and assumptions of PAPER.md change, measured.

    python -m benchmarks.deviations [d1 ...]
    python -m benchmarks.deviations --train

Each function returns the figures of one entry of docs/deviations.md, and the name of an entry
prints that entry alone. D4, D5, D10, D11 and D14 train policies, for some eight minutes.
`benchmarks.ladder` has what the parts of our agent are worth in other learners.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.linalg import norm

from benchmarks import POLICY, ladder
from brokk_min import jacobian, kinematics, machine
from brokk_min.actuator import PLANT, ActuatorNet, estimate_velocity
from brokk_min.beyond import interface
from brokk_min.beyond.rich_excitation import RICH
from brokk_min.env import terminated
from brokk_min.evaluation import preliminary, sequences
from brokk_min.evaluation.baselines import OPTIMISED, read_gains
from brokk_min.evaluation.rollout import rollout
from brokk_min.fit import SINE, collect
from brokk_min.kinematics import forward_kinematics
from brokk_min.learning import policy
from brokk_min.learning.checkpoint import prepare
from brokk_min.learning.recipes import find_recipe
from brokk_min.machine import BROKK_170, PWM_MAX, Array

M = BROKK_170
LOW = M.column("q_min")
HIGH = M.column("q_max")
STEPS = 2_000_000  # of each training here
WORLDS, WINDOWS = 256, 8  # of D8: machines, and windows before the one that is measured
NETS_OF = ("policy.npz", "policy_critic.npz")  # shipped policies that learned on both nets
Figures = dict[str, float]


def a1() -> Figures:
    """Fraction of poses above the ground in which damping acts: all, and beyond 2.5 m."""
    q = np.random.default_rng(0).uniform(LOW, HIGH, (20_000, M.n))
    frames = forward_kinematics(M, q)
    J = kinematics.jacobian(frames)[..., M.driven]
    damped = jacobian.manipulability(J) < jacobian.manipulability_threshold(M)
    above = ~terminated(M, kinematics.lowest_point(frames))
    far = norm(kinematics.tool_position(frames)[:, :2], axis=-1) > 2.5
    return {"all": damped[above].mean(), "far": damped[above & far].mean()}


def d1() -> Figures:
    """Fraction of the goal velocity that both forms of eq4 miss, over random poses."""
    rng = np.random.default_rng(0)
    q = rng.uniform(LOW, HIGH, (4000, M.n))
    v = rng.standard_normal((4000, 3))
    J = kinematics.jacobian(forward_kinematics(M, q))[..., M.driven]
    W = jacobian.limit_weights(M, q, rng.standard_normal(q.shape))[:, M.driven]
    w0 = jacobian.manipulability_threshold(M)
    damping = jacobian.nakamura_damping(jacobian.manipulability(J), w0, 0.1) + 1e-9
    result = {}
    for name, as_printed in (("corrected", False), ("printed", True)):
        q_dot = jacobian.dls(J, W, damping, as_printed) @ v[..., None]
        missed = norm((J @ q_dot)[..., 0] - v, axis=-1) / norm(v, axis=-1)
        result[f"{name}, median"] = np.median(missed)
        result[f"{name}, mean"] = missed.mean()
    return result


def d3() -> Figures:
    """Deviation [rad/s] of two velocity estimates at a steady 0.1 rad/s and a 12-bit encoder."""
    ramp = 0.1 * M.dt * np.arange(4000) + 1e-4
    q = machine.read_encoder(M, np.tile(ramp, (M.n, 1)).T)[:, 0]
    slopes = [estimate_velocity(q[:end], M.velocity_samples, M.dt) for end in range(4, len(q) + 1)]
    return {"one tick": np.std(np.diff(q) * M.rate), "4 samples": np.std(slopes)}


def d7() -> Figures:
    """Error [m/s] of the optimised PID on plant and nets; median gap [m] of nets after 30 s."""
    ours, printed = (policy.load_policy(POLICY.with_name(name), M).net for name in NETS_OF)
    pid = read_gains(POLICY.with_name("gains.json"), M, ours)[OPTIMISED]
    start, goals = sequences.tuning_set(M, 16, seed=2)
    errors = {}
    for name, moves in (("plant", PLANT), ("our nets", ours), ("nets as printed", printed)):
        trace = rollout(M, pid, start, goals, 0.05, np.random.default_rng(0), moves)
        errors[name] = norm(goals - trace.v_tool, axis=-1).mean()
        gap = preliminary.sim_to_real(M, {"machine": PLANT, "nets": moves}, 0)
        errors[f"gap of {name}"] = np.median(norm(gap.p_tool[-1], axis=-1))
    return errors


def d8() -> Figures:
    """Weight that windows cut; part of the variance of A_t by groups due to the actions of t."""
    result = {}
    for name in ("policy.npz", "policy_paper.npz"):
        trained = policy.load_policy(POLICY.with_name(name), M)
        config = find_recipe(paper=trained.interface == "paper").learner
        assert config.log_std_end is not None
        T, gamma = config.horizon, config.gamma
        result[f"{name}, cut"] = np.mean(gamma ** np.arange(1, T + 1))
        for when, log_std in (("begins", config.log_std), ("ends", config.log_std_end)):
            own, total = np.sum([own_variance(trained, log_std, seed) for seed in range(3)], axis=0)
            result[f"{name}, {when}"] = own / total
    return result


def own_variance(trained: policy.Policy, log_std: float, seed: int) -> tuple[float, float]:
    """Variance of A_t that the actions of tick t explain, and of A_t: means over a window.

    The policy is frozen. Worlds begin in the same state and have noise of actions `a` before a
    tick, and another noise `b` from it on. If they part at t + 1 they share the actions of t, and
    if they part at t they do not, so in the first case the covariance of A_t with that of a world
    of `a` alone is larger, by the variance that the actions of t explain, given their state.
    """
    recipe = find_recipe(paper=trained.interface == "paper")
    T, num, std = recipe.learner.horizon, WORLDS, np.exp(log_std)
    config = replace(recipe.learner, num_envs=num)
    env, advantages, _ = prepare(M, trained.net, replace(recipe, learner=config), seed)
    inner: Any = env.unwrapped
    obs, rng = inner.episodes.obs, np.random.default_rng(seed)
    for _ in range(WINDOWS * T):  # until machines move as they do in training
        obs = env.step(trained.act(obs) + std * rng.standard_normal((num, len(M.driven))))[0]
    episodes, state = inner.episodes, inner.np_random.bit_generator.state
    a, b = rng.standard_normal((2, T, num, len(M.driven)))

    def world(ticks: int) -> Array:
        """Advantages (T, num) of a window with noise `a` for so many ticks, and `b` then."""
        inner.episodes, inner.np_random.bit_generator.state = episodes, state
        seen, rewards, dones, infos = episodes.obs, [], [], []
        for noise in (*a[:ticks], *b[ticks:]):
            seen, reward, terminated, truncated, info = env.step(trained.act(seen) + std * noise)
            rewards.append(torch.tensor(reward, dtype=torch.float32))
            dones.append(torch.tensor(terminated | truncated))
            infos.append(info)
        window: Any = SimpleNamespace(
            rewards=torch.stack(rewards), dones=torch.stack(dones), infos=infos
        )
        agent: Any = None  # groups ask no critic
        return np.asarray(advantages(agent, window, config)[0])

    worlds = np.stack([world(ticks) for ticks in range(T + 1)])  # the last has `a` alone
    with_action, without = worlds[1:], worlds[:-1]  # A_t of these is at [t, t]
    t = np.arange(T)
    own = (worlds[-1] * (with_action[t, t] - without[t, t])).mean()
    return float(own), float(np.square(worlds[-1]).mean())


def levels() -> Figures:
    """Fractions of samples: in the dead zone, and about the threshold of the valves."""
    result = {}
    for kind in (SINE, RICH):
        log = collect(M, 0.5, np.random.default_rng(0), excitation=kind)
        size = np.concatenate([np.abs(r.u).max(axis=1)[M.history :] for r in log.recordings])
        counts = (size * PWM_MAX).round()
        result[f"{kind.name}, in the dead zone"] = np.mean(size <= M.dead_zones.min())
        result[f"{kind.name}, 8 to 15 counts"] = np.mean((counts >= 8) & (counts <= 15))
    return result


# --- by training ----------------------------------------------------------------------------------


def train(net: ActuatorNet, muon: bool = True) -> Figures:
    """Figures of `benchmarks.ladder` of a new policy, on the nets and on the plant."""
    recipe = replace(find_recipe(), muon=muon)
    recipe = replace(recipe, learner=replace(recipe.learner, total_steps=STEPS))
    trained = ladder.train(net, recipe, 0)
    result = {}
    for name, plant in (("nets", net), ("plant", PLANT)):
        for key, value in zip(ladder.FIGURES, ladder.figures(trained, plant), strict=True):
            result[f"{name}, {key}"] = value
    return result


def trained() -> Figures:
    """D4, D5, D10, D11, D14: our agent; without a cost, a wider start, smooth angles, or Muon."""
    changes: dict[str, Any] = {"TRAVEL_COST": 0.0, "EFFORT_COST": 0.0, "INTEGRAL_COST": 0.0}
    changes |= {"WIDER": 1.0, "smooth_angles": lambda _, history: history[..., 0, -1]}
    net = policy.load_policy(POLICY, M).net  # before the changes, which it would refuse
    result = {f"ours, {name}": value for name, value in train(net).items()}
    result |= {f"by Adam, {name}": value for name, value in train(net, muon=False).items()}
    for what, new in changes.items():
        with mock.patch.object(interface, what, new):
            result |= {f"changed {what}, {name}": value for name, value in train(net).items()}
    return result


MEASURED: tuple[Callable[[], Figures], ...] = (a1, d1, d3, d7, d8, levels)


def main(words: list[str]) -> None:
    """Print the entries that are named, by default all that train nothing."""
    entries = {entry.__name__: entry for entry in MEASURED} | {"--train": trained}
    for entry in [entries[word] for word in words] or MEASURED:
        figures = ", ".join(f"{name} {value:.4g}" for name, value in entry().items())
        print(f"{entry.__name__.upper():4} {entry.__doc__}\n     {figures}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
