"""The gradient through the simulation (120 minutes).

The simulation is made of nets and kinematics, so the rewards have derivatives by the commands. They
come from one walk backwards, backpropagation through time. Its costate is the derivative of all
rewards to come by the state. The state is a history h (3, H) and an angle q for each joint:

    q_dot = net(h with the command u_t in it)
    q_{t+1} = q_t + dt q_dot
    h_{t+1}: each row moves on by one sample; newest are q_{t+1}, the slope of the last angles, u_t

The rows of h are angles, velocities and commands, as in exercise 6. Given are, for each tick,
dr/dq_dot (by v_tool = J q_dot) and dq_dot/dh, the derivative of the net by all 3 H inputs, the
command of the tick among them (row 2, last). What is left is the bookkeeping of the shift. There
the errors are: the net reads a command in this tick, and again in twelve ticks to come.

Go backwards from the last tick with costates of zero. In each tick:

1. Discount the costates of h and q by gamma.
2. What the newest velocity of h_{t+1} brings goes to the angles that it was made of (`slope`).
3. The newest angle of h_{t+1} is q_{t+1}: add its costate to that of q.
4. q_dot moves q by dt q_dot, and makes this tick's reward: its derivative.
5. q_dot comes from the net: its derivative times dq_dot/dh is the costate of what the net read. To
   its command row add that of h_{t+1}: both are the same row, u_t last. The last is dR_t/du_t.
6. Shift back to h_t. Sample j of the angles and velocities of h_{t+1}, and of the command row of
   step 5, was sample j + 1 of h_t. The newest of h_{t+1} have gone in the steps 2, 3 and 5. The
   oldest command of h_t reaches nothing: zero.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from brokk_min import env
from brokk_min.actuator import ActuatorNet
from brokk_min.env import TaskConfig
from brokk_min.identification.files import SHIPPED
from brokk_min.kinematics import estimate_velocity
from brokk_min.learning import simulation_gradient
from brokk_min.learning.policy import load_policy
from brokk_min.learning.simulation_gradient import Ticks, local_derivatives
from brokk_min.machine import BROKK_170, Array, Machine
from exercises.verdict import expect

TASK = TaskConfig(valve_cost=0.0, integral_cost=0.0)
SOLUTION = "brokk_min/learning/simulation_gradient.py: action_gradients"


def command_gradients(machine: Machine, net: ActuatorNet, ticks: Ticks, gamma: float) -> Array:
    """dR_t/du_t (T, num, n_driven): discounted rewards to come by each command. No costs, no stops.

    `by.dr_dq_dot` is (T, num, n_driven), `by.dq_dot_dh` (T, num, n_driven, 3, H). No latents.
    """
    by = local_derivatives(machine, net, ticks, gamma, TASK)
    window = machine.velocity_samples
    slope = estimate_velocity(np.eye(window), window, machine.dt)  # of h's newest velocity by q
    raise NotImplementedError(by.dr_dq_dot.shape, by.dq_dot_dh.shape, slope.shape)


def simulate(machine: Machine, net: ActuatorNet, ticks: int) -> Ticks:
    """Two machines in motion, away from all stops."""
    rng = np.random.default_rng(0)
    poses = np.array([[0.0, 0.5, 0.6, 1.7, 1.0], [0.5, 0.5, 0.7, 1.8, 1.1]])
    state = env.initial_state(machine, poses, [0.1, -0.1, 0.1], plant=False)
    states, commands = [], []
    for _ in range(12 + ticks):
        u = np.zeros((2, machine.n), np.float32)
        u[:, machine.driven] = rng.uniform(0.15, 0.5, (2, 4)) * rng.choice([-1, 1], (2, 4))
        states.append(state)
        commands.append(u)
        state = env.transition(machine, net, state, u)
    names = ("q", "true_history", "v_goal", "error_integral")
    arrays = [np.stack([getattr(s, name) for s in states[12:]]) for name in names]
    u = np.array(commands[12:])
    return Ticks(*arrays, u, np.ones_like(u[..., :1]), np.zeros(u.shape[:2], bool))


def our_gradients(machine: Machine, net: ActuatorNet, ticks: Ticks, gamma: float) -> Array:
    """The package's answer: its gradient by actions, without the derivative of `action_to_pwm`."""
    by_action = simulation_gradient.action_gradients(machine, net, ticks, gamma, TASK)
    return by_action / simulation_gradient.compensation_derivative(machine, ticks.u)


def check(command_gradients: Callable[..., Array]) -> None:
    """One tick, two ticks, then twenty."""
    net = load_policy(SHIPPED / BROKK_170.name / "policy.npz", BROKK_170).net
    net = replace(net, weights=tuple(weight.astype(float) for weight in net.weights))
    hints = {
        1: "One tick: dr/dq_dot times dq_dot/du, the newest command, and nothing else.",
        2: "Two ticks: the command acts again as the second newest one, and through the angle.",
        6: "Six ticks: the slope of the newest angles and the shift of all three rows.",
        20: "Twenty ticks: what is older than 13 samples is forgotten.",
    }
    for count, why in hints.items():
        ticks = simulate(BROKK_170, net, count)
        wanted = our_gradients(BROKK_170, net, ticks, 0.95)
        got = np.asarray(command_gradients(BROKK_170, net, ticks, 0.95))
        expect(f"{count} ticks: shape", got.shape, wanted.shape)
        what = f"{count} ticks: gradients of the first command"
        scale = np.abs(wanted).max()
        expect(what, got[0] / scale, wanted[0] / scale, why, 1e-3)
        expect(f"{count} ticks: all gradients", got / scale, wanted / scale, why, 1e-3)
    print(f"derivative of 20 rewards by the first commands: {wanted[0, 0].round(3)}")
