"""Our fit: that of the paper, with what `beyond` adds and the settings ask for.

Only what fits imports torch, because the help of the command reads the settings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from brokk_min import fit as paper
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.net_ensemble import together
from brokk_min.beyond.valve_nets import ValveNet, valve_inputs
from brokk_min.fit import FitConfig, Log, TrainingSet
from brokk_min.machine import Array, Machine

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class OurFitConfig(FitConfig):
    """How the nets are fitted: the settings of `fit`, and those of `beyond`."""

    weight_decay: float = 0.0  # 0.3 for logs of a few minutes
    rollout: int = 8  # ticks of the errors in the last third of the steps (paper: 1)
    valve: bool = True  # nets read what commands open; --no-valve: the commands (paper)
    members: int = 5  # such nets a joint, 1 of others; their mean counts (beyond.net_ensemble)
    newest_only: bool = False  # do they read commands and the newest angle and velocity alone?


# Sec. 3.3: errors of one step, commands as they are
PAPER_RECIPE: dict[str, Any] = {"rollout": 1, "valve": False, "members": 1}


class ValveTrainingSet(TrainingSet):
    """A `TrainingSet` of nets that read `valve_inputs`; dead zones are (n, 2), float32."""

    def __init__(self, log: Log, machine: Machine, zones: Array) -> None:
        self.zones = zones
        super().__init__(log, machine)

    def read(self, signals: Array) -> Array:
        """What nets read of each sample, (N, n, 4): histories of one sample."""
        return np.asarray(valve_inputs(signals[..., None].transpose(1, 2, 0, 3), self.zones))

    def inputs(self, history: Tensor) -> Tensor:
        """`valve_inputs`, (..., n, 4 H) of histories (..., n, 3, H)."""
        import torch

        inputs: Tensor = valve_inputs(history, torch.from_numpy(self.zones), torch)
        return inputs


def fit_nets(
    log: Log, config: OurFitConfig, seed: int, machine: Machine, name: str = ""
) -> ActuatorNet:
    """The nets of each joint of a log, as `brokk_min.fit.fit`, whose nets `PAPER_RECIPE` gives.

    Without a `name` the machine is unknown: each joint has one net that reads commands as they are.
    """
    if not (name and config.valve):
        config = replace(config, valve=False, members=1)
    fit_weights = paper.fit_weights
    if config.rollout > 1 or config.weight_decay or config.newest_only:
        from brokk_min.beyond import free_runs

        ours = (config.rollout, config.weight_decay, config.newest_only)
        fit_weights = partial(free_runs.fit_weights, ours=ours)
    index = [machine.names.index(joint) for joint in log.joints] if config.valve else []
    zones = machine.dead_zones[index].astype(np.float32)
    data = ValveTrainingSet(log, machine, zones) if config.valve else TrainingSet(log, machine)
    seeds = range(seed * config.members, (seed + 1) * config.members)
    each = [data.nets(fit_weights(data, config, one), config, seed, name) for one in seeds]
    if not config.valve:
        return each[0]
    nets = [ValveNet(**vars(net), dead_zones=zones) for net in each]
    return nets[0] if len(nets) == 1 else together(nets, nets[0].training)
