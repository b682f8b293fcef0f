"""Our fit: that of the paper, with what `beyond` adds and the settings ask for."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from brokk_min import fit as paper
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond import free_runs
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet, valve_inputs
from brokk_min.fit import Log
from brokk_min.identification.fit_config import PAPER_RECIPE, OurFitConfig
from brokk_min.machine import Array, Machine

__all__ = ["PAPER_RECIPE", "OurFitConfig", "fit_nets"]


def fit_nets(
    log: Log, config: OurFitConfig, seed: int, machine: Machine, name: str = ""
) -> ActuatorNet:
    """The nets of each joint of a log, as `brokk_min.fit.fit`, whose nets `PAPER_RECIPE` gives.

    Without a `name` the machine is unknown: each joint has one net that reads commands as they are.
    """
    if not (name and config.valve):
        config = replace(config, valve=False, members=1)
    method = paper.fit_weights
    if config.rollout > 1 or config.weight_decay or config.newest_only:
        ours: Any = {name: getattr(config, name) for name in ("weight_decay", "newest_only")}
        method = partial(free_runs.fit_weights, ticks=config.rollout, **ours)
    if not config.valve:
        return paper.fit(log, config, seed, machine, name, method)
    index = [machine.names.index(joint) for joint in log.joints]
    zones = machine.dead_zones[index].astype(np.float32)
    data = paper.TrainingSet(log, machine, valve_reader(zones))
    seeds = range(seed * config.members, (seed + 1) * config.members)
    each = [method(data, config, one) for one in seeds]
    if config.members == 1:
        return data.nets(each[0], config, seed, name, partial(ValveNet, dead_zones=zones))
    weights = tuple(np.stack(of, axis=1) for of in zip(*each, strict=True))
    return data.nets(weights, config, seed, name, partial(NetEnsemble, dead_zones=zones))


def valve_reader(zones: Array) -> Callable[[Any], Any]:
    """`valve_inputs` of histories, NumPy's or torch's, with dead zones (n, 2)."""
    tensor = torch.from_numpy(zones)

    def inputs(history: Any) -> Any:
        numpy = isinstance(history, np.ndarray)
        return valve_inputs(history, zones) if numpy else valve_inputs(history, tensor, torch)

    return inputs
