# SPDX-License-Identifier: Apache-2.0
"""The gripper behind the actions of control_msgs, as MoveIt and gripper scripts call them.

Imported only where control_msgs is installed. The meaning is that of ros2_controllers: `position` is the opening,
`effort` the force at which closing stops, 0 or left out for the gripper's limit; a goal that ends by that force has
`stalled` set, and counts as succeeded with `allow_stalling`, else as aborted. Here a stall is told by force and
place, never by a velocity.
"""

from __future__ import annotations

from control_msgs.action import GripperCommand, ParallelGripperCommand
from sensor_msgs.msg import JointState

from piezo_control.gripper import Outcome
from piezo_control.nodes.faces.actions import ActionFace
from piezo_control.nodes.faces.asker import Measured
from piezo_control.nodes.faces.joint_commands import wanted


class ControlFace(ActionFace):
    """What both actions have in common."""

    def is_success(self, outcome: Outcome) -> bool:
        allowed = self.gripper.parameters.allow_stalling
        return outcome.success and (outcome.reached_goal or allowed)


class ParallelGripperCommandFace(ControlFace):
    """The action of parallel_gripper_controller: a joint state, with speed."""

    TYPE = ParallelGripperCommand

    def wanted(self, request: ParallelGripperCommand.Goal) -> tuple[float, float, float]:
        if len(request.command.position) != 1:
            raise ValueError(f"command has {len(request.command.position)} positions, must have 1")
        return wanted(request.command, self.gripper.parameters.joint)

    def feedback(self, measured: Measured) -> ParallelGripperCommand.Feedback:
        return ParallelGripperCommand.Feedback(state=self._state(measured))

    def result(self, outcome: Outcome, measured: Measured) -> ParallelGripperCommand.Result:
        return ParallelGripperCommand.Result(
            state=self._state(measured), stalled=outcome.stalled, reached_goal=outcome.reached_goal
        )

    def _state(self, measured: Measured) -> JointState:
        state = JointState(
            name=[self.gripper.parameters.joint],
            position=[measured.opening],
            velocity=[measured.velocity],
            effort=[measured.force],
        )
        state.header.stamp = self.gripper.get_clock().now().to_msg()
        return state


class GripperCommandFace(ControlFace):
    """The action of gripper_controllers: position and effort."""

    TYPE = GripperCommand

    def wanted(self, request: GripperCommand.Goal) -> tuple[float, float, float]:
        return request.command.position, request.command.max_effort, 0.0

    def feedback(self, measured: Measured) -> GripperCommand.Feedback:
        return GripperCommand.Feedback(position=measured.opening, effort=measured.force)

    def result(self, outcome: Outcome, measured: Measured) -> GripperCommand.Result:
        return GripperCommand.Result(
            position=measured.opening,
            effort=measured.force,
            stalled=outcome.stalled,
            reached_goal=outcome.reached_goal,
        )


FACES = {
    "ParallelGripperCommand": ParallelGripperCommandFace,
    "GripperCommand": GripperCommandFace,
}
