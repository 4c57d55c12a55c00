# SPDX-License-Identifier: Apache-2.0
"""Running fingers and grippers from Python, without a node of one's own and without the `ros2` command.

    from piezo_control.nodes.client import connect
    from piezo_control.waveform import Waveform

    with connect() as ros:
        finger = ros.finger("finger")
        finger.set(10e-6)
        finger.wait_for(lambda: abs(finger.newest().deflection - 10e-6) < 0.2e-6)
        finger.wave(Waveform("sine", amplitude=5e-6, frequency=2.0, offset=10e-6))

Every call returns when the nodes have answered, or raises ClientError with a sentence that says what did not
answer or what was refused. Signals are not received one by one: `newest` takes the last sample of each when it is
asked for, so looking at a loop of thousands of samples a second costs neither it nor the caller anything.
"""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle, InvalidNamespaceException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.validate_namespace import validate_namespace
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from piezo_control.feedback import FeedbackParameters, successor
from piezo_control.gripper import GripperParameters, check_goal, reach
from piezo_control.nodes.block import seconds
from piezo_control.nodes.parameters import ServoNodeParameters, read_feedforward
from piezo_control.nodes.phases import PHASES
from piezo_control.nodes.profile_input import from_message, waveform_message
from piezo_control.nodes.qos import FOLLOWED, LATCHED, SETPOINT
from piezo_control.nodes.spin import LONGEST_WAIT
from piezo_control.parameters import build, declarations, flatten
from piezo_control.profile import Profile, Signal
from piezo_control.safety import LARGEST_DEFLECTION
from piezo_control.start import LOOK_PERIOD, Stop
from piezo_control.waveform import Waveform
from piezo_gripper_msgs.action import Grip
from piezo_gripper_msgs.msg import FingerState, RecorderState, Sample
from piezo_gripper_msgs.msg import Profile as ProfileMessage
from piezo_gripper_msgs.msg import Waveform as WaveformMessage

ASK_AGAIN = 0.5  # s, for what can be asked more than once
FIRST_MESSAGE = 0.3  # s in which the first message of a topic comes, if it does
SILENCE = 2.0  # s; a state comes every second at least
LEAD_TIME = 0.1  # s of the finger's time from sending a waveform to its start
HOMING = {"frequency": 5.0, "duration": 2.0}  # Hz and s of the decaying sine
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
STATE_TYPE = "piezo_gripper_msgs/msg/FingerState"
CHANGE_STATE = "/change_state"
NEAR = 1e-9  # m: what is told apart from rounding
WAYS_ON = {
    FingerState.IDLE: "`fingerctl start` lets it run",
    FingerState.FAULT: "`fingerctl reset` goes on when the cause is gone",
    FingerState.RAMPING: "`fingerctl reset` goes on when the cause is gone",
    FingerState.FINISHED: "`fingerctl stop` and `fingerctl start` begin a new run",
}
"""Phases in which a finger follows no reference, and what ends them."""
FOLLOWERS = ("feedback", "servo")
"""Nodes that follow a reference."""
LIMITERS = ("servo", "feedforward")
"""Nodes that keep the voltage within its limits."""
STOPPERS = ("feedforward", "cantilever", "servo")
"""Nodes that bring the voltage to rest when they are deactivated, in an order in which none misses another."""
TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}


class ClientError(RuntimeError):
    """What was asked for was not done; the message says why."""


class Reading(NamedTuple):
    """The newest of a finger's signals, NaN for what nobody publishes."""

    number: float
    """Of the newest deflection; 0 is the first since the finger was activated."""
    time: float
    """s since sample 0, in the finger's own time."""
    reference: float
    """m; NaN where nobody has said one."""
    deflection: float
    """m"""
    command: float
    """m"""
    voltage: float
    """V"""
    temperature: float
    """°C"""
    tip_force: float
    """N"""


class Followed(NamedTuple):
    """What the loop has said that it follows."""

    heard: float
    """s, of the monotonic clock"""
    stamp: float
    """s, of the first sample at which it does"""
    signal: Signal


