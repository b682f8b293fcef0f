"""Task-space control of a hydraulic machine, learned from its logs: the paper as readable NumPy.

Chain: machine -> logs -> actuator nets -> policy -> comparison on the machine. "Simulation" is the
learned nets, "machine" the analytic plant (or a real machine on the bus), which the learner never
sees. Nothing in this package is a safety function.

Read the files of this folder in the order machine, kinematics, actuator, env, ppo, jacobian, hw.

Conventions: SI units and radians; base frame with z up; joints in the order of `Machine.joints`;
the last axis of an array runs over joints or x, y, z, leading axes are batches (...).

Glossary:
    tick          one control period, 1/rate (of the Brokk 1/20 s)
    q, q_dot      joint angle [rad], joint velocity [rad/s]; of a prismatic joint [m], [m/s]
    u             command, -1 to 1 of the full one; `encode_pwm` makes its byte on the bus
    p, v          position [m] and velocity [m/s] of the tool tip
    v_goal        velocity that the tool should have [m/s]
    J, W          Jacobian of the tool position; weights of the damped least squares
    k, w0         Nakamura's damping constant [m^2]; manipulability [m^3] below which it acts
    H             samples of history: 13, now and the last 0.6 s
    driven        moved by the controller; the other joints are locked, set by the operator
    plant         the analytic equations that play the machine
    actuator net  one small net per joint: history in, velocity out
    counts        of a command: 127 are full; of an encoder: `encoder_step` each
    spool         slides in a valve and opens it, up or down: position -1..1
    activation    0..1, state of a valve: it closes when idle and answers late from there
    dead zone     commands too small to open a valve
    opening       what a command opens a valve beyond the dead zone, [-1, 1]
    resolved      joint velocities from a tool velocity by damped least squares
    heading       frame with x outward from the slew axis to the tool, z up
    error integral  leaky integral of the velocity error [m]
    drift         distance of the tool from the line that it should follow [m]
    valve travel  sum of all changes of a command, in commands of full scale
    free run      nets that go on from their own predictions under recorded commands
"""

import os

# Before NumPy is imported: its BLAS threads, waiting for work, would take the cores from torch's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from brokk_min.machine import BROKK_170, Joint, Machine

__version__ = "0.2.0"
__all__ = ["BROKK_170", "Joint", "Machine", "__version__"]
