"""A demolition arm of seven joints at 100 Hz. Numbers assumed.

Slew, four links in one plane, a swing of the tool to the side, and a roll of the tool that the
operator sets. Our valve frame has five joints, so `drive` needs another one for this machine.

    brokk-min collect --machine seven_joints.py:SEVEN_JOINTS --out log.npz
"""

import numpy as np

from brokk_min.actuator import Cylinder, Hydraulics
from brokk_min.machine import Joint, Machine

ROWS = [
    # name, driven  a [m]  alpha [rad]  d [m]  q_min, q_max [rad]  up, down [rad/s]
    ("slew", True, 0.30, np.pi / 2, 1.0, -2.5, 2.5, 0.30, 0.30),
    ("boom", True, 1.30, 0.0, 0.0, 0.0, 1.3, 0.18, 0.24),
    ("dipper", True, 1.20, 0.0, 0.0, -1.9, 0.0, 0.22, 0.30),
    ("stick", True, 0.90, 0.0, 0.0, -1.5, 0.8, 0.25, 0.35),
    ("tilt", True, 0.35, np.pi / 2, 0.0, -1.2, 1.0, 0.40, 0.40),
    ("swing", True, 0.40, -np.pi / 2, 0.0, -0.8, 0.8, 0.40, 0.40),
    ("roll", False, 0.25, 0.0, 0.0, -1.0, 1.0, 0.50, 0.50),
]
SEVEN_JOINTS = Machine(
    name="seven_joints",
    joints=tuple(
        Joint(
            name=name,
            driven=driven,
            a=a,
            alpha=alpha,
            d=d,
            theta=0.0,
            q_min=q_min,
            q_max=q_max,
            q_dot_up=up,
            q_dot_down=down,
            encoder_node=0x21 + i,
            dead_zone=(0.08, 0.08),  # up, down, of full command
        )
        for i, (name, driven, a, alpha, d, q_min, q_max, up, down) in enumerate(ROWS)
    ),
    rate=100.0,  # Hz
    pwm_limit=90,
    encoder_bits=14,
    velocity_samples=10,
    history=40,  # samples: 0.39 s
    tool_speed=0.3,
    ground=0.0,
    valve_frame_id=0x230,
    controller_node=0x40,
    hydraulics=Hydraulics({row[0]: Cylinder(rod=0.2) for row in ROWS}, pump_flow=0.0040),
)
