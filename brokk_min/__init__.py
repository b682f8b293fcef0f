"""Task-space control of a hydraulic machine, learned from its logs: the paper in NumPy and PyTorch.

The chain goes from a machine to logs, to actuator nets, to a policy, and to a comparison on the
machine. "Simulation" is the learned nets, "machine" the analytic plant or a real machine on the
bus. Nets learn from logs alone, and policies on the nets. Nothing here is a safety function.

Read the files of this folder in the order machine, kinematics, actuator, fit, jacobian, settings,
env, ppo, hw. They hold the paper's method, from a log to the byte of a valve: `fit` makes nets,
`identification.net_file` keeps them, `env` simulates with them, `learning.gym_env` hands that to
`ppo`, `learning.policy` keeps the agent, and `hw` runs it behind the gate of `can`. `beyond` holds
our improvements, one file each.

Conventions: SI units and radians; the base frame has z up; joints are in the order of
`Machine.joints`; the last axis of an array runs over joints or x, y, z, leading axes are batches.

Glossary:
    tick          one control period, 1/rate (1/20 s of the Brokk)
    q, q_dot      joint angle [rad] and velocity [rad/s]; [m] and [m/s] of a prismatic joint
    u             command, -1 to 1 of the full one; `encode_pwm` makes its byte on the bus
    v_goal        velocity that the tool should have [m/s]
    H             number of samples of the history, 13: now and the last 0.6 s
    driven        said of a joint that the controller moves; the operator sets the locked ones
    plant         what moves a machine: the analytic plant, the nets, or another simulator
    actuator net  small nets of each joint: history in, velocity out
    counts        127 counts are a full command; an encoder has `encoder_step` rad a count
    activation    state of a valve, 0 to 1: it falls while the valve is idle, and a valve answers
                  late until it has risen again
    dead zone     the commands that are too small to open a valve
    opening       how far a command opens a valve beyond the dead zone, -1 to 1
    drift         distance of the tool from the line that it should follow [m]
    valve travel  sum of all changes of a command, in commands of full scale
    free run      nets that go on from their own predictions under recorded commands
"""

__version__ = "0.3.0"
