# SPDX-License-Identifier: Apache-2.0
"""The gripper as joints, for all that draws, records or controls robots.

out: joint_states (sensor_msgs/JointState): first the joint of the gripper, its opening in m, m/s and the larger
     push in N; then a joint for each finger, its deflection in m, m/s (positive closes) and the push of its tip in N
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sensor_msgs.msg import JointState

from piezo_control.nodes.qos import STREAM

if TYPE_CHECKING:
    from piezo_control.nodes.gripper import GripperNode


class JointStates:
    """Publishes `joint_states`, at a rate of its own, as long as both fingers are heard."""

    def __init__(self, gripper: GripperNode) -> None:
        self._gripper = gripper
        self._publisher = gripper.create_publisher(JointState, "joint_states", STREAM)
        self._timer = gripper.create_steady_timer(
            1.0 / gripper.parameters.joint_state_rate, self._publish
        )

    def destroy(self) -> None:
        """Let go of the topic."""
        self._gripper.destroy_timer(self._timer)
        self._gripper.destroy_publisher(self._publisher)

    def _publish(self) -> None:
        gripper = self._gripper
        fingers = gripper.fingers
        if not gripper.active:
            return  # the timer's event was on its way when the gripper was stopped
        if any(finger.silence() for finger in fingers):
            return  # nobody shall take old places for new ones
        whole = gripper.measured()
        message = JointState(
            name=[gripper.parameters.joint, *gripper.parameters.finger_joints],
            position=[whole.opening, *(finger.deflection for finger in fingers)],
            velocity=[whole.velocity, *(finger.velocity for finger in fingers)],
            effort=[whole.force, *(finger.push for finger in fingers)],
        )
        message.header.stamp = gripper.get_clock().now().to_msg()
        self._publisher.publish(message)
