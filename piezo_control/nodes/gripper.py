# SPDX-License-Identifier: Apache-2.0
"""Two fingers as one gripper: bring them to an opening, or stop at a force.

actions:  grip (Grip: opening m, max_force N, speed m/s); where control_msgs is installed, ~/gripper_cmd
          (ParallelGripperCommand or GripperCommand)
in:       FINGER/state (FingerState) and FINGER/push (Sample, N) of both fingers,
          ~/joint_commands (sensor_msgs/JointState),
          ~/joint_trajectory (trajectory_msgs/JointTrajectory)
out:      FINGER/reference_profile (Profile, m, with the force limit) of both fingers,
          joint_states (sensor_msgs/JointState)
services: ~/home, ~/release, ~/stop, ~/zero, ~/reset (std_srvs/Trigger)

One goal at a time; a new one takes over from the moving fingers, and the old one is aborted. A goal
ends when the opening is reached or, closing, when the force is, with both fingers at rest: both are
successes. The force is held in the fingers' own loops (`force_control`); fingers without take goals by
position alone. What the action's end leaves is a held reference: a gripper that loses its goal, its client or this node never drops what
it holds, and never moves on. A finger that stops by itself is at 0 V, and is told to stay at deflection
0 when it starts again.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import Trigger

from piezo_control.gripper import (
    HOLD_BEYOND,
    Goal,
    GripperParameters,
    Motion,
    Outcome,
    Waypoint,
    check_goal,
    check_trajectory,
    force_of,
    hold,
    opening_of,
)
from piezo_control.nodes import base as finger_node
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.faces.actions import ActionFace, GripFace
from piezo_control.nodes.faces.asker import Asker, Measured
from piezo_control.nodes.faces.joint_commands import JointCommands
from piezo_control.nodes.faces.joint_states import JointStates
from piezo_control.nodes.faces.services import Services
from piezo_control.nodes.phases import PHASES
from piezo_control.nodes.profile_input import to_message
from piezo_control.nodes.qos import DELIVERY_TIMEOUT, LATCHED, NEWEST
from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile
from piezo_gripper_msgs.msg import FingerState, Sample
from piezo_gripper_msgs.msg import Profile as ProfileMessage

WATCH_PERIOD = 0.1  # s
VELOCITY_WINDOW = 0.1  # s of the finger's time: the sensor's quantum of 10 nm is 0.1 µm/s then
PUSH_TIMEOUT = 0.5  # s of the finger's time; pushes come every 10 ms of it
LEASE = 0.5  # s of the finger's time that a piece of a motion lasts; states come ten a second
UNDER_WAY = (
    0.5  # s in which a reference that was sent shows in the finger's state, if it is followed
)
SAME = 1e-9  # m: references that differ by less are the same


@dataclasses.dataclass(frozen=True)
class GripperNodeParameters(GripperParameters):
    """The law's parameters and the node's own."""

    fingers: tuple[str, ...] = parameter(
        ("left", "right"), "namespaces of the two fingers, relative to the gripper's"
    )
    joint: str = parameter("gripper_joint", "name of the joint whose position is the opening")
    finger_joints: tuple[str, ...] = parameter(
        ("left_finger_joint", "right_finger_joint"),
        "names of the joints whose positions are the fingers' deflections",
    )
    joint_state_rate: float = parameter(
        100.0, "how often `joint_states` is published", unit="Hz", low=1.0, high=1000.0
    )
    control_action: str = parameter(
        "ParallelGripperCommand",
        "action of control_msgs that `~/gripper_cmd` has, where that package is installed; fixed at start",
        choices=("ParallelGripperCommand", "GripperCommand", "none"),
    )
    allow_stalling: bool = parameter(
        True, "`~/gripper_cmd`: a goal that ends by its force counts as succeeded, else as aborted"
    )
    zero_limit: float = parameter(
        2e-6, "largest deflection that `~/zero` takes for 0", unit="m", low=0.0, high=1e-4
    )
    state_timeout: float = parameter(
        1.0, "a finger whose state is older is taken for dead; what the gripper itself stood still does not count",
        unit="s", low=0.2, high=60.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.fingers)) != 2 or len(self.fingers) != 2:
            raise ParameterError(f"'fingers' is {list(self.fingers)}, must be two different names")
        joints = [self.joint, *self.finger_joints]
        if len(set(joints)) != 3 or len(joints) != 3 or "" in joints:
            raise ParameterError(
                f"'joint' and 'finger_joints' are {joints}, must be three different names"
            )


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
        self._under_way: Profile | None = None  # a reference that was sent, until a state shows it
        self._before: list[Profile] = []  # what the states show until it has arrived
        self._sent = -math.inf
        self.zero = 0.0  # m, the deflection at which the finger is at rest
        self.heard = node.listened
        self._way: deque[tuple[float, float]] = deque()  # times (s) and deflections (m) of late
        self.push = math.nan  # N, of the object on the tip; NaN: the finger does not feel any
        self.max_force = 0.0  # N, of the goal; 0: the finger's own limit
        self._felt = 0  # number of the sample at which it felt that
        self._felt_at = -math.inf  # s, when that was heard
        self._profiles = node.create_publisher(ProfileMessage, f"{name}/reference_profile", LATCHED)
        self._states = node.create_subscription(FingerState, f"{name}/state", self._take, LATCHED)
        self._pushes = node.create_subscription(Sample, f"{name}/push", self._feel, NEWEST)

    @property
    def time(self) -> float:
        """The finger's own time: s since its sample 0."""
        return self.state.samples * self._node.parameters.sample_time

    @property
    def deflection(self) -> float:
        """Where the finger is (m)."""
        return self.state.deflection - self.zero

    @property
    def velocity(self) -> float:
        """How fast the finger went (m/s) over the last `VELOCITY_WINDOW`."""
        (begin, start), (end, here) = self._way[0], self._way[-1]
        return (here - start) / (end - begin) if end > begin else 0.0

    def place(self) -> float:
        """Return where the reference in force is (m), whoever gave it; where nobody has said, where the finger is."""
        if self._under_way is not None:
            return float(self._under_way.at(self.time)) - self.zero
        if math.isnan(self.state.reference):
            return self.deflection
        return self.state.reference - self.zero

    def follow(self, reference: Profile) -> None:
        """Give the finger this reference."""
        self._before = [self.reference] if self.reference else []
        if math.isfinite(self.state.reference):
            self._before.append(hold(self.state.reference))
        self.reference = Profile(reference.time, reference.value + self.zero, reference.linear)
        self._under_way, self._sent = self.reference, self.heard
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
        self._profiles.publish(to_message(reference, self.max_force))

    def silence(self) -> str:
        """Return that the finger is taken for dead, or nothing."""
        silence = self._node.listened - self.heard
        if self.state is not None and silence <= self._node.parameters.state_timeout:
            return ""
        topic = self._node.resolve_topic_name(f"{self.name}/state")
        return f"finger '{self.name}' is silent: nothing on '{topic}' for {silence:.1f} s"

    def missing(self) -> str:
        """Return in words what keeps the finger from moving, the same as long as it does."""
        if self.silence():
            topic = self._node.resolve_topic_name(f"{self.name}/state")
            return f"finger '{self.name}' (nothing on '{topic}')"
        if self.state.phase != FingerState.RUNNING:
            return f"finger '{self.name}' (it is {PHASES[self.state.phase]})"
        return f"finger '{self.name}' (it {self._pace() or 'tells no force'})"

    def _pace(self) -> str:
        """Return in words that the finger's time is not the gripper's, in which its ways are planned; empty: it is."""
        period, own = self.state.period, self._node.parameters.sample_time
        if not period or abs(period - own) <= 1e-6 * own:
            return ""
        return (
            f"takes a sample every {period:g} s, 'sample_time' of '{self._node.NAME}' is {own:g} s"
        )

    def problem(self) -> str:
        """Return why the finger cannot move, or nothing."""
        if silence := self.silence():
            return silence
        if self.state.phase != FingerState.RUNNING:
            text = f" ({self.state.text})" if self.state.text else ""
            phase = PHASES[self.state.phase].upper()
            return f"finger '{self.name}' is {phase}{text}, must be RUNNING"
        if pace := self._pace():
            return f"finger '{self.name}' {pace}"
        if self.numbness():
            return ""
        topic = self._node.resolve_topic_name(f"{self.name}/push")
        if math.isnan(self.push):
            return f"finger '{self.name}' has told no force yet on '{topic}'"
        samples = self.state.samples - self._felt
        is_late = samples * self._node.parameters.sample_time > PUSH_TIMEOUT
        if is_late and self._node.listened - self._felt_at > self._node.parameters.state_timeout:
            return f"finger '{self.name}' feels no more: nothing on '{topic}' for {samples} samples"
        return ""

    def numbness(self) -> str:
        """Return why this finger cannot hold a force, or nothing."""
        topic = self._node.resolve_topic_name(f"{self.name}/push")
        if math.isfinite(self.push) or self._node.count_publishers(topic):
            return ""
        return (
            f"finger '{self.name}' feels no force (nobody publishes '{topic}'): its feedback or servo needs "
            "`force_control: true`, or leave max_force at 0 to go by position alone"
        )

    def reset(self) -> None:
        """Ask all nodes of the finger to leave their faults; what one of them refuses is logged."""
        logger = self._node.get_logger()
        folder = self._node.resolve_topic_name(self.name)
        for name, _ in self._node.get_service_names_and_types():
            if name.startswith(f"{folder}/") and name.endswith("/reset"):
                client = self._node.create_client(Trigger, name)

                def tell(answer: Future, name: str = name, client: Client = client) -> None:
                    if not answer.result().success:
                        logger.error(f"'{name}': {answer.result().message}")
                    self._node.destroy_client(client)

                client.call_async(Trigger.Request()).add_done_callback(tell)

    def release(self) -> None:
        """Make sure the last reference has arrived, then let go of the topics."""
        self._profiles.wait_for_all_acked(DELIVERY_TIMEOUT)
        self._node.destroy_publisher(self._profiles)
        self._node.destroy_subscription(self._states)
        self._node.destroy_subscription(self._pushes)

    def _shows(self, reference: Profile) -> bool:
        """Say whether the state has this reference in force."""
        return abs(self.state.reference - float(reference.at(self.time))) <= SAME

    def _feel(self, push: Sample) -> None:
        self.push = push.value
        self._felt = push.number
        self._felt_at = self._node.listened

    def _take(self, state: FingerState) -> None:
        if self not in self._node.fingers:
            return  # it was on its way when the gripper was stopped
        if self.state is None:
            self.max_force = state.max_force  # that of a gripper before this one
        restarted = self.state is not None and state.samples < self.state.samples
        self.state = state
        self.heard = self._node.listened
        if restarted:
            self._way.clear()
            self.push = math.nan
        if not self._way or self.time > self._way[-1][0]:
            self._way.append((self.time, state.deflection))
        while len(self._way) > 2 and self.time - self._way[1][0] >= VELOCITY_WINDOW:
            self._way.popleft()
        if self._under_way is not None and math.isfinite(state.reference):
            is_late = self.heard - self._sent > UNDER_WAY
            if is_late or self._shows(self._under_way) or not any(map(self._shows, self._before)):
                self._under_way = None  # it is there, or somebody else's: the state knows better
        # One that holds bridges a late sample, and goes on where its reference is: it may have an object.
        goes_on = state.phase in (FingerState.RUNNING, FingerState.HOLDING)
        if self.reference is not None and (restarted or not goes_on):
            self.follow(hold(0.0))
            self.reference = self._node.goal = None
        self._on_state(self)