class Setup(NamedTuple):
    """What the nodes of a finger are set to: its controller and the limits that act on it."""

    controller: str
    """Shipped name, path of a file, or the name of a design."""
    is_closed: bool
    """Whether a controller closes the loop."""
    command_low: float
    """m"""
    command_high: float
    """m"""
    voltage_low: float
    """V"""
    voltage_high: float
    """V"""
    slew_limit: float
    """V/s"""
    force_limit: float
    """N; NaN for a finger that feels none."""


def full_namespace(text: str) -> str:
    """Return the full namespace that is meant by a text; ValueError where it cannot be one."""
    full = "/" + text.strip("/")
    try:
        validate_namespace(full)
    except InvalidNamespaceException as error:
        why = str(error).splitlines()[0].rpartition("namespace: ")[2].rstrip(":")
        raise ValueError(f"'{text}' cannot be: {why}") from None
    return full


def same(one: Signal, other: Signal) -> bool:
    """Say whether two signals are the same function of time."""
    return type(one) is type(other) and all(
        map(np.array_equal, *(vars(s).values() for s in (one, other)))
    )


def own(parameters: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of a node's `values` that are fields of its dataclass."""
    known = declarations(parameters)
    return {name: value for name, value in values.items() if name in known}


class Newest:
    """The newest message of a topic, taken when it is asked for; belongs to a node that nobody spins.

    It subscribes when it is asked for the first time, as every sample costs whoever receives and sends it, and then
    waits for a moment for the first of a topic that somebody publishes. Any thread may ask.
    """

    def __init__(self, node: Node, kind: type, topic: str) -> None:
        self._node = node
        self._subscribe = partial(node.create_subscription, kind, topic, lambda _: None, LATEST)
        self._subscription: Any = None
        self._last: Any = None
        self._one_at_a_time = threading.Lock()

    def __call__(self) -> Any:
        """Return the message; None before the first."""
        with self._one_at_a_time:
            if self._subscription is None:
                self._subscription = self._subscribe()
                end = time.monotonic() + FIRST_MESSAGE
                topic = self._subscription.topic_name
                while not self._take() and self._node.count_publishers(topic):
                    if time.monotonic() > end:
                        break
                    time.sleep(LOOK_PERIOD)
            self._take()
            return self._last

    def _take(self) -> bool:
        """Take the message that has come, if one has."""
        s = self._subscription
        with s.handle:
            taken = s.handle.take_message(s.msg_type, s.raw)
        if taken is not None:
            self._last = taken[0]
        return taken is not None


class Ros:
    """A connection to the nodes of this ROS domain; made by :func:`connect`."""

    def __init__(
        self, node: Node, watcher: Node, executor: SingleThreadedExecutor, timeout: float,
        closing: Stop,
    ) -> None:  # fmt: skip
        self.node = node
        self._executor = executor
        self.watcher = watcher
        self.timeout = timeout
        self._parameter_clients: dict[str, AsyncParameterClient] = {}
        self.closing = closing
        """Nothing is waited for any more."""
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        """The newest of each node, by its full name."""
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def finger(self, namespace: str = "") -> Finger:
        """Return the finger in a namespace, or, when none is named, the only one that is there."""
        if namespace:
            return Finger(self, full_namespace(namespace))
        self.wait(lambda: bool(self.fingers()), lambda: "no finger is running in this ROS domain")
        found = self.fingers()
        if len(found) > 1:
            raise ClientError(f"there are several fingers, name one of {', '.join(found)}")
        return Finger(self, found[0])

    def fingers(self) -> list[str]:
        """Return the namespaces of the fingers that are there."""
        topics = self.node.get_topic_names_and_types()
        return sorted(
            topic.removesuffix("/state") or "/"
            for topic, types in topics
            if topic.endswith("/state")
            and STATE_TYPE in types
            and self.node.count_publishers(topic)
        )

    def nodes(self) -> list[str]:
        """Return the full names of the nodes that have a lifecycle."""
        return sorted(
            name.removesuffix(CHANGE_STATE)
            for name, types in self.node.get_service_names_and_types()
            if "lifecycle_msgs/srv/ChangeState" in types and name.endswith(CHANGE_STATE)
        )

    def lifecycle(self, node: str, transition: str = "") -> str:
        """Take a node through a transition, if one is named, and return the state that it is in.

        Raises ClientError for a transition that the node refuses, with what it says on `/diagnostics`.
        """
        if transition:
            if transition not in TRANSITIONS:
                raise ClientError(
                    f"transition is '{transition}', must be one of {', '.join(TRANSITIONS)}"
                )
            request = ChangeState.Request(transition=Transition(id=TRANSITIONS[transition]))
            before = self.said(node, "refused")
            if not self.call(ChangeState, f"{node}{CHANGE_STATE}", request).success:
                raise ClientError(
                    f"'{node}' refuses to {transition}: it is {self.lifecycle(node)}; {self.why(node, before)}"
                )
        return self.meet(node)

    def said(self, node: str, key: str) -> str:
        """Return what a node says of itself on `/diagnostics` under a key; empty: nothing."""
        status = self.diagnostics.get(node)
        return next((f.value for f in status.values if f.key == key), "") if status else ""

    def why(self, node: str, before: str) -> str:
        """Return why a node has just refused something; `before` is what it said under `refused` before that."""
        self.wait(
            lambda: self.said(node, "refused") != before,
            lambda: f"'{node}' refuses, and does not say why",
        )
        return self.said(node, "last refusal")

    def parameters(self, node: str) -> dict[str, Any]:
        """Return all parameters of a node."""
        client = self._parameter_client(node)
        names = sorted(self.result(client.list_parameters([], 0), node).result.names)
        values = self.result(client.get_parameters(names), node).values
        return dict(zip(names, map(parameter_value_to_python, values), strict=True))

    def _parameter_client(self, node: str) -> AsyncParameterClient:
        """Return what asks a node for its parameters; it is made once for each."""
        if node not in self._parameter_clients:
            self._parameter_clients[node] = AsyncParameterClient(self.node, node)
        client = self._parameter_clients[node]
        self.wait(client.services_are_ready, lambda: f"'{node}' does not answer")
        self.meet(node)
        return client

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> None:
        """Set parameters of a node, all or none; ClientError with the reason if it refuses."""
        client = self._parameter_client(node)
        changes = []
        for name, value in values.items():
            try:
                changes.append(Parameter(name, value=value))
            except TypeError:
                raise ValueError(
                    f"'{name}' is {value}, must be a number, true or false, a text or a list of one of them"
                ) from None
        result = self.result(client.set_parameters_atomically(changes), node).result
        if not result.successful:
            raise ClientError(f"'{node}' refuses: {result.reason}")

    def grippers(self) -> list[str]:
        """Return the namespaces of the grippers that are there."""
        return [n.removesuffix("/gripper") or "/" for n in self.nodes() if n.endswith("/gripper")]

    def gripper(self, namespace: str = "") -> Gripper:
        """Return the gripper in a namespace."""
        return Gripper(self, f"{full_namespace(namespace).rstrip('/')}/gripper")

    def ask(self, who: str, ask: Callable[..., Future], *words: Any, timeout: float = 0.0) -> Any:
        """Return what an action answers.

        It is asked in the thread that hears it: rclpy takes an answer that is quicker than the note of the question
        for somebody else's.
        """
        asked = self.result(self._executor.create_task(ask, *words), who)
        return self.result(asked, who, timeout)

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Return the answer of a service."""
        client = self.node.create_client(kind, service)
        try:
            self.wait(client.service_is_ready, lambda: f"nobody serves '{service}'")
            self.meet(service.rpartition("/")[0])
            return self.result(client.call_async(request), service)
        finally:
            self.node.destroy_client(client)

    def meet(self, node: str) -> str:
        """Return the state of a node, asked until it answers: then it has met every client that was made before.

        What a node answers to a client that it has not met yet is lost, and most questions cannot be asked twice.
        """
        client = self.node.create_client(GetState, f"{node}/get_state")
        answers: queue.SimpleQueue[Future] = queue.SimpleQueue()
        end = time.monotonic() + self.timeout
        try:
            self.wait(client.service_is_ready, lambda: f"'{node}' does not answer")
            while not self.closing.is_set() and time.monotonic() < end:
                client.call_async(GetState.Request()).add_done_callback(answers.put)
                with suppress(queue.Empty):
                    return answers.get(timeout=ASK_AGAIN).result().current_state.label
            raise ClientError(f"'{node}' has not answered for {self.timeout:g} s")
        finally:
            self.node.destroy_client(client)

    def trigger(self, service: str) -> str:
        """Ask a service without arguments and return what it says; ClientError if it refuses."""
        answer = self.call(Trigger, service, Trigger.Request())
        if not answer.success:
            raise ClientError(f"'{service}' refuses: {answer.message}")
        return answer.message

    def result(self, future: Future, who: str, timeout: float = 0.0) -> Any:
        """Return what a future comes to."""
        limit = timeout or self.timeout
        end = time.monotonic() + limit
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(LOOK_PERIOD):
            if self.closing.is_set() or time.monotonic() > end:
                raise ClientError(f"'{who}' has not answered for {limit:g} s")
        return future.result()

    def wait(self, condition: Callable[[], bool], otherwise: Callable[[], str]) -> None:
        """Return when `condition` holds; after the time limit ClientError with the words of `otherwise`."""
        end = time.monotonic() + self.timeout
        while not condition():
            if self.closing.is_set() or time.monotonic() > end:
                raise ClientError(f"{otherwise()} (waited {self.timeout:g} s)")
            time.sleep(LOOK_PERIOD)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.diagnostics.update({status.name: status for status in message.status})


class Gripper:
    """A gripper, such as '/gripper'; made by :meth:`Ros.gripper`.

        with connect() as ros:
            gripper = ros.gripper()
            gripper.grasp(force=0.5e-3)

    Every motion returns how it ended, once the fingers are at rest. ClientError for one that is refused.
    """

    def __init__(self, ros: Ros, node: str) -> None:
        self.ros = ros
        self.node = node
        self.law = build(GripperParameters, own(GripperParameters, ros.parameters(node)), node)
        """Its geometry and limits."""
        # An action client stays: one that is destroyed while the thread waits for it ends the thread.
        self._grip = ActionClient(ros.node, Grip, f"{node.rpartition('/')[0]}/grip")

    def move(
        self,
        opening: float,
        speed: float = 0.0,
        max_force: float = 0.0,
        on_feedback: Callable[[Grip.Feedback], None] = lambda _: None,
        timeout: float = 120.0,
    ) -> Grip.Result:
        """Bring the fingers to an opening, or stop at a force; return how it ended.

        A gripper that has just been started is waited for until it has met its fingers.

        Parameters
        ----------
        opening, speed, max_force : m, m/s and N; 0 for speed and force: the gripper's own
        on_feedback : called with opening and force on the way
        timeout : s; when it is over the goal is canceled, and the fingers hold where they are
        """
        try:
            check_goal(self.law, opening, max_force, speed)
        except ValueError as error:
            raise ClientError(f"'{self.node}': {error}") from None
        self.ros.wait(lambda: self._problem() == "", lambda: f"'{self.node}': {self._problem()}")
        self.ros.wait(self._grip.server_is_ready, lambda: f"'{self.node}' has no action 'grip'")
        self.ros.meet(self.node)
        goal = Grip.Goal(opening=opening, max_force=max_force, speed=speed)
        before = self.ros.said(self.node, "refused")
        handle = self.ros.ask(
            self.node, self._grip.send_goal_async, goal, lambda m: on_feedback(m.feedback)
        )
        if not handle.accepted:
            raise ClientError(f"'{self.node}': {self.ros.why(self.node, before)}")
        try:
            return self.ros.ask(self.node, handle.get_result_async, timeout=timeout).result
        except BaseException:
            handle.cancel_goal_async()
            raise

    def grasp(self, force: float, speed: float = 0.0) -> Grip.Result:
        """Close until both tips push with `force` (N), and hold that; ClientError where nothing is in between."""
        result = self.move(reach(self.law)[0], speed, force)
        if not result.stalled or math.isnan(result.force):
            raise ClientError(
                f"'{self.node}' has grasped nothing: it is at an opening of {result.opening * 1e6:.2f} µm, force "
                f"{result.force * 1e3:.3g} mN"
            )
        return result

    def release(self, speed: float = 0.0) -> Grip.Result:
        """Go to the widest opening."""
        return self.move(reach(self.law)[1], speed)

    def _problem(self) -> str:
        """Return what keeps the gripper from moving, as it says on `/diagnostics`."""
        status = self.ros.diagnostics.get(self.node)
        if status is None:
            return "silent on '/diagnostics'"
        return "" if status.level == DiagnosticStatus.OK else status.message

    def home(self) -> str:
        """Begin to go to the opening at rest; return what the gripper says."""
        return self.ros.trigger(f"{self.node}/home")

    def stop(self) -> str:
        """Let the fingers hold where they are; return what the gripper says."""
        return self.ros.trigger(f"{self.node}/stop")


class Finger:
    """A finger, simulated or real, in a namespace such as '/finger'; made by :meth:`Ros.finger`."""

    def __init__(self, ros: Ros, namespace: str) -> None:
        self.ros = ros
        self.namespace = namespace
        self.prefix = namespace.rstrip("/") + "/"
        self.state: FingerState | None = None
        """The newest state; None before the first."""
        self._heard = -math.inf
        node, watcher = ros.node, ros.watcher
        node.create_subscription(FingerState, f"{self.prefix}state", self._on_state, LATCHED)
        self._followed = deque[Followed](maxlen=2 * FOLLOWED.depth)
        for form, kind, read in (
            ("profile", ProfileMessage, from_message),
            ("waveform", WaveformMessage, Waveform.of),
        ):
            node.create_subscription(
                kind,
                f"{self.prefix}reference_followed_{form}",
                partial(self._on_followed, read),
                FOLLOWED,
            )
        self._set_points = node.create_publisher(Sample, f"{self.prefix}reference", SETPOINT)
        self._waveforms = node.create_publisher(
            WaveformMessage, f"{self.prefix}reference_waveform", SETPOINT
        )
        self._samples = {
            name: Newest(watcher, Sample, f"{self.prefix}{name}")
            for name in ("deflection", "command", "voltage")
        }
        self._temperature = Newest(watcher, Temperature, f"{self.prefix}temperature")
        self._recorder = Newest(watcher, RecorderState, f"{self.prefix}recorder_state")

    def nodes(self) -> list[str]:
        """Return the full names of the finger's nodes."""
        return [n for n in self.ros.nodes() if n.rpartition("/")[0] + "/" == self.prefix]

    def newest(self) -> Reading:
        """Return the newest sample of every signal."""
        deflection = self._samples["deflection"]()
        nan = float("nan")
        state = self.state
        elapsed = deflection.number * deflection.period if deflection else nan
        values = {name: getattr(take(), "value", nan) for name, take in self._samples.items()}
        return Reading(
            number=deflection.number if deflection else nan,
            time=elapsed,
            reference=self._reference_at(elapsed),
            temperature=getattr(
                self._temperature(), "temperature", state.temperature if state else nan
            ),
            tip_force=state.tip_force if state else nan,
            **values,
        )

    def _reference_at(self, elapsed: float) -> float:
        """Return the reference (m) that is followed, by what the loop says and the finger's state agrees with."""
        state = self.state
        if state is None:
            return math.nan
        # Profiles and waveforms come on two topics, so in which order they were said is not known.
        newest = {type(one.signal): one for one in tuple(self._followed)}
        for heard, stamp, signal in sorted(
            newest.values(), key=lambda one: one.heard, reverse=True
        ):
            is_newer = heard > self._heard and stamp > seconds(state.header.stamp)
            then = float(signal.at(state.samples * state.period))
            if is_newer or abs(then - state.reference) <= NEAR:
                return float(signal.at(elapsed))
        return state.reference

    @property
    def is_silent(self) -> bool:
        """Whether no state came for so long that the finger is taken for gone."""
        return time.monotonic() - self._heard > SILENCE

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Return when `condition` holds; ClientError with the finger's state when it does not in time."""
        self.ros.wait(condition, lambda: f"'{self.namespace}' is {self.words()}")

    def words(self) -> str:
        """Return in words what the finger does."""
        if self.state is None:
            others = ", ".join(self.ros.fingers()) or "none"
            return f"silent: nothing on '{self.prefix}state'; fingers that are there: {others}"
        if self.is_silent:
            silence = time.monotonic() - self._heard
            return f"silent: nothing on '{self.prefix}state' for {silence:.0f} s"
        text = f": {self.state.text}" if self.state.text else ""
        return f"{PHASES[self.state.phase]}{text}"

    # --- the reference ------------------------------------------------------------------------------

    def set(self, deflection: float) -> None:
        """Let the finger go to a deflection (m) and stay there."""
        if not abs(deflection) <= LARGEST_DEFLECTION:
            raise ClientError(
                f"deflection is {deflection:g} m, must be within ±{LARGEST_DEFLECTION:g} m: metres?"
            )
        self._need_reach(deflection, deflection)
        self._send(
            self._set_points,
            lambda: Profile([0.0], [deflection]),
            lambda s: Sample(value=s.value[0]),
        )

    def zero(self) -> None:
        """Let the finger go to a deflection of 0 and stay there."""
        self.set(0.0)

    def home(self) -> None:
        """Let the finger forget what was before: a sine over all its range that decays to the middle of it."""
        setup = self.setup()
        middle = 0.5 * (setup.command_low + setup.command_high)
        half = setup.command_high - middle
        self.wave(Waveform("decaying_sine", amplitude=half, offset=middle, **HOMING))

    def wave(self, waveform: Waveform) -> None:
        """Let the finger follow a waveform (m), from a tenth of a second ahead; its own `start` is not used.

        ClientError where the finger does not run, as then there is no time to start from.
        """
        if not waveform.largest <= LARGEST_DEFLECTION:
            raise ClientError(
                f"the waveform goes up to {waveform.largest:g} m, must be within ±{LARGEST_DEFLECTION:g} m"
            )
        self._need_reach(*waveform.ends)
        self.wait_for(lambda: self.newest().time >= 0.0)
        self._send(
            self._waveforms,
            lambda: replace(waveform, start=self.newest().time + LEAD_TIME),
            waveform_message,
        )

    def reach(self) -> tuple[float, float]:
        """Return the lowest and the highest command (m) of the finger's loop; no reference is followed beyond."""
        node = self._follower()
        ends = [self.ros.said(node, f"command_{end} [m]") for end in ("low", "high")]
        if not all(ends):
            return -math.inf, math.inf  # it is not active, or says none
        return float(ends[0]), float(ends[1])

    def _need_reach(self, lowest: float, highest: float) -> None:
        """Raise ClientError for a finger that is at rest, or that cannot go from `lowest` to `highest` (m)."""
        self.wait_for(lambda: self.state is not None)
        # The state of one that has just been started may be on its way.
        end = time.monotonic() + ASK_AGAIN
        while rest := self._rest():
            if time.monotonic() > end:
                raise ClientError(rest)
            time.sleep(LOOK_PERIOD)
        low, high = self.reach()
        for value in (lowest, highest):
            if not low - NEAR <= value <= high + NEAR:
                raise ClientError(
                    f"the reference goes to {value * 1e6:g} µm, '{self.namespace}' has commands of "
                    f"{low * 1e6:g} to {high * 1e6:g} µm"
                )

    def _rest(self) -> str:
        """Return in words that the finger is at rest and what lets it go on; empty: it moves."""
        way_on = WAYS_ON.get(self.state.phase) if self.state else ""
        return f"'{self.namespace}' does not move, it is {self.words()}; {way_on}" if way_on else ""

    def _follower(self) -> str:
        """Return the node that follows references, once it has said how it is."""
        node = self.node(*FOLLOWERS)
        self.ros.wait(
            lambda: node in self.ros.diagnostics, lambda: f"'{node}' is silent on '/diagnostics'"
        )
        return node

    def _send(self, publisher: Any, make: Callable[[], Any], message: Callable[[Any], Any]) -> None:
        """Publish the message of the signal that `make()` returns then; return when it is followed."""

        def followers() -> list[str]:
            found = self.ros.node.get_subscriptions_info_by_topic(publisher.topic_name)
            return [one.node_name for one in found if one.node_name in FOLLOWERS]

        self.ros.wait(
            lambda: 0 < len(followers()) <= publisher.get_subscription_count(),
            lambda: f"nobody follows '{publisher.topic_name}': {self.words()}",
        )
        node = self._follower()
        before, sent = self.ros.said(node, "refused"), time.monotonic()
        signal = make()
        publisher.publish(message(signal))

        def is_followed() -> bool:
            return any(f.heard > sent and same(signal, f.signal) for f in tuple(self._followed))

        def is_refused() -> bool:
            return self.ros.said(node, "refused") != before

        self.ros.wait(
            lambda: is_followed() or is_refused() or bool(self._rest()),
            lambda: f"'{node}' does not say that it follows: '{self.namespace}' is {self.words()}",
        )
        if not is_followed():
            why = self.ros.said(node, "last refusal")
            raise ClientError(f"'{node}': {why}" if is_refused() else self._rest())

    # --- the loop -----------------------------------------------------------------------------------

    def node(self, *names: str) -> str:
        """Return the full name of the first of these nodes that is there."""

        def found() -> list[str]:
            return [self.prefix + name for name in names if self.prefix + name in self.nodes()]

        self.ros.wait(
            lambda: bool(found()),
            lambda: (
                f"'{self.namespace}' has no node {' or '.join(map(repr, names))}; it has "
                f"{', '.join(self.nodes()) or 'none'}"
            ),
        )
        return found()[0]

    def control(self, controller: str) -> None:
        """Let another controller take over: a shipped name, the path of a file, or 'none': open loop."""
        self.ros.set_parameters(self.node(*FOLLOWERS), {"controller_file": controller})

    def setup(self) -> Setup:
        """Return what its nodes are set to.

        Raises ParameterError where a servo has that from files which are not on this machine.
        """
        follower, limiter = self.node(*FOLLOWERS), self.node(*LIMITERS)
        values = self.ros.parameters(follower)
        if follower == limiter:
            servo = build(ServoNodeParameters, own(ServoNodeParameters, values), follower)
            controller = flatten(successor(servo.controller_file, FeedbackParameters()))
            feedback = {**flatten(servo), **controller}
            feedforward = flatten(read_feedforward(servo))
        else:
            feedback, feedforward = values, self.ros.parameters(limiter)
        feels = feedback.get("force_control", False)
        name = values["controller_file"] or feedback["name"]
        return Setup(
            controller="force control" if feels else name,
            is_closed=feels or feedback["controller"] != "none",
            command_low=feedback["command_low"],
            command_high=feedback["command_high"],
            voltage_low=feedforward["voltage_low"],
            voltage_high=feedforward["voltage_high"],
            slew_limit=feedforward["slew_limit"],
            force_limit=feedback["touch.force_limit"] if feels else math.nan,
        )

    def stop(self) -> None:
        """Bring the voltage to rest, where it stays until `start`; a finger that is stopped stays so."""
        refused = [words for node in self._stoppers() if (words := self._bring_to_rest(node))]
        if refused:
            raise ClientError("; ".join(refused))

    def _bring_to_rest(self, node: str) -> str:
        """Deactivate a node and return why it is not inactive then; empty: it is."""
        try:
            self.ros.lifecycle(node, "deactivate")
        except ClientError as error:
            with suppress(ClientError):
                if self.ros.lifecycle(node) == "inactive":
                    return ""
            return str(error)
        return ""

    def start(self) -> None:
        """Let a stopped finger run again; its reference is that of before."""
        nodes = self._stoppers()
        stopped = [node for node in nodes if self.ros.lifecycle(node) != "active"]
        for node in stopped or nodes:  # one that runs refuses
            self.ros.lifecycle(node, "activate")

    def _stoppers(self) -> list[str]:
        """Return the full names of those of `STOPPERS` that are there; ClientError: none is."""
        self.node(*STOPPERS)
        there = self.nodes()
        return [self.prefix + name for name in STOPPERS if self.prefix + name in there]

    def reset(self) -> dict[str, str]:
        """Leave latched faults; return what each node says. ClientError if one of them cannot.

        The finger itself comes last, since its first sample has to be answered by all the others.
        """
        nodes = sorted(self.nodes(), key=lambda name: name.endswith(STOPPERS[1:]))
        if not nodes:
            raise ClientError(f"'{self.namespace}' is {self.words()}")
        answers = {n: self.ros.call(Trigger, f"{n}/reset", Trigger.Request()) for n in nodes}
        refused = [f"'{n}' cannot reset: {a.message}" for n, a in answers.items() if not a.success]
        if refused:
            raise ClientError("; ".join(refused))
        return {name: answer.message for name, answer in answers.items()}

    # --- the recorder -------------------------------------------------------------------------------

    def record(self, bag: str = "") -> str:
        """Let the recorder begin a bag, and return its folder; empty: one named by the time.

        The folder is on the recorder's machine, relative to where it was started.
        """
        recorder = self.node("recorder")
        if self.ros.lifecycle(recorder) == "active":
            if self._is_recording():
                raise ClientError(
                    f"'{recorder}' is recording already; `fingerctl record off` ends that"
                )
            self.ros.lifecycle(recorder, "deactivate")
        self.ros.set_parameters(recorder, {"bag": bag})
        if self.ros.lifecycle(recorder) == "unconfigured":
            self.ros.lifecycle(recorder, "configure")
        self.ros.lifecycle(recorder, "activate")
        self.wait_for(lambda: bool(self._recorder() and self._recorder().bag))
        return self._recorder().bag

    def end_record(self) -> None:
        """Let the recorder finish its bag."""
        recorder = self.node("recorder")
        if self.ros.lifecycle(recorder) != "active":
            raise ClientError(f"'{recorder}' is not recording")
        is_whole = self._is_recording()
        self.ros.lifecycle(recorder, "deactivate")
        self.ros.lifecycle(recorder, "cleanup")
        if not is_whole:
            raise ClientError(f"'{recorder}' had to end its recording before; its log says why")

    def _is_recording(self) -> bool:
        """Say whether the active recorder has a bag: it gives up one that the disk does not take."""
        state = self._recorder()
        return state is None or bool(state.bag)

    def _on_followed(self, read: Callable[[Any], Signal], message: Any) -> None:
        try:
            signal = read(message)
        except ValueError as error:
            logger = self.ros.node.get_logger()
            logger.error(f"'{self.prefix}reference_followed' ignored: {error}")
            return
        stamp = seconds(message.header.stamp)
        self._followed.append(Followed(time.monotonic(), stamp, signal))

    def _on_state(self, state: FingerState) -> None:
        self._heard = time.monotonic()
        self.state = state


@contextmanager
def connect(timeout: float = 10.0, closing: Stop | None = None) -> Iterator[Ros]:
    """Return a connection to the nodes of this ROS domain; `timeout` (s) holds for every answer.

    Once `closing` is set, by a signal for example, all that is waited for ends with a ClientError. A program should
    end the connection whatever ends it: of one that is killed the finger's middleware keeps sending to a memory that
    nobody reads, and for half a minute the next client may hear nothing there.
    """
    closing = closing or Stop()
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node, watcher = (
        rclpy.create_node(
            f"{name}_{os.getpid()}",
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
        )
        for name in ("client", "watcher")
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    ros = Ros(node, watcher, executor, timeout, closing)

    def spin() -> None:
        while not closing.is_set():
            # What another thread destroys while this one prepares to wait is left out of the next wait.
            with suppress(InvalidHandle):
                executor.spin_once(timeout_sec=LONGEST_WAIT)

    thread = threading.Thread(target=spin, name="client", daemon=True)
    thread.start()
    try:
        yield ros
    finally:
        closing.set()
        thread.join()
        executor.shutdown()
        watcher.destroy_node()
        node.destroy_node()
        context.try_shutdown()
