# SPDX-License-Identifier: Apache-2.0
"""Two fingers behind the action `grip`: bring them to an opening, or stop at a force.

action: grip (Grip: opening m, max_force N, speed m/s)
in:     FINGER/state (FingerState) of both fingers
out:    FINGER/reference_profile (Profile, m) of both fingers

One goal at a time; a new one takes over from the moving fingers, and the old one is aborted. A goal
ends when the opening is reached or, closing, when the force is: both are successes. What the action's
end leaves is a held reference: a gripper that loses its goal, its client or this node never drops what
it holds, and never moves on. A finger that stops by itself is at 0 V, and is told to stay at deflection
0 when it starts again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.duration import Duration

from piezo_control.gripper import (
    GripperParameters,
    Motion,
    Outcome,
    check_goal,
    force_of,
    hold,
    opening_of,
)
from piezo_control.nodes import base as finger_node
from piezo_control.nodes import spin
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.profile_input import to_message
from piezo_control.nodes.qos import LATCHED
from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile
from piezo_gripper_msgs.action import Grip
from piezo_gripper_msgs.msg import FingerState
from piezo_gripper_msgs.msg import Profile as ProfileMessage

WATCH_PERIOD = 0.1  # s
DELIVERY_TIMEOUT = Duration(seconds=0.5)
LEASE = 0.5  # s of the finger's time that a piece of a motion lasts; states come ten a second
PHASES = {
    FingerState.IDLE: "IDLE",
    FingerState.WAITING: "WAITING",
    FingerState.RUNNING: "RUNNING",
    FingerState.FINISHED: "FINISHED",
    FingerState.FAULT: "FAULT",
}


@dataclasses.dataclass(frozen=True)
class GripperNodeParameters(GripperParameters):
    """The law's parameters and the node's own."""

    fingers: tuple[str, ...] = parameter(
        ("left", "right"), "namespaces of the two fingers, relative to the gripper's"
    )
    state_timeout: float = parameter(
        1.0, "a finger whose state is older is taken for dead (wall clock)", unit="s", low=0.2,
        high=60.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.fingers)) != 2 or len(self.fingers) != 2:
            raise ParameterError(f"'fingers' is {list(self.fingers)}, must be two different names")


class DeferredActionServer(ActionServer):
    """An action server whose goals are moved on by events; `notify_execute` with a callback ends one.

    An execute callback that waits would stop the node's only thread, and one that awaits is polled by
    rclpy 7's executors without a pause (measured: a full core). Here `execute()` only says EXECUTING.
    """

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable | None
    ) -> None:
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class Finger:
    """One finger as the gripper knows it: the newest state, and the reference it was given."""

    def __init__(
        self, node: GripperNode, name: str, index: int, on_state: Callable[[Finger], None]
    ) -> None:
        self._node = node
        self._on_state = on_state
        self.name = name
        self.index = index
        self.state: Any = None  # FingerState; None before the first
        self.reference: Profile | None = None
        self.heard = monotonic()
        self._profiles = node.create_publisher(ProfileMessage, f"{name}/reference_profile", LATCHED)
        self._states = node.create_subscription(FingerState, f"{name}/state", self._take, LATCHED)

    @property
    def time(self) -> float:
        """The finger's own time: s since its sample 0."""
        return self.state.samples * self._node.parameters.sample_time

    def place(self) -> float:
        """Return where the reference is (m); before the first one, where the finger is."""
        if self.reference is None:
            return self.state.deflection
        return float(self.reference.at(self.time))

    def follow(self, reference: Profile) -> None:
        """Give the finger this reference."""
        self.reference = reference
        self.extend()

    def extend(self) -> None:
        """Send the next piece of the reference.

        A motion goes out in pieces, so that a finger whose gripper is gone stops where the last one ends.
        """
        reference = self.reference
        if reference is None:
            return
        if reference.linear:
            reference = reference.part(self.time, self.time + LEASE)
        self._profiles.publish(to_message(reference))

    def problem(self) -> str:
        """Return why the finger cannot move, or nothing."""
        silence = monotonic() - self.heard
        if self.state is None or silence > self._node.parameters.state_timeout:
            topic = self._node.resolve_topic_name(f"{self.name}/state")
            return f"finger '{self.name}' is silent: nothing on '{topic}' for {silence:.1f} s"
        if self.state.phase != FingerState.RUNNING:
            text = f" ({self.state.text})" if self.state.text else ""
            return f"finger '{self.name}' is {PHASES[self.state.phase]}{text}, must be RUNNING"
        return ""

    def release(self) -> None:
        """Make sure the last reference has arrived, then let go of the topics."""
        self._profiles.wait_for_all_acked(DELIVERY_TIMEOUT)
        self._node.destroy_publisher(self._profiles)
        self._node.destroy_subscription(self._states)

    def _take(self, state: FingerState) -> None:
        restarted = self.state is not None and state.samples < self.state.samples
        self.state = state
        self.heard = monotonic()
        if self.reference is not None and (restarted or state.phase != FingerState.RUNNING):
            self.follow(hold(0.0))
            self.reference = None
        self._on_state(self)


