# SPDX-License-Identifier: Apache-2.0
"""Moves a running finger to a set-point over topics and waits until it is there.

Start one first, in another terminal: finger --ros-args -p controller_file:=robust -r __ns:=/finger
"""

import sys

import rclpy

from piezo_control.nodes.qos import LATCHED, SETPOINT
from piezo_gripper_msgs.msg import FingerState, Sample

TARGET = float(sys.argv[1] if len(sys.argv) > 1 else 10e-6)  # m
NEAR = 0.2e-6  # m

rclpy.init()
node = rclpy.create_node("set_point", namespace="finger")
states: list[FingerState] = []
node.create_subscription(FingerState, "state", states.append, LATCHED)
reference = node.create_publisher(Sample, "reference", SETPOINT)
while not states or not reference.get_subscription_count():
    rclpy.spin_once(node, timeout_sec=0.1)
reference.publish(Sample(value=TARGET))
while abs(states[-1].deflection - TARGET) > NEAR:
    rclpy.spin_once(node, timeout_sec=0.1)
    if states[-1].phase == FingerState.FAULT:
        sys.exit(f"the finger is at fault: {states[-1].text}")
print(f"at {states[-1].deflection * 1e6:.2f} µm with {states[-1].voltage:.1f} V")
node.destroy_node()
rclpy.shutdown()
