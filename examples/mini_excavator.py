"""A mini-excavator of the 2-tonne class: swing, boom, arm, bucket. See docs/porting.md.

Every number is assumed: typical of the class, no maker's data. Boom, arm and bucket count positive
downward and inward, against the sense of the Brokk: their axes point the other way, since alpha is
-90 degrees after the swing. At q = 0 the arm is straight and level. The pit is 1 m deep.
"""

import numpy as np

from brokk_min.machine import Joint, Machine

SWING = Joint(
    name="swing",
    driven=True,
    a=0.30,  # m, from the swing axis out to the boom's foot
    alpha=-np.pi / 2,  # turns the axes behind it to the right of the arm: positive is downward
    d=0.75,  # m, height of the boom's foot
    theta=0.0,
    q_min=-3.0,
    q_max=3.0,
    cylinder_base=0.0,  # a slew motor: constant lever arm
    cylinder_rod=0.20,
    cylinder_angle=0.0,
    cylinder_area=0.0015,
    speed_positive=0.14,  # m/s at full command
    speed_negative=0.14,
    q_dot_up=0.50,  # rad/s at the command limit, as logs show it
    q_dot_down=0.50,
    encoder_node=0x21,
    encoder_zero=8192,
    encoder_sign=-1,  # mounted upside down
)
BOOM = Joint(
    name="boom",
    driven=True,
    a=1.80,
    alpha=0.0,
    d=0.0,
    theta=0.0,
    q_min=-1.1,  # up
    q_max=0.6,
    cylinder_base=0.75,
    cylinder_rod=0.30,
    cylinder_angle=1.40,
    cylinder_area=0.0030,
    speed_positive=0.12,  # gravity helps downward
    speed_negative=0.08,
    q_dot_up=0.61,
    q_dot_down=0.41,
    encoder_node=0x22,
    encoder_zero=300,
)
ARM = Joint(
    name="arm",
    driven=True,
    a=1.10,
    alpha=0.0,
    d=0.0,
    theta=0.0,
    q_min=0.45,
    q_max=2.50,  # curled in
    cylinder_base=0.80,
    cylinder_rod=0.25,
    cylinder_angle=0.0,
    cylinder_area=0.0025,
    speed_positive=0.12,
    speed_negative=0.10,
    q_dot_up=0.72,
    q_dot_down=0.60,
    encoder_node=0x23,
    encoder_sign=-1,
)
BUCKET = Joint(
    name="bucket",
    driven=True,
    a=0.60,  # to the middle of the cutting edge
    alpha=0.0,
    d=0.0,
    theta=0.0,
    q_min=-0.2,
    q_max=2.0,
    cylinder_base=0.60,
    cylinder_rod=0.18,
    cylinder_angle=0.45,
    cylinder_area=0.0020,
    speed_positive=0.10,
    speed_negative=0.11,
    q_dot_up=1.14,
    q_dot_down=1.26,
    encoder_node=0x24,
)


MINI_EXCAVATOR = Machine(
    name="mini_excavator",
    joints=(SWING, BOOM, ARM, BUCKET),
    rate=25.0,  # Hz; logs may be faster, not slower
    pwm_limit=95,  # counts of 127
    dead_zone=0.12,
    delay=0.060,  # s
    tau_spool=0.040,
    tau_cylinder=0.025,
    tau_valve_up=0.08,
    tau_valve_down=0.30,
    valve_threshold=0.70,
    spool_threshold=0.01,
    pump_flow=0.0006,  # m^3/s, 36 litres a minute
    plant_dt=0.005,
    encoder_bits=14,
    velocity_samples=5,  # another number than the Brokk's must do too
    history=14,  # samples: 0.52 s, enough for its quicker valves
    tool_speed=0.4,  # m/s
    ground=-1.0,
    valve_frame_id=0x1F0,
    controller_node=0x30,
)
