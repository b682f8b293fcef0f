"""A small telescopic crane: slew, lift, and a telescope that slides, at 10 Hz. Numbers assumed.

The telescope is a prismatic joint: its q is in metres and is added to d, along the z axis that the
row before it turned into the boom. At q = 0 the boom is level and retracted, 3 m from the lift's
pivot.

    brokk-min collect --machine telescopic_crane.py:TELESCOPIC_CRANE --out log.npz
"""

import numpy as np

from brokk_min.actuator import Cylinder, Hydraulics
from brokk_min.machine import Joint, Machine

ZONE = (0.10, 0.10)  # dead zone of every valve up and down, of full command

# fmt: off
SLEW = Joint(
    name="slew", driven=True,
    a=0.0, alpha=np.pi / 2, d=1.2, theta=0.0,  # m, height of the lift's pivot; its axis is level
    q_min=-2.5, q_max=2.5,  # rad
    q_dot_up=0.25, q_dot_down=0.25,  # rad/s at the command limit
    encoder_node=0x31,
    dead_zone=ZONE,
)
LIFT = Joint(
    name="lift", driven=True,
    a=0.0, alpha=np.pi / 2, d=0.0, theta=np.pi / 2,  # z now along the boom, x across it, upwards
    q_min=-0.2, q_max=1.2,
    q_dot_up=0.15, q_dot_down=0.22,
    encoder_node=0x32,
    dead_zone=ZONE,
)
TELESCOPE = Joint(
    name="telescope", driven=True, kind="prismatic",
    a=0.0, alpha=0.0, d=3.0, theta=0.0,  # m, retracted
    q_min=0.0, q_max=1.8,  # m
    q_dot_up=0.25, q_dot_down=0.30,  # m/s
    encoder_node=0x33, encoder_zero=5000, encoder_sign=-1,
    encoder_step=2e-4,  # m a count, of a linear encoder
    dead_zone=ZONE,
)
TELESCOPIC_CRANE = Machine(
    name="telescopic_crane",
    joints=(SLEW, LIFT, TELESCOPE),
    rate=10.0,  # Hz
    pwm_limit=100,
    encoder_bits=14,
    velocity_samples=3,
    history=7,  # samples: 0.6 s
    tool_speed=0.3,
    ground=0.0,
    valve_frame_id=0x220, controller_node=0x40,
    hydraulics=Hydraulics(  # of the analytic plant
        {"slew": Cylinder(rod=0.20), "lift": Cylinder(1.0, 0.4, 0.6, 0.008, (0.047, 0.069))},
        pump_flow=0.0020,
    ),
)
# fmt: on
