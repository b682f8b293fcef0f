"""Several actuator nets for each joint, whose mean moves the joint.

What it changes: the paper fits one net for each joint. Here five are fitted to the same log, from
weights of other seeds, and the velocity of a joint is the mean of what its five say. Where one net
errs by chance the others do not, and a policy cannot learn to use the error of one.

What it buys: after three million steps on five nets (`train --total-steps 3000000`) our agent has
an error of 0.0120 m/s along x, y and z and a drift of 0.015 m, on one (`fit --members 1`) 0.0124
m/s and 0.019 m (means of two seeds). The fit takes five times as long. With valves 20 % slower or
faster than in the log the agent, fully trained, errs no less.

Who was first: Hansen and Salamon (1990) for classifiers, Breiman's bagging (1996);
Lakshminarayanan et al. (2017) for seeds alone. ME-TRPO (Kurutach et al., 2018) trains policies on
ensembles of models.

It plugs into `actuator.ActuatorNet.outputs`; `identification.fitting` trains it.
"""

from dataclasses import dataclass

import numpy as np

from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.machine import Array


@dataclass(frozen=True, eq=False)
class NetEnsemble(ValveNet):
    """K `ValveNet`s for each joint, in weights (n, K, I, 32), (n, K, 32), ..., (n, K, 1)."""

    def outputs(self, x: Array) -> Array:
        """The mean (n, batch) of what the K nets say of inputs (n, batch, I)."""
        return np.asarray(super().outputs(x[:, None]).mean(axis=1))