class GripperNode(FingerNode):
    NAME = "gripper"
    PARAMETERS = GripperNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.fingers: list[Finger] = []
        self.goal: Any = None  # ServerGoalHandle; None when there is no goal
        self.motion: Motion | None = None
        self.watchdog = self.create_steady_timer(WATCH_PERIOD, self._watch, autostart=False)
        self.server = DeferredActionServer(
            self, Grip, "grip", ServerGoalHandle.abort,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )  # fmt: skip

    def destroy_node(self) -> None:
        self.server.destroy()
        super().destroy_node()

    def start(self) -> None:
        self.fingers = [
            Finger(self, name, index, self._on_state)
            for index, name in enumerate(self.parameters.fingers)
        ]
        self.watchdog.reset()

    def stop(self) -> None:
        self.watchdog.cancel()
        self.active = False  # no goal from here on
        if self.goal is not None:
            self._give_up(self.goal)
        for finger in self.fingers:
            finger.release()
        self.fingers = []

    # --- the action's callbacks ---------------------------------------------------------------------

    def _on_goal(self, request: Grip.Goal) -> GoalResponse:
        try:
            if not self.active:
                raise ValueError("the gripper is not active")
            check_goal(self.parameters, request.opening, request.max_force, request.speed)
            for finger in self.fingers:
                if finger.problem():
                    raise ValueError(finger.problem())
        except ValueError as error:
            self.get_logger().error(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        if self.goal is not None:
            self._finish(ServerGoalHandle.abort, failure("a new goal takes over"))
        request = handle.request
        goal = check_goal(self.parameters, request.opening, request.max_force, request.speed)
        self.motion = Motion(self.parameters, goal, [finger.place() for finger in self.fingers])
        self.goal = handle
        handle.execute()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        return CancelResponse.ACCEPT if handle is self.goal else CancelResponse.REJECT

    # --- the motion, moved on by the fingers' states ------------------------------------------------

    def _on_state(self, finger: Finger) -> None:
        motion = self.motion
        if motion is None:
            return
        reason = finger.problem()
        if not reason and motion.departed(finger.index) and finger.reference is None:
            reason = f"finger '{finger.name}' was started anew"
        if reason:
            self._halt_goal(ServerGoalHandle.abort, failure(reason))
        elif self.goal.is_cancel_requested:
            self._halt_goal(ServerGoalHandle.canceled, failure("canceled"))
        else:
            self._go_on(finger, motion)

    def _go_on(self, finger: Finger, motion: Motion) -> None:
        if not motion.departed(finger.index):
            finger.follow(motion.depart(finger.index, finger.time, finger.place()))
        else:
            finger.extend()
        opening, force = self._measured()
        self.goal.publish_feedback(Grip.Feedback(opening=opening, force=force))
        states = [f.state for f in self.fingers]
        outcome = motion.decide(
            [f.time for f in self.fingers],
            [s.deflection for s in states],
            [s.tip_force for s in states],
        )
        if outcome is not None:
            end = ServerGoalHandle.succeed if outcome.success else ServerGoalHandle.abort
            self._halt_goal(end, outcome)

    def _watch(self) -> None:
        if self.motion is None:
            return
        for finger in self.fingers:
            if finger.problem():
                self._halt_goal(ServerGoalHandle.abort, failure(finger.problem()))
                return

    def _measured(self) -> tuple[float, float]:
        """Return opening (m) and force (N) as the newest states have them."""
        states = [finger.state for finger in self.fingers]
        opening = opening_of(self.parameters, [s.deflection for s in states])
        return opening, force_of([s.tip_force for s in states])

    # --- ends ---------------------------------------------------------------------------------------

    def _halt_goal(self, end: Callable[[ServerGoalHandle], None], outcome: Outcome) -> None:
        """Hold the fingers where their references were at the newest states, and end the goal."""
        for finger in self.fingers:
            if finger.reference is not None:
                finger.follow(hold(finger.place()))
        self._finish(end, outcome)

    def _give_up(self, handle: ServerGoalHandle) -> None:
        """End the goal because the node stops."""

        def ended() -> bool:
            if handle is self.goal:
                self._halt_goal(ServerGoalHandle.abort, failure("the gripper is stopped"))
            return not handle.is_active

        if self.executor is None:  # a signal has ended the loop; the client still needs its result
            spin.spin([self], ended)
        else:
            ended()

    def _finish(self, end: Callable[[ServerGoalHandle], None], outcome: Outcome) -> None:
        """Let the client know by `end`, in an event of its own."""
        handle, self.goal, self.motion = self.goal, None, None
        opening, force = self._measured()
        result = Grip.Result(
            opening=opening,
            force=force,
            reached_goal=outcome.reached_goal,
            stalled=outcome.stalled,
        )

        def conclude(_: ServerGoalHandle) -> Grip.Result:
            end(handle)
            return result

        self.server.notify_execute(handle, conclude)
        text = f"goal {handle.request.opening * 1e6:g} µm: {outcome.text}"
        if outcome.success:
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)


def failure(text: str) -> Outcome:
    """Return the outcome of a goal that was not carried through."""
    return Outcome(False, False, False, text)


def main() -> int:
    return finger_node.run(GripperNode)
