"""Controllers that learn their valves (`beyond.adaptation`), cold and warm, for comparisons."""

from collections.abc import Mapping

import numpy as np

from brokk_min.actuator import PLANT, ActuatorNet, Plant
from brokk_min.beyond.adaptation import Adaptive, Known
from brokk_min.evaluation.rollout import Together, rollout
from brokk_min.evaluation.sequences import tuning_set
from brokk_min.machine import Array, Controller, Machine
from brokk_min.settings import TaskConfig

DRIVES, PARTS, SECONDS = 16, 3, 20.0  # that warm up: so many, of so many parts of so many seconds
SEED = 7000  # of their motions, which nothing else draws


def warm_up_motions(machine: Machine, seconds: float = SECONDS) -> list[tuple[Array, Array]]:
    """Starts [rad] and goals [m/s] of parts of so many `seconds`, as those that tune the PIDs."""
    return [tuning_set(machine, DRIVES, SEED + part, seconds) for part in range(PARTS)]


def cold_and_warm(
    controllers: Mapping[str, Controller],
    net: ActuatorNet,
    machine: Machine,
    truth: Machine,
    rows: int,
    motions: list[tuple[Array, Array]],
    plant: Plant = PLANT,
    noise: float = TaskConfig.noise,
) -> dict[str, Controller]:
    """Each controller of `machine` twice: it knows nothing, or has driven `truth` for a minute.

    `rows` runs are to come; each begins with what one of the drives has learned.
    """
    many, learner = len(controllers), Adaptive(Together([*controllers.values()]), net, machine)
    for part, motion in enumerate(motions):  # of all controllers as one batch
        rng = np.random.default_rng(SEED + part)
        rollout(truth, learner, *motion, noise, rng, plant, many)
    assert learner.known is not None  # it has driven
    known = zip(*(np.split(of, many) for of in learner.known), strict=True)
    result: dict[str, Controller] = {}
    for (name, controller), learned in zip(controllers.items(), known, strict=True):
        each = Known(*(np.resize(of, (rows, *of.shape[1:])) for of in learned))
        result[f"{name}+cold"] = Adaptive(controller, net, machine)
        result[f"{name}+warm"] = Adaptive(controller, net, machine, each)
    return result
