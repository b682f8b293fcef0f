"""The policy as a ROS 2 node: angles and goals in, valve commands out. It was never run on ROS.

Run it as `python ros_node.py FILE.onnx`, with what `brokk-min export` made of a policy of
`brokk-min train --paper`. It has neither safety gate nor watchdog: both are yours.
"""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from run_onnx import load, tick
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray


class Policy(Node):
    """Commands u of all joints, of full command, at the machine's rate."""

    def __init__(self, path):
        super().__init__("policy")
        self.net, self.told = load(path)
        self.q = self.h = None
        self.u, self.v_goal = np.zeros(len(self.told["joints"])), np.zeros(3)
        self.create_subscription(JointState, "joint_states", self.on_joints, 1)
        self.create_subscription(TwistStamped, "tool_velocity", self.on_goal, 1)
        self.valves = self.create_publisher(Float64MultiArray, "valves", 1)
        self.create_timer(1 / self.told["rate"], self.on_timer)

    def on_joints(self, message):
        """Keep the angles [rad]; their names may come in any order."""
        q = dict(zip(message.name, message.position))
        self.q = np.array([q[name] for name in self.told["joints"]])

    def on_goal(self, message):
        """Keep the goal velocity [m/s] of the tool, in the base frame."""
        v = message.twist.linear
        self.v_goal = np.array([v.x, v.y, v.z])

    def on_timer(self):
        """Publish the commands of this tick; the machine is at rest before the first."""
        if self.q is None:
            return
        if self.h is None:
            rows = np.stack([self.q, 0 * self.q, 0 * self.q], axis=1)
            self.h = rows[..., None].repeat(self.told["history"], axis=2)
        self.h, self.u = tick(self.net, self.told, self.h, self.q, self.u, self.v_goal)
        self.valves.publish(Float64MultiArray(data=self.u.tolist()))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Policy(sys.argv[1]))
