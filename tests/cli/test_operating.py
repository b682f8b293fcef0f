"""The commands at a machine: their controllers, and the line that they print."""

from helpers_bus import BASELINE, HoldingOperator, Virtual, World, only

from brokk_min.can.operator_input import Joystick
from brokk_min.cli.operating import find_controller, status
from brokk_min.learning.policy import Policy
from brokk_min.machine import BROKK_170


def test_find_controller__is_the_policy_or_the_pid_with_the_gains_beside_it(folder):
    pid, net = find_controller(BROKK_170, folder / "policy.npz", rl=False)
    assert (pid.gains.ki == 8.0).all() and pid.k == 0.1
    (folder / "gains.json").write_text("of other nets")  # which the policy does not need
    policy, nets = find_controller(BROKK_170, folder / "policy.npz", rl=True)
    assert isinstance(policy, Policy) and nets.joints == net.joints == policy.net.joints


def test_status__says_what_stopped_it_and_what_is_in_the_way():
    world = World(BASELINE, HoldingOperator())
    world.drive.begin()
    world.run(1.0)
    assert status(world.drive).startswith("driving, v goal +0.10 +0.00 +0.00, measured ")
    world.upward = only(0x185, lambda data: [])
    world.run(0.2)
    assert status(world.drive).startswith("waiting, fault: q5: silent, v goal ")
    world.upward = only(0x703, lambda data: [])
    world.run(0.5)
    assert "fault: q5: silent, now q3: heartbeat lost, v goal" in status(world.drive)


def test_status__names_the_axis_of_a_stick_that_is_not_centred():
    """As that of a trigger, which rests at an end."""
    device = Virtual()
    device.axis(4, -1.0)
    world = World(BASELINE, Joystick(BROKK_170))
    world.drive.begin()
    world.run(0.2)
    assert "ready, the stick is not centred: axis 4, v goal +0.00 +0.00 +0.30" in status(
        world.drive
    )
    device.unplug()
