# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: parameters from one dataclass, a lifecycle, a `run` that stops safely."""

from __future__ import annotations

import argparse
import atexit
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy._rclpy_pybind11 import RCLError, RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import (
    InvalidHandle,
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from piezo_control.nodes import spin
from piezo_control.nodes.network import Networks
from piezo_control.parameters import (
    OF_EVERY_NODE,
    ParameterError,
    build,
    declarations,
    is_for,
    need_one_for,
    provenance,
    unknown,
)
from piezo_control.safety import PHASES, Guard
from piezo_control.start import FREEING, end_within, over_within, stop_at_signals

DIAGNOSTICS_PERIOD = 1.0  # s
FAREWELL = 2.0  # s: so long the end of a program waits for those who have still to be told

ROS_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple[float, ...]: Parameter.Type.DOUBLE_ARRAY,
    tuple[str, ...]: Parameter.Type.STRING_ARRAY,
}


def system_time() -> Time:
    """Return the time of the clock on the wall as a stamp, whatever simulated time says."""
    return Clock().now().to_msg()


def wall_time(instant: float) -> Time:
    """Return an instant of `time.monotonic` (s) as a stamp of the clock on the wall; NaN as 0."""
    if math.isnan(instant):
        return Time()
    seconds, nanoseconds = divmod(round((time.time() - time.monotonic() + instant) * 1e9), 10**9)
    return Time(sec=seconds, nanosec=nanoseconds)


def told(guard: Guard) -> dict[str, Any]:
    """Return what a guard does, since when and how often, as figures for `/diagnostics`."""
    since = wall_time(guard.since).sec
    return {
        "phase": PHASES[guard.phase],
        "since": time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since)) if since else "",
        "faults": guard.times,
    }


