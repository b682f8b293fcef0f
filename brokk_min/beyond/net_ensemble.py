"""Several actuator nets for each joint, whose mean moves the joint.

What it changes: the paper fits one net for each joint. Here five are fitted to the same log, from
weights of other seeds, and the velocity of a joint is the mean of what its five say. Where one net
errs by chance the others do not, and a policy cannot learn to use the error of one.

What it buys: nets whose errors are no property of the machine; `fit --members 1` does without it.
The fit takes five times as long. `benchmarks.ladder` has it with the richer log and the nets that
read what a command opens.

Who was first: Hansen and Salamon (1990) for classifiers, Breiman's bagging (1996);
Lakshminarayanan et al. (2017) for seeds alone. ME-TRPO (Kurutach et al., 2018) trains policies on
ensembles of models.

It plugs into `actuator.ActuatorNet.outputs`; `identification.fitting` trains it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.machine import Array


@dataclass(frozen=True, eq=False)
class NetEnsemble(ValveNet):
    """K `ValveNet`s for each joint, in weights (n, K, I, 32), (n, K, 32), ..., (n, K, 1)."""

    def outputs(self, x: Array) -> Array:
        """The mean (n, batch) of what the K nets say of inputs (n, batch, I)."""
        return np.asarray(super().outputs(x[:, None]).mean(axis=1))


def together(nets: Sequence[ValveNet], training: Mapping[str, Any]) -> NetEnsemble:
    """The ensemble of nets that were fitted to one log from several seeds."""
    weights = tuple(np.stack(of, axis=1) for of in zip(*(n.weights for n in nets), strict=True))
    return NetEnsemble(**vars(nets[0]) | {"weights": weights, "training": training})
