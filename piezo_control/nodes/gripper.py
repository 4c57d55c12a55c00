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

from rclpy.duration import Duration

from piezo_control.gripper import (
    Goal,
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
from piezo_control.nodes.faces.actions import GripFace
from piezo_control.nodes.faces.asker import Asker, Measured
from piezo_control.nodes.profile_input import to_message
from piezo_control.nodes.qos import LATCHED
from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile
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
        self.motion: Motion | None = None
        self.asker: Asker | None = None  # whose motion it is
        self.watchdog = self.create_steady_timer(WATCH_PERIOD, self._watch, autostart=False)
        self.faces = [GripFace(self, "grip")]

    def destroy_node(self) -> None:
        for face in self.faces:
            face.destroy()
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
        if self.asker is not None:
            self._give_up(self.asker)
        for finger in self.fingers:
            finger.release()
        self.fingers = []

    # --- what the faces use -------------------------------------------------------------------------

    def check_goal(self, opening: float, max_force: float, speed: float) -> Goal:
        """Return the goal; a ValueError says why the gripper cannot go for it now."""
        if not self.active:
            raise ValueError("the gripper is not active")
        goal = check_goal(self.parameters, opening, max_force, speed)
        for finger in self.fingers:
            if finger.problem():
                raise ValueError(finger.problem())
        return goal

    def move(self, goal: Goal, asker: Asker) -> None:
        """Go for a goal from where the fingers are; whoever else asked for a motion is told so."""
        if self.asker is not asker:
            self._finish(failure("a new goal takes over"))
        self.motion = Motion(self.parameters, goal, [finger.place() for finger in self.fingers])
        self.asker = asker

    def halt(self, reason: str) -> None:
        """Hold the fingers where they are; a motion ends because of `reason`."""
        self._halt_motion(failure(reason))

    def measured(self) -> Measured:
        """Return what the newest states say."""
        states = [finger.state for finger in self.fingers]
        return Measured(
            opening_of(self.parameters, [s.deflection for s in states]),
            force_of([s.tip_force for s in states]),
        )

    # --- the motion, moved on by the fingers' states ------------------------------------------------

    def _on_state(self, finger: Finger) -> None:
        motion = self.motion
        if motion is None:
            return
        reason = finger.problem()
        if not reason and motion.departed(finger.index) and finger.reference is None:
            reason = f"finger '{finger.name}' was started anew"
        if reason:
            self.halt(reason)
        else:
            self._go_on(finger, motion)

    def _go_on(self, finger: Finger, motion: Motion) -> None:
        if not motion.departed(finger.index):
            finger.follow(motion.depart(finger.index, finger.time, finger.place()))
        else:
            finger.extend()
        if self.asker is not None:
            self.asker.feel(self.measured())
        states = [f.state for f in self.fingers]
        outcome = motion.decide(
            [f.time for f in self.fingers],
            [s.deflection for s in states],
            [s.tip_force for s in states],
        )
        if outcome is not None:
            self._halt_motion(outcome)

    def _watch(self) -> None:
        if self.motion is None:
            return
        for finger in self.fingers:
            if finger.problem():
                self.halt(finger.problem())
                return

    # --- ends ---------------------------------------------------------------------------------------

    def _halt_motion(self, outcome: Outcome) -> None:
        """Hold the fingers where their references were at the newest states, and end the motion."""
        for finger in self.fingers:
            if finger.reference is not None:
                finger.follow(hold(finger.place()))
        self._finish(outcome)

    def _give_up(self, asker: Asker) -> None:
        """End the motion because the node stops."""

        def ended() -> bool:
            if self.asker is asker:
                self.halt("the gripper is stopped")
            return asker.is_told()

        if self.executor is None:  # a signal has ended the loop; a client still needs its result
            spin.spin([self], ended)
        else:
            ended()

    def _finish(self, outcome: Outcome) -> None:
        """End the motion, if there is one, and tell whose it was."""
        motion, asker = self.motion, self.asker
        self.motion = self.asker = None
        if motion is None or asker is None:
            return
        text = f"goal {motion.goal.opening * 1e6:g} µm: {outcome.text}"
        if outcome.success:
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)
        asker.end(outcome, self.measured())


def failure(text: str) -> Outcome:
    """Return the outcome of a goal that was not carried through."""
    return Outcome(False, False, False, text)


def main() -> int:
    return finger_node.run(GripperNode)
