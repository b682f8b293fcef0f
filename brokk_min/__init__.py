"""Task-space control of a hydraulic machine, learned from its logs: the paper as readable NumPy.

Chain: machine -> logs -> actuator nets -> policy -> comparison on the machine. The machine here is
an analytic plant that the learner never sees; nothing in this package is a safety function.

Conventions: SI units and radians; base frame with z up; joints in the order of `Machine.joints`; the
last axis runs over joints or x, y, z and leading axes are batches; every tick lasts 1/20 s.

Glossary:
    q, q_dot    joint angle [rad], joint velocity [rad/s]
    u           command in [-1, 1] of full valve opening; `u_byte` is its code on the bus
    v, p        velocity [m/s] and position [m] of the tool tip
    J, W        Jacobian of the tool position by the driven joints, weights of the least squares
    k, w0       Nakamura's damping constant and the manipulability below which damping sets in
    H           samples of history (13: now and the last 0.6 s)
    driven      joints that the controller moves; the others are locked, set by the operator
"""

import os

# Before NumPy is imported: its BLAS threads, waiting for work, would take the cores from torch's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from brokk_min.machine import BROKK_170, Joint, Machine

__version__ = "0.1.0"
__all__ = ["BROKK_170", "Joint", "Machine", "__version__"]