class FingerNode(LifecycleNode):
    """A lifecycle node whose ROS parameters are the fields of the dataclass `PARAMETERS`.

    A subclass names its dataclass, and overrides `start` (activation), `stop` (deactivation, shutdown
    and signals alike) and, where a change while active makes sense, `apply`. `parameters` always holds
    a complete valid set: a change that the dataclass refuses is refused as a whole.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[type]

    def __init__(self) -> None:
        super().__init__(self.NAME)
        self.declare_parameter(
            "autostart",
            True,
            ParameterDescriptor(description="configure and activate at start", read_only=True),
        )
        self._declarations = declarations(self.PARAMETERS)
        given = self._parameter_overrides  # of command line and files
        given.update((p.name, p) for p in self._promoted(list(given.values())))
        for name, (kind, field) in self._declarations.items():
            default = field.default
            # An empty list shows no element type, as default or as what was given; it is set after the type.
            value = list(default) if isinstance(default, tuple) else default
            declared = self.declare_parameter(
                name, ROS_TYPES[kind] if default == () else value, describe(name, kind, field)
            )
            if declared.type_ == Parameter.Type.NOT_SET:
                self.set_parameters([Parameter(name, ROS_TYPES[kind], [])])
        self.parameters: Any = build(self.PARAMETERS, self._values({}))
        self.active = False
        self._said = ""
        self._refused, self._refusal = 0, ""
        self._origins: dict[
            str, str
        ] = {}  # of parameters: what they are of, and where they come from
        self._networks = Networks()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_steady_timer(DIAGNOSTICS_PERIOD, self.publish_diagnostics)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.add_pre_set_parameters_callback(self._promoted)
        self.add_on_set_parameters_callback(self._validate)
        self.add_post_set_parameters_callback(self._changed)

    def create_steady_timer(
        self, period: float, callback: Callable[[], None], autostart: bool = True
    ) -> Timer:
        """Return a timer (s) that neither simulated time nor a change of the system's clock can stop."""

        def due() -> None:
            # One that was due when it was cancelled, or destroyed, is served still, now and then.
            try:
                is_over = timer.is_canceled()
            except InvalidHandle:
                is_over = True
            if not is_over:
                callback()

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.create_timer(period, due, clock=steady, autostart=autostart)
        return timer

    def say(self, text: str) -> None:
        """Log what the node does from now on, or waits for; the same again is not said twice."""
        if text != self._said:
            self._said = text
            self.get_logger().info(text)

    def missed_networks(self) -> str:
        """Say which networks this node does not hear, because they came up after it started; and log it once."""
        if missed := self._networks.missed():
            self.get_logger().warning(missed, once=True)
        return missed

    def comes_from(self, what: str, path: str | Path) -> None:
        """Say where the values of a file come from, here and on `/diagnostics`, if it says it; empty: of no file."""
        try:
            words = "; ".join(provenance(path)) if path else ""
        except (
            ParameterError
        ) as error:  # it has been read, and is gone since: nothing that a node ends for
            words = str(error)
        if words and self._origins.get(what) != words:
            self.get_logger().info(f"{what} {path}: {words}")
        self._origins[what] = words

    def refuse(self, words: str) -> None:
        """Say what is refused and why, for which the answer has no room: in the log and on `/diagnostics`."""
        self.get_logger().error(words)
        self._refused += 1
        self._refusal = words
        self.publish_diagnostics()

    def way_on(self) -> str:
        """Return how people leave a latched fault."""
        name = self.get_fully_qualified_name()
        return f"service '{name}/reset' (`fingerctl reset`) or a new activation goes on"

    def reset(self) -> None:
        """Leave a latched fault; a ValueError raised here says why that cannot be."""

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return what is wrong, in words (empty: nothing), and figures for `/diagnostics`."""
        return "", {}

    def check(self, parameters: Any) -> None:
        """Raise ValueError if `parameters`, each of them valid, cannot follow the present ones."""

    def start(self) -> None:
        """Begin to work with `self.parameters`; a ValueError raised here refuses the activation."""

    def stop(self) -> None:
        """Leave the finger safe, when activity ends for whatever reason, or `start` has failed half-way."""

    def is_told(self) -> bool:
        """Say whether everyone knows how it ended who asked the node for something, after `stop`."""
        return True

    def apply(self) -> None:
        """Take up changed `self.parameters` while active."""

    def refuses_while_active(self, names: set[str]) -> set[str]:
        """Return those of `names` that cannot change while the node is active; by default all."""
        return names

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            with ExitStack() as half:
                half.callback(self.stop)  # what has begun when it fails
                self.start()
                half.pop_all()
        except ValueError as error:
            self.refuse(f"not activated: {error}")
            return TransitionCallbackReturn.FAILURE
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._halt()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._halt()
        return super().on_shutdown(state)

    def trigger_shutdown(self) -> TransitionCallbackReturn:
        """Shut down, also from the state in which that has been done already."""
        try:
            return super().trigger_shutdown()
        except RCLError:
            return TransitionCallbackReturn.FAILURE

    def destroy_node(self) -> None:
        """Free the node and all its entities, and with the last node the middleware's threads.

        rclpy leaves the state machine's, and so the node. A middleware that still runs when the program exits
        crashes now and then, or never ends.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:
        # Every transition goes through this method of rclpy's mixin, which lets an impossible one end the
        # process. A client that asks for one gets "no" instead.
        try:
            return super()._LifecycleNodeMixin__change_state(transition_id)  # type: ignore[misc]
        except RCLError:
            self.refuse(f"transition {transition_id} is not possible in this state")
            return TransitionCallbackReturn.FAILURE

    def _LifecycleNodeMixin__execute_callback(
        self, state: int, previous: LifecycleState
    ) -> TransitionCallbackReturn:
        # rclpy says nothing of an error in a transition.
        callback = self._callbacks.get(state)
        try:
            return callback(previous) if callback else TransitionCallbackReturn.SUCCESS
        except Exception as error:  # whatever a transition may lead to
            self.refuse(f"transition failed: {type(error).__name__}: {error}")
            return TransitionCallbackReturn.ERROR

    def publish_diagnostics(self) -> None:
        """Publish the state of this node on `/diagnostics`."""
        wrong, figures = self.report()
        figures = figures | {f"{what} from": words for what, words in self._origins.items()}
        if missed := self.missed_networks():
            figures |= {"not heard": missed}
        if self._refused:
            figures |= {"refused": self._refused, "last refusal": self._refusal}
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id="piezo_gripper")
        status.level = DiagnosticStatus.ERROR if wrong else DiagnosticStatus.OK
        status.message = wrong or ("active" if self.active else "not active")
        status.values = [KeyValue(key=key, value=str(value)) for key, value in figures.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = system_time()
        self._diagnostics.publish(message)

    def _on_reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        wrong, _ = self.report()
        try:
            self.reset()
        except ValueError as error:
            answer.success, answer.message = False, str(error)
        else:
            answer.success, answer.message = (
                True,
                f"reset; it was: {wrong}" if wrong else "no fault",
            )
            self.get_logger().info(answer.message)
            self._said = ""
        self.publish_diagnostics()
        return answer

    def _halt(self) -> None:
        if self.active:
            self.stop()
            self.active = False
            self.say("not active")

    def _promoted(self, given: list[Parameter]) -> list[Parameter]:
        """Return the `given` parameters with whole numbers as doubles where doubles are declared."""
        promoted = []
        for p in given:
            kind = self._declarations[p.name][0] if p.name in self._declarations else None
            if p.type_ == Parameter.Type.INTEGER and kind is float:
                p = Parameter(p.name, value=float(p.value))
            elif p.type_ == Parameter.Type.INTEGER_ARRAY and kind == tuple[float, ...]:
                p = Parameter(p.name, value=[float(v) for v in p.value])
            promoted.append(p)
        return promoted

    def _values(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        values = {name: self.get_parameter(name).value for name in self._declarations}
        values.update(changes)
        return {
            n: tuple(v) if not isinstance(v, (bool, int, float, str)) else v
            for n, v in values.items()
        }

    def _validate(self, changes: list[Parameter]) -> SetParametersResult:
        before = self._values({})
        after = self._values({p.name: p.value for p in changes if p.name in before})
        ours = {name: value for name, value in after.items() if value != before[name]}
        frozen = self.refuses_while_active(set(ours)) if self.active else set()
        if frozen:
            reason = f"{', '.join(sorted(frozen))}: deactivate '{self.NAME}' first"
            return SetParametersResult(successful=False, reason=reason)
        try:
            wanted: Any = build(self.PARAMETERS, self._values(ours))
            if ours:
                self.check(wanted)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _changed(self, changes: list[Parameter]) -> None:
        if any(p.name in self._declarations for p in changes):
            self.parameters = build(self.PARAMETERS, self._values({}), self.NAME)
            if self.active:
                self.apply()
                self.publish_diagnostics()


def parameter_type(cls: type, name: str) -> Parameter.Type:
    """Return the ROS type of the parameter `name` of a parameter dataclass."""
    return ROS_TYPES[declarations(cls)[name][0]]


def describe(name: str, kind: type, field: Any) -> ParameterDescriptor:
    """Return the ROS descriptor of a declared parameter: meaning, unit and allowed range."""
    low, high = field.metadata["low"], field.metadata["high"]
    text = field.metadata["description"]
    if field.metadata["unit"]:
        text += f" [{field.metadata['unit']}]"
    if field.metadata["choices"]:
        text += f"; one of {', '.join(field.metadata['choices'])}"
    elif math.isfinite(low) or math.isfinite(high):
        text += f"; in [{low:g}, {high:g}]"
    descriptor = ParameterDescriptor(name=name, description=text)
    if math.isfinite(low) and math.isfinite(high):
        if kind is float:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        elif kind is int:
            descriptor.integer_range = [
                IntegerRange(from_value=int(low), to_value=int(high), step=1)
            ]
    return descriptor


def run(*node_types: type[FingerNode]) -> int:
    """Run nodes in this process until a signal ends it; return its exit code.

    Several nodes start in the order given and stop in the opposite one.
    """
    stop = stop_at_signals()
    nodes: list[FingerNode] = []
    serving = ExitStack()
    code = 2
    try:
        parse(node_types)
        spin.init()
        for node_type in node_types:
            nodes.append(node_type())
        refuse_unknown(nodes)
        for path in parameter_files():  # rcl passes over one for other nodes without a word
            need_one_for(path, [node.get_fully_qualified_name() for node in nodes])
            for node in nodes:
                if is_for(path, node.get_fully_qualified_name()):
                    node.comes_from("parameters", path)
        for node in nodes:
            if node.get_parameter("autostart").value:
                if node.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                    node.trigger_activate()
            else:
                node.say("waits to be configured and activated, as by `fingerctl lifecycle`")
        serve = serving.enter_context(spin.serving(nodes))
        serve(stop.is_set)
        for node in reversed(nodes):
            node.trigger_shutdown()
        end = time.monotonic() + FAREWELL
        serve(lambda: time.monotonic() > end or all(node.is_told() for node in nodes))
        code = 0
    except (ParameterError, InvalidParameterTypeException, InvalidParameterValueException) as error:
        name, text = node_types[min(len(nodes), len(node_types) - 1)].NAME, str(error)
        if files := [path for path in parameter_files() if path not in text]:
            text += f"; parameters come from {', '.join([*files, *{'-p'} & set(sys.argv)])}"
        print(f"{name}: {text}", file=sys.stderr)
    except (RCLError, RCLInvalidROSArgsError, UnknownROSArgsError) as error:
        # A parameter file or an argument that rcl cannot read; its first line names it.
        print(f"{node_types[0].NAME}: {str(error).splitlines()[0]}", file=sys.stderr)
    finally:
        for node in reversed(nodes):
            node.trigger_shutdown()
        atexit.register(end_within, FREEING, code)  # Python frees the rest of it
        with over_within(FREEING, code):
            serving.close()
            for node in reversed(nodes):
                node.destroy_node()
            rclpy.try_shutdown()
    return code


def parameter_files() -> list[str]:
    """Return the parameter files that the command line names."""
    words = zip(sys.argv, sys.argv[1:])
    return [path for flag, path in words if flag == "--params-file"]


def refuse_unknown(nodes: Sequence[FingerNode]) -> None:
    """Raise ParameterError for a parameter that was given at start and that none of the `nodes` has."""
    known = {name: None for node in nodes for name in declarations(node.PARAMETERS)}
    for node in nodes:
        for name in node._parameter_overrides:  # rclpy keeps what is not declared, and says nothing
            if name not in known and name.split(".")[0] not in OF_EVERY_NODE:
                raise ParameterError(unknown(name, known))


def parse(node_types: Sequence[type[FingerNode]]) -> None:
    """Serve `--help`: what the nodes do, and every parameter with default, unit and range."""
    description, parameters = [], []
    for node_type in node_types:
        description.append(f"node '{node_type.NAME}': {sys.modules[node_type.__module__].__doc__}")
        parameters.append(f"parameters of '{node_type.NAME}':")
        for name, (kind, field) in declarations(node_type.PARAMETERS).items():
            default = list(field.default) if isinstance(field.default, tuple) else field.default
            parameters.append(f"  {name} = {default}")
            parameters.append(f"      {describe(name, kind, field).description}")
    parser = argparse.ArgumentParser(
        description="\n".join(description),
        epilog="\n".join(parameters),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s [-h] [--ros-args -p NAME:=VALUE … --params-file FILE -r __ns:=/FINGER …]",
    )
    parser.parse_args(remove_ros_args(sys.argv)[1:])
