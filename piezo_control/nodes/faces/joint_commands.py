# SPDX-License-Identifier: Apache-2.0
"""Set-points and trajectories for the gripper's joint; the newest counts, and takes over from any other goal.

in: ~/joint_commands (sensor_msgs/JointState): position in m, at most velocity in m/s and effort in N
    ~/joint_trajectory (trajectory_msgs/JointTrajectory): positions in m over time; an empty one stops

Commands come as `joint_state_topic_hardware_interface` of ros2_control sends them: again and again until the position
is reached, with NaN as long as no controller has written one, and with the names of joints that have none. So a
command that is repeated is the same command: it does not push anew against an object at which the gripper stopped. Nor does it
fight whoever asked for something else in between: it is held back, which is said once, until a command differs.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rclpy.time import Time
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from piezo_control.gripper import Goal, Waypoint
from piezo_control.nodes.block import seconds
from piezo_control.nodes.faces.asker import Asker
from piezo_control.nodes.qos import SETPOINT

if TYPE_CHECKING:
    from piezo_control.nodes.gripper import GripperNode


def wanted(message: JointState, joint: str) -> tuple[float, float, float]:
    """Return position, effort and velocity of `joint`: position NaN for none, effort and velocity 0.

    Raises ValueError where the names do not have the joint, or it has no position.
    """
    names = list(message.name) or [joint]
    if joint not in names:
        raise ValueError(f"has no joint '{joint}', only {', '.join(names)}")
    index = names.index(joint)
    if index >= len(message.position):
        raise ValueError(f"has {len(message.position)} positions, none for joint '{joint}'")

    def entry(values: list[float]) -> float:
        return values[index] if index < len(values) and not math.isnan(values[index]) else 0.0

    return message.position[index], entry(message.effort), entry(message.velocity)


class JointCommands(Asker):
    """Takes the gripper where `~/joint_commands` and `~/joint_trajectory` say."""

    def __init__(self, gripper: GripperNode) -> None:
        self._gripper = gripper
        self._last: tuple[float, float, float] | None = None
        self._goal: Goal | None = None  # what became of it
        self._says_so = False
        self._inputs = [
            gripper.create_subscription(JointState, "~/joint_commands", self._on_command, SETPOINT),
            gripper.create_subscription(
                JointTrajectory, "~/joint_trajectory", self._on_trajectory, SETPOINT
            ),
        ]

    def destroy(self) -> None:
        """Let go of the topics."""
        for subscription in self._inputs:
            self._gripper.destroy_subscription(subscription)

    def _on_command(self, message: JointState) -> None:
        try:
            command = wanted(message, self._gripper.parameters.joint)
            if math.isnan(command[0]):
                return
            if command == self._last:
                self._hold_back(command[0])
                return
            goal = self._gripper.check_goal(*command)
        except ValueError as error:
            self._ignored("~/joint_commands", error)
            return
        self._last, self._goal, self._says_so = command, goal, False
        self._gripper.move(goal, self)

    def _hold_back(self, opening: float) -> None:
        """Say once that a repeated command does not bring the gripper back from where others sent it."""
        if self._says_so or self._gripper.goal is self._goal:
            return
        self._says_so = True
        name = self._gripper.resolve_topic_name("~/joint_commands")
        self._gripper.get_logger().warning(
            f"'{name}' repeats {opening * 1e6:g} µm, held back: the fingers were stopped or sent elsewhere since. "
            "A command that differs moves them"
        )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        joint = self._gripper.parameters.joint
        try:
            if list(message.joint_names) != [joint]:
                names = ", ".join(message.joint_names) or "no joint"
                raise ValueError(f"is for {names}, must be for '{joint}' alone")
            if not message.points:
                self._gripper.halt("an empty trajectory stops")
                return
            begin = self._wait_for(message)
            waypoints = []
            for number, point in enumerate(message.points):
                if len(point.positions) != 1:
                    raise ValueError(
                        f"waypoint {number} has {len(point.positions)} positions, must have 1"
                    )
                instant = begin + seconds(point.time_from_start)
                waypoints.append(Waypoint(instant, point.positions[0]))
            goal = self._gripper.check_trajectory(waypoints)
        except ValueError as error:
            self._ignored("~/joint_trajectory", error)
            return
        self._gripper.move(goal, self)

    def _wait_for(self, message: JointTrajectory) -> float:
        """Return how long (s) a trajectory is to wait; one whose time has come begins at once."""
        ahead = Time.from_msg(message.header.stamp) - self._gripper.get_clock().now()
        return max(0.0, ahead.nanoseconds * 1e-9)

    def _ignored(self, topic: str, error: ValueError) -> None:
        name = self._gripper.resolve_topic_name(topic)
        self._gripper.get_logger().error(f"'{name}' ignored: {error}", throttle_duration_sec=1.0)
