# SPDX-License-Identifier: Apache-2.0
"""Conducts the nodes of one finger: parameters, lifecycle, profiles, and the wait for the end of a run."""

from __future__ import annotations

import hashlib
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from typing import Any

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from piezo_control.nodes.base import ROS_TYPES
from piezo_control.nodes.client import connect
from piezo_control.nodes.profile_input import to_message
from piezo_control.nodes.qos import LATCHED
from piezo_control.parameters import ParameterError, declarations, flatten
from piezo_control.profile import Profile
from piezo_gripper_msgs.msg import FingerState, RecorderState
from piezo_gripper_msgs.msg import Profile as ProfileMessage
from piezo_sim.experiment.cases import RunFailed

SERVICE_TIMEOUT = 20.0  # s
SERVICE_RETRY = 1.0  # s
DISCOVERY = 1.0  # s, in which the nodes that run become known


@contextmanager
def alone(*namespaces: str, instead: str = "ROS_DOMAIN_ID") -> Iterator[None]:
    """Keep `namespaces` for one experiment; raise ParameterError, naming them, where others run: two would drive one finger.

    An experiment whose nodes have just started is not seen yet, so each holds a socket that has a name and no file:
    it is known wherever topics of this machine are, and ends with its process, whatever ends that. `instead` is what
    the user may name another one of.
    """
    with ExitStack() as held:
        with connect() as ros:
            domain = ros.node.context.get_domain_id()
            for namespace in namespaces:
                name = hashlib.sha256(f"piezo_gripper {domain} {namespace}".encode()).hexdigest()
                try:
                    held.enter_context(socket.socket(socket.AF_UNIX)).bind(f"\0{name}")
                except OSError:
                    raise ParameterError(
                        f"another experiment runs in {namespace or '/'} of ROS domain {domain}; "
                        f"wait for its end, or name another {instead}"
                    ) from None
            ros.closing.wait(DISCOVERY)
            running = [node.rpartition("/") for node in ros.nodes()]
        for namespace in namespaces:
            names = [name for where, _, name in running if where == namespace]
            if names:
                raise ParameterError(
                    f"{namespace or '/'} has nodes already: {', '.join(names)}; "
                    f"end them, or name another {instead}"
                )
        yield


class Conductor:
    """Client side of the nodes `names` in namespace `namespace`.

    `check` is called while waiting; it raises when going on makes no sense (a dead node, a signal).
    """

    def __init__(self, names: Iterable[str], namespace: str, check: Callable[[], None]) -> None:
        self._node = Node("experiment", namespace=namespace)
        self._check = check
        self._executor = EventsExecutor()
        self._executor.add_node(self._node)
        self._clients: dict[tuple[str, str], Any] = {}
        for name in names:
            for kind, service in (
                (ChangeState, "change_state"),
                (GetState, "get_state"),
                (SetParametersAtomically, "set_parameters_atomically"),
            ):
                self._clients[name, service] = self._node.create_client(kind, f"{name}/{service}")
        self.names = list(names)
        self.finger = FingerState()
        self.recorder = RecorderState()
        self._node.create_subscription(FingerState, "state", self._on_finger, LATCHED)
        self._node.create_subscription(RecorderState, "recorder_state", self._on_recorder, LATCHED)
        self._profiles = {
            topic: self._node.create_publisher(ProfileMessage, f"{topic}_profile", LATCHED)
            for topic in ("reference", "tip_force")
        }

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()

    def wait(self, done: Callable[[], bool], timeout: float, what: str) -> None:
        """Serve events until `done()`; raise RunFailed naming `what` after `timeout` seconds."""
        end = time.monotonic() + timeout
        while not done():
            self._check()
            if time.monotonic() > end:
                raise RunFailed(f"{what}: nothing after {timeout:g} s")
            self._executor.spin_once(timeout_sec=0.02)

    def wait_for_nodes(self) -> None:
        """Wait until the services of every node answer and the finger's state is heard."""
        for (name, service), client in self._clients.items():
            self.wait(client.service_is_ready, SERVICE_TIMEOUT, f"service {name}/{service}")

    def configure(self, parameters: Mapping[str, Any]) -> None:
        """Bring every node to 'inactive' with these parameter dataclasses, one per node.

        A node takes all of its parameters or, raising RunFailed with the node's reason, none.
        """
        self._to_unconfigured()
        for name, values in parameters.items():
            request = SetParametersAtomically.Request()
            kinds = declarations(type(values))
            request.parameters = [
                Parameter(n, ROS_TYPES[kinds[n][0]], list(v) if isinstance(v, tuple) else v)
                .to_parameter_msg()
                for n, v in flatten(values).items()
            ]  # fmt: skip
            result = self._insist(name, "set_parameters_atomically", request).result
            if not result.successful:
                raise RunFailed(f"node '{name}' refused its parameters: {result.reason}")
        self._transition(self.names, Transition.TRANSITION_CONFIGURE, "configure")

    def _to_unconfigured(self) -> None:
        states = {n: self._insist(n, "get_state", GetState.Request()) for n in self.names}
        inactive = [
            name
            for name, answer in states.items()
            if answer.current_state.id == State.PRIMARY_STATE_INACTIVE
        ]
        self._transition(inactive, Transition.TRANSITION_CLEANUP, "clean up")

    def activate(self, names: Iterable[str]) -> None:
        """Activate the nodes `names`, in this order."""
        for name in names:
            self._transition([name], Transition.TRANSITION_ACTIVATE, "activate")

    def deactivate(self, names: Iterable[str]) -> None:
        """Deactivate the nodes `names`, in this order."""
        for name in names:
            self._transition([name], Transition.TRANSITION_DEACTIVATE, "deactivate")

    def publish(self, topic: str, profile: Profile) -> None:
        """Send a profile ahead ('reference' or 'tip_force') and wait until its readers have it.

        These are a node of the loop and the recorder, both configured before.
        """
        publisher = self._profiles[topic]
        self.wait(
            lambda: publisher.get_subscription_count() >= 2, SERVICE_TIMEOUT,
            f"a node and the recorder as subscribers of {topic}_profile",
        )  # fmt: skip
        publisher.publish(to_message(profile))
        publisher.wait_for_all_acked()

    def _transition(self, names: Iterable[str], transition: int, verb: str) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        answers = {name: self._call(name, "change_state", request) for name in names}
        for name, answer in answers.items():
            if not self._result(answer, f"{verb} {name}").success:
                raise RunFailed(f"node '{name}' would not {verb}; its log says why")

    def _insist(self, name: str, service: str, request: Any) -> Any:
        """Call a service whose request may be repeated, again each second until it answers.

        A node that has not discovered the client's half of the service yet cannot send its response.
        """
        calls = [self._call(name, service, request)]
        begin = time.monotonic()

        def answered() -> bool:
            if time.monotonic() - begin > len(calls) * SERVICE_RETRY:
                calls.append(self._call(name, service, request))
            return any(call.done() for call in calls)

        self.wait(answered, SERVICE_TIMEOUT, f"service {name}/{service}")
        return next(call.result() for call in calls if call.done())

    def _call(self, name: str, service: str, request: Any) -> Future:
        return self._clients[name, service].call_async(request)

    def _result(self, answer: Future, what: str) -> Any:
        self.wait(answer.done, SERVICE_TIMEOUT, what)
        return answer.result()

    def _on_finger(self, state: FingerState) -> None:
        self.finger = state

    def _on_recorder(self, state: RecorderState) -> None:
        self.recorder = state