class GripperNode(FingerNode):
    NAME = "gripper"
    PARAMETERS = GripperNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.fingers: list[Finger] = []
        self.motion: Motion | None = None
        self.asker: Asker | None = None  # whose motion it is
        self._stopped: Asker | None = None  # whose motion the node's end has ended
        self.goal: Goal | None = None  # the newest, until the fingers are somewhere else
        self.watchdog = self.create_steady_timer(WATCH_PERIOD, self._watch, autostart=False)
        self.listened = 0.0
        """Time (s) it has listened for: counted, so that one that stood still takes nobody for silent."""
        self.actions: list[ActionFace] = [GripFace(self, "grip")]  # there when inactive, to refuse
        self._serve_control_action()
        self.faces: list[JointStates | JointCommands | Services] = []

    def _serve_control_action(self) -> None:
        name = self.parameters.control_action
        if name == "none":
            return
        if find_spec("control_msgs") is None:
            self.get_logger().info("'~/gripper_cmd' is not served: control_msgs is not installed")
            return
        from piezo_control.nodes.faces.control_actions import FACES

        self.actions.append(FACES[name](self, "~/gripper_cmd"))

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"allow_stalling", "zero_limit"}

    def check(self, parameters: GripperNodeParameters) -> None:
        if parameters.control_action != self.parameters.control_action:
            raise ParameterError("'control_action' is fixed at start")

    def destroy_node(self) -> None:
        for action in self.actions:
            action.destroy()
        super().destroy_node()

    def start(self) -> None:
        self.fingers = [
            Finger(self, name, index, self._on_state)
            for index, name in enumerate(self.parameters.fingers)
        ]
        self.faces = [JointStates(self), JointCommands(self), Services(self)]
        self._stopped = None
        self.watchdog.reset()

    def stop(self) -> None:
        self.watchdog.cancel()
        self.active = False  # no goal from here on
        if self.asker is not None:
            self._stopped = self.asker
            self.halt("the gripper is stopped")
        for face in self.faces:
            face.destroy()
        for finger in self.fingers:
            finger.release()
        self.fingers = []

    def is_told(self) -> bool:
        return self._stopped is None or self._stopped.is_told()

    def reset(self) -> None:
        """Let both fingers leave their faults."""
        for finger in self.fingers:
            finger.reset()

    def report(self) -> tuple[str, dict[str, Any]]:
        problems = [finger.problem() for finger in self.fingers]
        figures: dict[str, Any] = {"moving": self.motion is not None}
        if self.fingers and not any(finger.silence() for finger in self.fingers):
            measured = self.measured()
            figures |= {"opening [m]": measured.opening, "force [N]": measured.force}
        return "; ".join(filter(None, problems)), figures

    # --- what the faces use -------------------------------------------------------------------------

    def check_goal(self, opening: float, max_force: float, speed: float) -> Goal:
        """Return the goal; a ValueError says why the gripper cannot go for it now."""
        if not self.active:
            raise ValueError("the gripper is not active")
        goal = check_goal(self.parameters, opening, max_force, speed)
        self._check_fingers()
        for finger in self.fingers:
            if max_force and (numbness := finger.numbness()):
                raise ValueError(numbness)
        return goal

    def check_trajectory(self, waypoints: Sequence[Waypoint]) -> Goal:
        """Return the goal that begins now; a ValueError says why the gripper cannot go for it."""
        self._check_fingers()
        here = opening_of(self.parameters, [finger.place() for finger in self.fingers])
        return check_trajectory(self.parameters, waypoints, here)

    def move(self, goal: Goal, asker: Asker) -> None:
        """Go for a goal from where the fingers are; whoever else asked for a motion is told so."""
        if self.asker is not asker:
            self._finish(failure("a new goal takes over"))
        self.motion = Motion(self.parameters, goal, [f.deflection for f in self.fingers])
        for finger in self.fingers:
            # Opening keeps the force that is held, or less: the references are ahead of the tips, and more would push on.
            is_held = finger.max_force and not self.motion.closing
            finger.max_force = min(goal.max_force, finger.max_force if is_held else math.inf)
        self.asker, self.goal = asker, goal

    def halt(self, reason: str) -> None:
        """Hold the fingers where they are; a motion ends because of `reason`."""
        self.goal = None
        self._halt_motion(failure(reason))

    def zero(self) -> str:
        """Take the fingers' present deflections for 0 and say so; a ValueError says why that cannot be."""
        if self.motion is not None:
            raise ValueError("the gripper is moving: stop it first")
        self._check_fingers()
        limit = self.parameters.zero_limit
        for finger in self.fingers:
            if not abs(finger.state.deflection) <= limit:
                raise ValueError(
                    f"finger '{finger.name}' is at {finger.state.deflection * 1e6:.3f} µm of its sensor, "
                    f"must be within ±{limit * 1e6:g} µm ('zero_limit')"
                )
        for finger in self.fingers:
            finger.zero = finger.state.deflection
        found = ", ".join(f"'{f.name}' at {f.zero * 1e6:.3f} µm" for f in self.fingers)
        return f"zero is now: {found} of the sensors"

    def measured(self) -> Measured:
        """Return what the newest states say."""
        return Measured(
            opening_of(self.parameters, [finger.deflection for finger in self.fingers]),
            -sum(finger.velocity for finger in self.fingers),
            force_of([finger.push for finger in self.fingers]),
        )

    def _check_fingers(self) -> None:
        """Raise ValueError if a finger cannot move."""
        for finger in self.fingers:
            if problem := finger.problem():
                raise ValueError(problem)

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
        outcome = motion.decide(
            [f.time for f in self.fingers],
            [f.deflection for f in self.fingers],
            [f.push for f in self.fingers],
        )
        if outcome is not None:
            self._halt_motion(outcome)

    def _watch(self) -> None:
        self.listened += WATCH_PERIOD
        if self.motion is None:
            missing = [finger.missing() for finger in self.fingers if finger.problem()]
            self.say(f"waits for {' and '.join(missing)}" if missing else "ready: both fingers run")
            return
        for finger in self.fingers:
            if finger.problem():
                self.halt(finger.problem())
                return

    # --- ends ---------------------------------------------------------------------------------------

    def _halt_motion(self, outcome: Outcome) -> None:
        """Hold the fingers where their references are, or where the tips were stopped, and end the motion."""
        for finger in self.fingers:
            if finger.reference is not None:
                place = finger.place()
                if not outcome.reached_goal:
                    # Ahead of a tip that feels, to go on pushing; no further ahead of one that does not.
                    ahead = 0.0 if finger.numbness() else HOLD_BEYOND
                    place = min(place, finger.deflection + ahead)
                finger.follow(hold(place))
        self._finish(outcome)

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
