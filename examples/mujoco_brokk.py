"""A Brokk-like machine in MuJoCo, with weight and inertia, in the place of the analytic plant.

Geometry, ranges, dead zones and speeds are those of the `Machine`. All that MuJoCo needs besides is
assumed: masses, pressures, and by how much a load slows a cylinder. A cylinder is a tendon between
two sites, so that MuJoCo works out its lever arm; the slew has a motor with a constant one. MuJoCo
has delay, lag and relief valves of each cylinder; `flows` has what the valves and the pump add.

    brokk-min collect --plant mujoco_brokk.py:PLANT --out log.npz
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.rollout import rollout

from brokk_min.actuator import cylinder_column, cylinder_speeds, hydraulics_of, lever_arm
from brokk_min.machine import Array, Joint, Machine, by_direction, valve_opening

# All assumed.
MASSES = (500.0, 180.0, 130.0, 110.0, 200.0)  # kg of slew, boom, two links, and link with breaker
FEET = (0.0, -1.2, np.pi, 0.0, -np.pi / 4)  # rad, where cylinders begin; for the picture alone
RELIEF = 20e6  # Pa, at which relief valves open
ROD_SIDE = 0.7  # of a piston's area, on which the oil pulls
STIFFNESS = 6e6  # N per m/s by which a cylinder is slower than the flow into it
LOAD_SHARE = 0.3  # of a load's effect on the flow, which the pressure compensators leave
TAU = 0.05  # s, time constant of the flow into a cylinder
WHOLE = mujoco.mjtState.mjSTATE_FULLPHYSICS
SCENE = """
  <visual><headlight ambient=".6 .6 .6"/></visual>
  <asset><texture type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="8"/></asset>
  <worldbody>
    <light pos="4 -4 8" dir="-4 4 -8"/>
    <geom type="plane" size="9 9 1" rgba=".8 .76 .68 1"/>
    <geom type="box" pos="0 0 .5" size=".5 .4 .3" rgba=".2 .2 .22 1"/>
  </worldbody>"""
TENDON = """
  <spatial name="{0}" width=".04"><site site="foot_{0}"/><site site="rod_{0}"/></spatial>"""


class State(NamedTuple):
    """Machines side by side, as arrays of one row for each."""

    q: Array  # angles [rad], (num, n)
    awake: Array  # activation of the valves, 0..1, (num, n)
    force: Array  # of the cylinders [N], (num, n)
    physics: Array  # MuJoCo's state: motion, flows, and commands on their way


@dataclass(frozen=True)
class MujocoBrokk:
    """The plant, if wanted with a load, on a slope, or with a weaker pump."""

    load: float = 0.0  # kg at the tool
    slope: float = 0.0  # deg, by which the base leans towards +x
    pump: float = 1.0  # of the machine's pump flow

    def reset(self, machine: Machine, q: Array) -> State:
        """Machines at rest at angles `q` [rad] (num, n); their cylinders bear the weight."""
        model, data = build(machine, self.load, self.slope)
        q = np.array(q, float)
        force, physics = np.zeros_like(q), np.zeros((len(q), mujoco.mj_stateSize(model, WHOLE)))
        for i, pose in enumerate(q):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            force[i] = data.qfrc_bias / lever_arm(machine, pose)
            data.act[:] = force[i] / STIFFNESS
            for j, act in enumerate(data.act):
                past = np.full((model.actuator_history[j, 0], 1), act)
                mujoco.mj_initCtrlHistory(model, data, j, None, past)
            mujoco.mj_getState(model, data, physics[i], WHOLE)
        return State(q, np.zeros_like(q), force, physics)

    def step(self, machine: Machine, state: State, u: Array) -> State:
        """The state after one tick under the held commands `u` [-1, 1] (num, n)."""
        model, data = build(machine, self.load, self.slope)
        flow, awake = flows(machine, state, u, self.pump)
        held = flow + state.force / STIFFNESS  # so that no weight moves a cylinder without flow
        steps = round(machine.dt / hydraulics_of(machine).dt)
        physics, force = rollout(model, data, state.physics, held[:, None], nstep=steps)
        q = physics[:, -1, 1 : 1 + machine.n]  # the time stands before the angles
        q = np.clip(q, machine.column("q_min"), machine.column("q_max"))
        return State(q, awake, force[:, -1], physics[:, -1])


PLANT = MujocoBrokk()


def flows(machine: Machine, state: State, u: Array, pump: float) -> tuple[Array, Array]:
    """Speeds of the cylinders by the oil that they get [m/s] (num, n), and the valves' activation.

    A valve opens beyond its dead zone, once it has woken up. Oil flows through it by the root of
    the pressure that the load leaves (orifice equation), and all valves share one pump.
    """
    m, h, area = machine, hydraulics_of(machine), cylinder_column(machine, "area")
    x = valve_opening(u, m.dead_zones)
    called = np.abs(x) > h.spool_threshold
    tau = np.where(called, h.tau_valve_up, h.tau_valve_down)
    awake = state.awake + (1 - np.exp(-m.dt / tau)) * (called - state.awake)
    x = x * np.clip((awake - h.valve_threshold) / (1 - h.valve_threshold), 0, 1)
    against = LOAD_SHARE * np.sign(x) * state.force / (RELIEF * area)
    v = by_direction(x, cylinder_speeds(m)) * x * np.sqrt(np.maximum(1 - against, 0))
    wanted = np.sum(area * np.abs(v), axis=-1, keepdims=True)  # m^3/s
    return v * np.minimum(1, pump * h.pump_flow / np.maximum(wanted, 1e-12)), awake


@lru_cache
def build(machine: Machine, load: float, slope: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's model of a machine with a load [kg] on a slope [deg], and memory to step it in."""
    joints, tilt, h = machine.joints, np.deg2rad(slope), hydraulics_of(machine)
    tip = f"{joints[-1].a} 0 {joints[-1].d}"
    links = f'<site name="tool" pos="{tip}"/><geom size="0.2" pos="{tip}" mass="{load}"/>'
    for i in reversed(range(machine.n)):  # each link holds the next one
        links = link(machine, i, links)
    of_tendons = [joint.name for joint in joints if h.cylinders[joint.name].base]
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <compiler angle="radian"/>
          <option timestep="{h.dt}" integrator="implicitfast"
            gravity="{9.81 * np.sin(tilt)} 0 {-9.81 * np.cos(tilt)}">
            <flag contact="disable"/>
          </option>
          {SCENE}
          <worldbody>{links}</worldbody>
          <tendon>{"".join(TENDON.format(name) for name in of_tendons)}</tendon>
          <actuator>{"".join(actuator_of(machine, joint) for joint in joints)}</actuator>
          <sensor>{"".join(f'<actuatorfrc actuator="{name}"/>' for name in machine.names)}</sensor>
        </mujoco>""")
    return model, mujoco.MjData(model)


def link(machine: Machine, i: int, rest: str) -> str:
    """MJCF of a link with the `rest` at its tip.

    Seen from the joint, foot and rod of the cylinder are at the angle `Cylinder.angle` + q.
    """
    j, before = machine.joints[i], machine.joints[i - 1]
    cylinder = hydraulics_of(machine).cylinders[j.name]
    place = f'pos="{before.a} 0 {before.d}" euler="{before.alpha} 0 {j.theta}"' if i else ""
    foot = FEET[i], cylinder.base  # angle [rad], distance [m]
    rod = FEET[i] + cylinder.angle, cylinder.rod
    feet, rods = (f"{d * np.cos(angle)} {d * np.sin(angle)} 0" for angle, d in (foot, rod))
    return f"""
        <frame {place}>
          <site name="foot_{j.name}" pos="{feet}"/>
          <body name="{j.name}">
            <joint name="{j.name}" axis="0 0 1" range="{j.q_min} {j.q_max}"/>
            <geom type="capsule" size="0.1" fromto="0 0 0 {j.a} 0 {j.d}" mass="{MASSES[i]}"
              rgba=".85 .45 .1 1"/>
            <site name="rod_{j.name}" pos="{rods}"/>{rest}
          </body>
        </frame>"""


def actuator_of(machine: Machine, j: Joint) -> str:
    """MJCF of a cylinder: f = STIFFNESS (flow - speed), within what the relief valves leave."""
    h, c = hydraulics_of(machine), hydraulics_of(machine).cylinders[j.name]
    moves = f'tendon="{j.name}"' if c.base else f'joint="{j.name}" gear="{c.rod}"'
    push = RELIEF * c.area  # N
    pull = push * (ROD_SIDE if c.base else 1)
    delay = h.delay - h.dt / 2  # between two steps, so that no rounding counts
    return f"""
        <general name="{j.name}" {moves} forcerange="{-pull} {push}" dyntype="filter"
          dynprm="{TAU}" gainprm="{STIFFNESS}" biastype="affine" biasprm="0 0 {-STIFFNESS}"
          delay="{delay}" nsample="{round(h.delay / h.dt) + 1}"/>"""
