# SPDX-License-Identifier: Apache-2.0
"""The gripper behind an action: of the project's own type here, of others by a subclass.

One goal at a time; a new one takes over from the moving fingers, and the old one is aborted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from piezo_control.gripper import Outcome
from piezo_control.nodes.faces.asker import Asker, Measured
from piezo_gripper_msgs.action import Grip

if TYPE_CHECKING:
    from piezo_control.nodes.gripper import GripperNode

# What a server has sent is lost when its program ends before a busy client has read it.
ON_ITS_WAY = 1.0  # s


class DeferredActionServer(ActionServer):
    """An action server whose goals are moved on by events; `notify_execute` with a callback ends one.

    An execute callback that waits would stop the node's only thread, and one that awaits is polled by
    rclpy 7's executors without a pause (measured: a full core). Here `execute()` only says EXECUTING.
    A goal leaves the active states some events before its result goes out, so `sent` keeps the result that did.
    """

    sent: Any = None  # the newest result that a client was given
    sent_at = math.inf  # s of the steady clock

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable | None
    ) -> None:
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)

    def _send_result_response(self, request_header: Any, future: Future) -> None:
        super()._send_result_response(request_header, future)
        self.sent, self.sent_at = future.result().result, monotonic()


class ActionFace:
    """An action server `name` in front of `gripper`; a subclass translates its action `TYPE`."""

    TYPE: type

    def __init__(self, gripper: GripperNode, name: str) -> None:
        self.gripper = gripper
        self.server = DeferredActionServer(
            gripper, self.TYPE, name, ServerGoalHandle.abort,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )  # fmt: skip

    def wanted(self, request: Any) -> tuple[float, float, float]:
        """Return opening (m), force (N) and speed (m/s) of a goal, 0 for none; ValueError: it has none."""
        raise NotImplementedError

    def feedback(self, measured: Measured) -> Any:
        """Return the feedback that says `measured`."""
        raise NotImplementedError

    def result(self, outcome: Outcome, measured: Measured) -> Any:
        """Return the result that says `outcome` and `measured`."""
        raise NotImplementedError

    def is_success(self, outcome: Outcome) -> bool:
        """Say whether this action counts `outcome` as a success."""
        return outcome.success

    def destroy(self) -> None:
        """Let go of the action."""
        self.server.destroy()

    def _on_goal(self, request: Any) -> GoalResponse:
        try:
            self.gripper.check_goal(*self.wanted(request))
        except ValueError as error:
            self.gripper.refuse(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        goal = self.gripper.check_goal(*self.wanted(handle.request))
        self.gripper.move(goal, ActionGoal(self, handle))
        handle.execute()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        asker = self.gripper.asker
        if not (isinstance(asker, ActionGoal) and asker.handle is handle):
            return CancelResponse.REJECT
        self.gripper.halt("canceled")
        return CancelResponse.ACCEPT


class ActionGoal(Asker):
    """One goal of an action, from its acceptance to its result."""

    def __init__(self, face: ActionFace, handle: ServerGoalHandle) -> None:
        self.handle = handle
        self._face = face
        self._result: Any = None  # None until the end

    def feel(self, measured: Measured) -> None:
        self.handle.publish_feedback(self._face.feedback(measured))

    def end(self, outcome: Outcome, measured: Measured) -> None:
        """Let the client know, in an event of its own: a cancellation is accepted first, then carried out."""
        self._result = self._face.result(outcome, measured)

        def conclude(handle: ServerGoalHandle) -> Any:
            if self._face.is_success(outcome):
                handle.succeed()
            elif handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            return self._result

        self._face.server.notify_execute(self.handle, conclude)

    def is_told(self) -> bool:
        server = self._face.server
        is_sent = self._result is not None and server.sent is self._result
        return is_sent and monotonic() - server.sent_at > ON_ITS_WAY


class GripFace(ActionFace):
    """The project's own action (Grip)."""

    TYPE = Grip

    def wanted(self, request: Grip.Goal) -> tuple[float, float, float]:
        return request.opening, request.max_force, request.speed

    def feedback(self, measured: Measured) -> Grip.Feedback:
        return Grip.Feedback(opening=measured.opening, force=measured.force)

    def result(self, outcome: Outcome, measured: Measured) -> Grip.Result:
        return Grip.Result(
            opening=measured.opening,
            force=measured.force,
            reached_goal=outcome.reached_goal,
            stalled=outcome.stalled,
        )
