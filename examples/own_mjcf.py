"""Your own MJCF in the place of the analytic plant, here an excavator with velocity servos.

A joint and an actuator of the MJCF have the name of each joint of the machine, and angles are the
machine's: alike in zero and sense. To a servo goes the speed that its valve lets through. Masses
and servos are assumed. Copy the file, and put your MJCF in the place of this one.

    brokk-min collect --machine mini_excavator.py:MINI_EXCAVATOR --plant own_mjcf.py:PLANT --out log.npz
"""  # noqa: E501

from typing import NamedTuple

import mujoco
import numpy as np

from brokk_min.machine import by_direction, valve_opening

MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"><flag contact="disable"/></option>
  <default><joint axis="0 1 0" limited="true" armature="20"/></default>
  <worldbody>
    <body name="body" pos="0 0 0.75">
      <joint name="swing" axis="0 0 1" range="-3.0 3.0"/><geom size="0.4" mass="900"/>
      <body name="boom" pos="0.30 0 0">
        <joint name="boom" range="-1.1 0.6"/>
        <geom type="capsule" size="0.1" fromto="0 0 0 1.80 0 0" mass="120"/>
        <body name="arm" pos="1.80 0 0">
          <joint name="arm" range="0.45 2.5"/>
          <geom type="capsule" size="0.08" fromto="0 0 0 1.10 0 0" mass="60"/>
          <body name="bucket" pos="1.10 0 0">
            <joint name="bucket" range="-0.2 2.0"/>
            <geom type="capsule" size="0.1" fromto="0 0 0 0.60 0 0" mass="50"/>
            <site name="tool" pos="0.60 0 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="swing" joint="swing" kv="200000"/>
    <velocity name="boom" joint="boom" kv="400000"/>
    <velocity name="arm" joint="arm" kv="200000"/>
    <velocity name="bucket" joint="bucket" kv="100000"/>
  </actuator>
</mujoco>"""


class State(NamedTuple):
    """What the plant needs to go on, of any number of machines."""

    q: np.ndarray  # rad, (..., 4)
    q_dot: np.ndarray  # rad/s


class OwnMjcf:
    """The plant of an MJCF."""

    def __init__(self, text):
        self.model = mujoco.MjModel.from_xml_string(text)  # of a file: from_xml_path
        self.data = mujoco.MjData(self.model)

    def reset(self, machine, q):
        """Machines at rest at the angles `q` [rad] (..., 4)."""
        return State(np.array(q, float), np.zeros_like(q, float))

    def step(self, machine, state, u):
        """The state after one tick of `machine.dt` seconds under the held commands `u` [-1, 1]."""
        opening = valve_opening(u, machine.dead_zones)
        fastest = [machine.column("q_dot_up"), machine.column("q_dot_down")]  # at full opening
        wanted = opening * by_direction(opening, np.stack(fastest, axis=1))  # rad/s
        q, q_dot = np.array(state.q, float), np.array(state.q_dot)
        for i in np.ndindex(q.shape[:-1]):  # one machine after the other
            q[i], q_dot[i] = self.one(machine, q[i], q_dot[i], wanted[i])
        return State(q, q_dot)

    def one(self, machine, q, q_dot, wanted):
        """Angles and velocities (4,) of one machine after a tick of these servo speeds (4,)."""
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = q, q_dot, wanted
        mujoco.mj_step(self.model, self.data, round(machine.dt / self.model.opt.timestep))
        return np.clip(self.data.qpos, *self.model.jnt_range.T), self.data.qvel


PLANT = OwnMjcf(MJCF)
