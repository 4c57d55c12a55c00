# SPDX-License-Identifier: Apache-2.0
"""Single nodes as a user meets them: the test plays the neighbours, over real topics."""

import itertools
import math
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import rclpy
from ament_index_python.packages import get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from mcap.reader import make_reader
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from piezo_control.dynamics import DynamicsParameters
from piezo_control.feedback import Feedback, FeedbackParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.nodes.feedback import FeedbackNode
from piezo_control.nodes.qos import FAULTS, FOLLOWED, LATCHED, SAMPLE, SETPOINT
from piezo_control.nodes.recorder import RecorderNode
from piezo_control.nodes.sole_input import SoleInput
from piezo_control.parameters import build, load
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import read
from piezo_control.touch import Touch, TouchParameters
from piezo_gripper_msgs.msg import (
    Dynamics,
    Fault,
    FingerState,
    Profile,
    RecorderState,
    Sample,
    SampleSeries,
)
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes.processes import NodeProcesses
from piezo_sim.nodes.cantilever import CantileverNode

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"
TIMEOUT = 60.0  # s, generous: the tests wait on conditions


class Neighbour:
    """A node of the test that publishes and listens beside the node under test."""

    def __init__(self):
        self.node = rclpy.create_node("neighbour")
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()

    def wait(self, done, timeout=TIMEOUT):
        end = time.monotonic() + timeout
        while not done():
            assert time.monotonic() < end, "nothing came"
            self.executor.spin_once(timeout_sec=0.02)

    @staticmethod
    def wait_idle(done):
        """Wait for what the middleware does by itself, with a node that looks at nothing meanwhile."""
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, "nothing came"

    def insist(self, publisher, message, done, period=0.05):
        """Publish again and again until `done()`, as what is sent before the endpoints match is lost."""
        over = False
        # A timer that is due when it is destroyed is served still, now and then: its sample would begin a new run.
        timer = self.node.create_timer(period, lambda: over or publisher.publish(message))
        self.wait(done)
        over = True
        self.node.destroy_timer(timer)

    def ask_sample(self, publisher, message, answers):
        """Send a sample and wait for its answer; asked again where none comes, as the plant does."""
        publisher.publish(message)
        self.insist(publisher, message, lambda: answers[-1].number == message.number, period=5.0)

    def listen(self, kind, topic, qos=SAMPLE):
        heard = []
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def publisher(self, topic, qos=SAMPLE):
        publisher = self.node.create_publisher(Sample, topic, qos)
        self.wait(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def ask(self, kind, service, request):
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready)
        if (
            kind is ChangeState
        ):  # must not be repeated; the round trip before lets the endpoints match
            self.get(service.split("/")[0], "autostart")
            answer = client.call_async(request)
            self.wait(answer.done)
            return answer.result()
        # The first response can be lost while the endpoints match, so the request is repeated.
        answers = [client.call_async(request)]
        timer = self.node.create_timer(1.0, lambda: answers.append(client.call_async(request)))
        self.wait(lambda: any(answer.done() for answer in answers))
        self.node.destroy_timer(timer)
        return next(answer.result() for answer in answers if answer.done())

    def tell(self, node, publisher, message):
        """Publish a message that `node` has taken when this returns, as it serves events in their order."""
        publisher.publish(message)
        assert publisher.wait_for_all_acked()
        self.get(node, "autostart")

    def set(self, node, **values):
        request = SetParametersAtomically.Request()
        request.parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        return self.ask(
            SetParametersAtomically, f"{node}/set_parameters_atomically", request
        ).result

    def get(self, node, name):
        (value,) = self.ask(
            GetParameters, f"{node}/get_parameters", GetParameters.Request(names=[name])
        ).values
        return Parameter.from_parameter_msg(
            rclpy.parameter.ParameterMsg(name=name, value=value)
        ).value

    def change_state(self, node, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.ask(ChangeState, f"{node}/change_state", request).success


@pytest.fixture
def neighbour():
    rclpy.init()
    neighbour = Neighbour()
    yield neighbour
    neighbour.close()
    rclpy.shutdown()


def node(name, tmp_path, file=None, **parameters):
    arguments = ["--ros-args"]
    if file:
        arguments += ["--params-file", str(params_folder() / file)]
    for key, value in parameters.items():
        arguments += ["-p", f"{key}:={value}"]
    return NodeProcesses({name: arguments}, tmp_path)


def sample(number, value):
    return Sample(number=number, value=value)


def test_feedback_answers_each_sample_once_and_repeats_on_request(neighbour, tmp_path):
    law = Feedback(
        build(FeedbackParameters, load(params_folder() / "feedback_paper.yaml", "feedback"))
    )
    deflections = [0.0, 1e-6, 2.5e-6]
    expected = [law.step(10e-6, deflection) for deflection in deflections]
    with node("feedback", tmp_path, "feedback_paper.yaml"):
        commands = neighbour.listen(Sample, "command")
        followed = neighbour.listen(Profile, "reference_followed_profile", FOLLOWED)
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        neighbour.tell("feedback", reference, sample(0, 10e-6))
        # The answer got lost: asked again, nothing is computed anew.
        neighbour.insist(deflection, sample(0, 0.0), lambda: len(commands) >= 4)
        deflection.publish(sample(1, 1e-6))
        neighbour.wait(lambda: commands[-1].number == 1)
        deflection.publish(sample(3, 9e-6))  # sample 2 was answered by somebody else: no answer
        deflection.publish(sample(2, math.nan))  # no answer either
        deflection.publish(sample(2, 2.5e-6))
        neighbour.wait(lambda: commands[-1].number == 2)
        deflection.publish(sample(0, 0.0))  # a new run begins
        neighbour.wait(lambda: commands[-1].number == 0)
        neighbour.tell("feedback", reference, sample(0, -3e-6))
        last = sample(1, 1e-6)
        last.header.stamp.nanosec = 100_000
        deflection.publish(last)
        neighbour.wait(lambda: len(followed) == 3 and commands[-1].number == 1)
    commands.pop()
    repeats = len(commands) - 3
    assert [c.number for c in commands] == [0] * repeats + [1, 2, 0]
    assert [c.value for c in commands] == [expected[0]] * repeats + expected[1:] + expected[:1]
    # What it follows is said once for each run and at each change, with the stamp of the first such sample.
    assert [m.value.tolist() for m in followed] == [[10e-6], [10e-6], [-3e-6]]
    assert [m.header.stamp.nanosec for m in followed] == [0, 0, 100_000]
    log = (tmp_path / "feedback.log").read_text()
    assert "'deflection' brought sample 3, expected 2" in log
    assert "'deflection' sample 2 is nan, must be finite" in log


def test_a_feedback_that_is_started_again_keeps_reference_and_force(neighbour, tmp_path):
    states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
    states.publish(FingerState(phase=FingerState.WAITING, reference=7e-6, max_force=2e-4))
    with node("feedback", tmp_path, controller="none"):
        commands = neighbour.listen(Sample, "command")
        followed = neighbour.listen(Profile, "reference_followed_profile", FOLLOWED)
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        neighbour.wait(lambda: states.get_subscription_count() > 0)
        assert states.wait_for_all_acked()
        neighbour.insist(deflection, sample(0, 0.0), lambda: commands)
        neighbour.tell("feedback", reference, sample(0, -2e-6))  # from now on somebody says it
        deflection.publish(sample(1, 0.0))
        neighbour.wait(lambda: commands[-1].number == 1)
        neighbour.wait(lambda: len(followed) > 1)
    assert commands[0].value == 7e-6 and commands[-1].value == -2e-6
    assert [f.max_force for f in followed] == [2e-4, 0.0]  # N: a set-point says none


def test_the_finger_tells_what_is_followed_and_with_which_force(neighbour, tmp_path):
    followed = neighbour.node.create_publisher(Profile, "reference_followed_profile", FOLLOWED)
    with node("cantilever", tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        neighbour.wait(lambda: states)
        assert math.isnan(states[0].reference)
        followed.publish(Profile(time=[0.0], value=[7e-6], max_force=2e-4))
        neighbour.wait(lambda: states[-1].reference == 7e-6)
        assert states[-1].max_force == 2e-4


def test_force_control_waits_for_what_is_expected_and_answers_with_its_law(neighbour, tmp_path):
    """An object at 1 µm: the tip stays there, and the models say where it would be."""
    limit, away, elastic_constant = 2e-4, 1e-6, 1e-3
    law = Touch(TouchParameters(), elastic_constant, 1e-4, -22e-6, 22e-6)
    rows = [(n, min(0.2e-6 * n, away), 0.2e-6 * n) for n in range(1, 10)]  # number, m, m
    commands = [law.step(10e-6, *row[1:], limit) for row in [(0, 0.0, 0.0), *rows]]
    with node("feedback", tmp_path, force_control=True):
        answers = neighbour.listen(Sample, "command")
        pushes = neighbour.listen(Sample, "push")
        followed = neighbour.listen(Profile, "reference_followed_profile", FOLLOWED)
        profile = neighbour.node.create_publisher(Profile, "reference_profile", LATCHED)
        profile.publish(Profile(time=[0.0], value=[10e-6], max_force=limit))
        neighbour.wait(lambda: profile.get_subscription_count() > 0)
        assert profile.wait_for_all_acked()
        expected = neighbour.publisher("expected", LATCHED)
        deflection = neighbour.publisher("deflection")
        said = neighbour.listen(DiagnosticArray, "/diagnostics", 10)
        neighbour.insist(
            deflection,
            sample(0, 0.0),
            lambda: any("waits for '/dynamics'" in s.status[0].message for s in said),
        )
        assert not answers
        told = neighbour.node.create_publisher(Dynamics, "dynamics", LATCHED)
        tip = DynamicsParameters(elastic_constant=elastic_constant)
        told.publish(Dynamics(denominator=tip.denominator, elastic_constant=elastic_constant))
        neighbour.wait(lambda: answers)
        for number, value, unhindered in rows:
            if number == 1:  # asked again once that is known: it is not forgotten
                expected.publish(sample(number, unhindered))
                assert expected.wait_for_all_acked()
                deflection.publish(sample(0, 0.0))
            deflection.publish(sample(number, value))
            if number == 2:
                neighbour.wait(
                    lambda: any("waits for '/expected'" in s.status[0].message for s in said)
                )
            if number > 1:
                expected.publish(sample(number, unhindered))
            neighbour.wait(lambda n=number: answers[-1].number == n)
        neighbour.wait(lambda: pushes)
        neighbour.wait(lambda: followed)
        assert followed[-1].max_force == limit  # the bag says how hard it was to push
    first = [a.number for a in answers].count(0)
    assert [a.value for a in answers[first - 1 :]] == commands
    assert all(a.by_controller for a in answers)
    assert (pushes[0].number, pushes[0].value) == (0, 0.0)


@pytest.mark.shows("a feedback that is deactivated and activated again while the finger waits")
def test_a_feedback_that_is_activated_again_goes_on_holding(neighbour, tmp_path):
    """Between two samples of lock-step, for which time stands still: not a bit of the commands changes."""
    limit, away, elastic_constant = 2e-4, 1e-6, 1e-3
    law = Touch(TouchParameters(), elastic_constant, 1e-4, -22e-6, 22e-6)
    rows = [(n, min(0.2e-6 * n, away), 0.2e-6 * n) for n in range(40)]  # number, m, m
    commands = [law.step(10e-6, *row[1:], limit) for row in rows]
    states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
    states.publish(FingerState(phase=FingerState.RUNNING, reference=10e-6))
    told = neighbour.node.create_publisher(Dynamics, "dynamics", LATCHED)
    tip = DynamicsParameters(elastic_constant=elastic_constant)
    told.publish(Dynamics(denominator=tip.denominator, elastic_constant=elastic_constant))
    profile = neighbour.node.create_publisher(Profile, "reference_profile", LATCHED)
    profile.publish(Profile(time=[0.0], value=[10e-6], max_force=limit))
    with node("feedback", tmp_path, force_control=True):
        answers = neighbour.listen(Sample, "command")
        expected = neighbour.publisher("expected", LATCHED)
        deflection = neighbour.publisher("deflection")
        for latched in (states, told, profile):
            neighbour.wait(latched.get_subscription_count)
            assert latched.wait_for_all_acked()
        for number, value, unhindered in rows:
            if number == 20:
                assert neighbour.change_state("feedback", Transition.TRANSITION_DEACTIVATE)
                assert neighbour.change_state("feedback", Transition.TRANSITION_ACTIVATE)
            expected.publish(sample(number, unhindered))
            neighbour.insist(
                deflection,
                sample(number, value),
                lambda n=number: answers and answers[-1].number == n,
            )
    found = {a.number: a.value for a in answers}
    assert [found[number] for number, *_ in rows] == commands


@pytest.mark.parametrize("feels", [True, False])
def test_a_feedback_does_not_wind_up_against_a_finger_at_rest(neighbour, feels):
    """Every command to a finger that a fault keeps at rest is the first of a law that begins there.

    Activated again while the finger runs, it goes on from its last command.
    """
    node = FeedbackNode()
    values = {"mode": "free_running", "age_limit": 10.0, "force_control": feels}
    if not feels:  # an integrator
        values |= {
            "controller": "state_space",
            "name": "integral",
            "a": [1.0],
            "b": [1.0],
            "c": [0.02],
        }
        values |= {"anti_windup": [1.0]}
    changes = [Parameter(name, value=value) for name, value in values.items()]
    result = node.set_parameters_atomically(changes)
    assert result.successful, result.reason
    neighbour.executor.add_node(node)
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    node.armed = True  # how fast samples come is not the matter here
    told = neighbour.node.create_publisher(Dynamics, "dynamics", LATCHED)
    tip = DynamicsParameters(elastic_constant=1e-3)
    told.publish(Dynamics(denominator=tip.denominator, elastic_constant=tip.elastic_constant))
    states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
    deflection = neighbour.publisher("deflection")
    reference = neighbour.publisher("reference", SETPOINT)
    reference.publish(sample(0, 10e-6))
    if feels:
        neighbour.publisher("expected", LATCHED).publish(sample(1, 0.0))
        neighbour.wait(lambda: node.touch and node.expected.number == 1)
    neighbour.wait(lambda: node.reference.is_known)
    answers = neighbour.listen(Sample, "command")
    neighbour.wait(lambda: neighbour.node.count_subscribers("command"))
    for number in range(1, 16):
        if number == 13:
            assert node.trigger_deactivate() == node.trigger_activate()
            node.armed = True
        phase = FingerState.FAULT if number <= 10 else FingerState.RUNNING
        states.publish(FingerState(phase=phase, reference=10e-6))
        neighbour.wait(lambda p=phase: node.finger and node.finger.phase == p)
        neighbour.insist(
            deflection, sample(number, 0.0), lambda n=number: answers and answers[-1].number == n
        )
    node.trigger_shutdown()
    neighbour.executor.remove_node(node)
    node.destroy_node()
    commands = [a.value for a in sorted(answers, key=lambda a: a.number)]
    assert len(set(commands[:10])) == 1
    assert sorted(commands[9:]) == commands[9:] and commands[-1] > commands[9]


def test_a_finger_that_would_swing_itself_up_is_not_answered(neighbour, tmp_path):
    """100 Hz, by the file of its feedforward: a spectral radius above 1."""
    with node("feedback", tmp_path, force_control=True):
        faults = neighbour.listen(Fault, "fault", FAULTS)
        told = neighbour.node.create_publisher(Dynamics, "dynamics", LATCHED)
        told.publish(Dynamics(denominator=[2.5e-6, 5.4e-5, 1.0], elastic_constant=1e-3))
        neighbour.wait(lambda: any("force control swings up on a finger" in f.text for f in faults))


def test_a_certificate_that_leaves_out_the_temperature_asks_who_undoes_it(neighbour, tmp_path):
    def said():
        of_feedback = [s for message in heard for s in message.status if s.name == "/feedback"]
        return [v.value for s in of_feedback for v in s.values if v.key == "not covered"]

    with (
        node("feedback", tmp_path, "feedback_following.yaml"),
        node("feedforward", tmp_path, temperature_lockstep=True),
    ):
        heard = neighbour.listen(DiagnosticArray, "/diagnostics", 10)
        neighbour.wait(lambda: said() and said()[-1])
        assert "'compensator: sensorless' of 'feedforward' does" in said()[-1]
        assert (tmp_path / "feedback.log").read_text().count(said()[-1]) == 1
        assert neighbour.change_state("feedforward", Transition.TRANSITION_DEACTIVATE)
        assert neighbour.set("feedforward", compensator="sensorless").successful
        assert neighbour.change_state("feedforward", Transition.TRANSITION_ACTIVATE)
        neighbour.wait(lambda: said()[-1] == "")


def test_feedback_hands_over_to_another_controller_without_a_bump(neighbour, tmp_path):
    with node("feedback", tmp_path, "feedback_paper.yaml"):
        commands = neighbour.listen(Sample, "command")
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        neighbour.tell("feedback", reference, sample(0, 10e-6))
        neighbour.insist(deflection, sample(0, 9e-6), lambda: commands)
        for number in range(1, 50):
            neighbour.ask_sample(deflection, sample(number, 9e-6), commands)
        before = commands[-1].value
        gain = neighbour.get("feedback", "command_high") * 0.5
        assert neighbour.set("feedback", command_high=gain).successful
        deflection.publish(sample(50, 9e-6))
        neighbour.wait(lambda: commands[-1].number == 50)
    # The error is constant, so a controller that continues moves by what one sample integrates.
    step = abs(commands[-2].value - commands[-3].value)
    assert abs(commands[-1].value - before) <= 2 * step + 1e-12


@pytest.mark.shows("no answer to a sample for `reply_timeout`")
def test_cantilever_asks_again_ignores_duplicates_and_stops_at_0_v(neighbour, tmp_path):
    with node("cantilever", tmp_path, reply_timeout=0.5):
        deflections = neighbour.listen(Sample, "deflection")
        states = neighbour.listen(FingerState, "state", LATCHED)
        neighbour.node.create_publisher(Sample, "command", SAMPLE)
        voltage = neighbour.publisher("voltage")
        neighbour.wait(lambda: len(deflections) >= 2)  # sample 0 is repeated until it is answered
        assert {d.number for d in deflections} == {0}
        neighbour.insist(voltage, sample(0, 10.0), lambda: deflections[-1].number == 1)
        voltage.publish(sample(0, 40.0))  # late and wrong: sample 0 is over
        voltage.publish(sample(7, 40.0))  # not asked for
        neighbour.wait(lambda: sum(d.number == 1 for d in deflections) >= 2)
        voltage.publish(sample(1, 10.0))
        neighbour.wait(lambda: deflections[-1].number == 2)
        neighbour.wait(lambda: states[-1].phase == FingerState.FAULT)
    repeated = [d.value for d in deflections if d.number == 1]
    assert len(set(repeated)) == 1
    state = states[-1]
    assert (state.samples, state.voltage) == (2, 0.0)
    assert state.deflection != deflections[-1].value  # it tells where the way to rest has led
    assert state.asked_again >= 2
    assert re.match(r"no answer to sample 2 .*'/command' or '/voltage'", state.text)


def test_a_cantilever_that_stood_still_hears_its_answer_first(neighbour, tmp_path):
    with node("cantilever", tmp_path) as processes:
        deflections = neighbour.listen(Sample, "deflection")
        states = neighbour.listen(FingerState, "state", LATCHED)
        voltage = neighbour.publisher("voltage")
        neighbour.wait(lambda: deflections)
        neighbour.insist(voltage, sample(0, 0.0), lambda: deflections[-1].number == 1)
        asked = len(deflections)
        neighbour.wait(
            lambda: len(deflections) > asked + 1
        )  # sample 1 once more: it is late already
        process = processes.running["cantilever"]
        process.send_signal(signal.SIGSTOP)
        before = time.monotonic()
        neighbour.wait(lambda: time.monotonic() - before > 3.0)  # `reply_timeout` is 2 s
        process.send_signal(signal.SIGCONT)
        neighbour.insist(voltage, sample(1, 0.0), lambda: deflections[-1].number == 2)
        assert all(s.phase != FingerState.FAULT for s in states)


@pytest.mark.shows("SIGKILL of a node")
def test_cantilever_names_the_missing_node(neighbour, tmp_path):
    with node("cantilever", tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        neighbour.wait(lambda: states and "node 'feedback' is gone" in states[-1].text)
        neighbour.node.create_publisher(Sample, "command", SAMPLE)
        neighbour.wait(lambda: "node 'feedforward' is gone" in states[-1].text)


@pytest.mark.shows("a value that is not finite or that no finger reaches")
def test_cantilever_refuses_a_voltage_that_is_no_number(neighbour, tmp_path):
    with node("cantilever", tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        deflections = neighbour.listen(Sample, "deflection")
        voltage = neighbour.publisher("voltage")
        neighbour.wait(lambda: deflections)
        neighbour.insist(voltage, sample(0, 20.0), lambda: deflections[-1].number == 1)
        voltage.publish(sample(1, math.nan))
        neighbour.wait(lambda: states[-1].phase == FingerState.FAULT)
    assert "'voltage' sample 1 is nan V" in states[-1].text
    assert states[-1].voltage == 0.0


def test_feedforward_answers_with_the_law(neighbour, tmp_path):
    law = Feedforward(FeedforwardParameters(), sample_time=1e-4)
    commands = [0.0, 3e-6, 12e-6, 5e-6, 30e-6]
    with node("feedforward", tmp_path):
        voltages = neighbour.listen(Sample, "voltage")
        command = neighbour.publisher("command")
        neighbour.insist(command, sample(0, commands[0]), lambda: voltages)
        for number, value in enumerate(commands[1:], 1):
            neighbour.ask_sample(command, sample(number, value), voltages)
    got = [v for v in voltages if v.number > 0]
    assert [v.number for v in got] == [1, 2, 3, 4]
    assert [voltages[0].value, *(v.value for v in got)] == [law.step(value) for value in commands]


@pytest.mark.shows(
    "it stays away for `hold_time`", "deactivation, shutdown, SIGINT, SIGTERM, SIGHUP, SIGQUIT"
)
@pytest.mark.parametrize("end", ["silence", "deactivation", "SIGTERM", "SIGINT"])
def test_feedforward_running_free_ramps_to_0_v(neighbour, tmp_path, end):
    slew = 1e3  # V/s, so 20 V take 20 ms
    parameters = {"mode": "free_running", "ramp": slew, "hold_time": 1.0}
    with node("feedforward", tmp_path, **parameters) as processes:
        voltages = neighbour.listen(Sample, "voltage")
        command = neighbour.publisher("command")
        numbers = itertools.count()
        timer = neighbour.node.create_timer(
            0.01, lambda: command.publish(sample(next(numbers), 8e-6))
        )
        neighbour.wait(lambda: voltages and voltages[-1].value > 10.0)
        neighbour.node.destroy_timer(timer)
        if end == "deactivation":
            assert neighbour.change_state("feedforward", Transition.TRANSITION_DEACTIVATE)
        elif end != "silence":
            processes.running["feedforward"].send_signal(signal.Signals[end])
        neighbour.wait(lambda: voltages[-1].value == 0.0)
    steps = [b.value - a.value for a, b in zip(voltages, voltages[1:])]
    assert all(
        abs(step) <= 4.0 * (1 + 1e-9) for step in steps
    )  # the slew limit, 4e4 V/s, per 0.1 ms
    fall = [-step for step in steps if step < 0]
    assert all(step <= slew * 1e-3 * (1 + 1e-9) for step in fall)
    values = [v.value for v in voltages]
    after_the_top = values[values.index(max(values)) :]
    assert after_the_top == sorted(after_the_top, reverse=True)


@pytest.mark.shows("an input is late", "it stays away for `hold_time`")
def test_cantilever_running_free_holds_then_ramps_to_0_v(neighbour, tmp_path):
    parameters = {"mode": "free_running", "sample_time": 0.005, "ramp": 1e3, "hold_time": 1.0}
    with node("cantilever", tmp_path, **parameters):
        states = neighbour.listen(FingerState, "state", LATCHED)
        deflections = neighbour.listen(Sample, "deflection")
        voltage = neighbour.publisher("voltage")
        keep_alive = neighbour.node.create_timer(0.02, lambda: voltage.publish(sample(0, 20.0)))
        neighbour.wait(lambda: any(s.voltage == 20.0 for s in states))
        keep_alive.cancel()
        neighbour.wait(lambda: states[-1].voltage == 0.0 and states[-1].samples > 50)
    stamps = [d.header.stamp.sec + d.header.stamp.nanosec * 1e-9 for d in deflections]
    assert stamps == sorted(stamps)
    assert 0.0 < states[-1].jitter  # how much is the machine's affair; `make bench` measures it


def test_a_cantilever_that_runs_free_measures_no_sample_twice(neighbour):
    """Its timer comes twice within a sample time where it was late before."""
    node = CantileverNode()
    node.set_parameters([Parameter("mode", value="free_running")])
    heard = neighbour.listen(Sample, "deflection")
    neighbour.wait(lambda: node.deflections.readers())
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    while node.number < 100:
        node._tick()
    neighbour.wait(lambda: heard and heard[-1].number == node.number)
    node.trigger_shutdown()
    node.destroy_node()
    assert np.all(np.diff([sample.number for sample in heard]) > 0)


def test_parameters_are_described_and_refused_with_their_range(neighbour, tmp_path):
    with node("cantilever", tmp_path, autostart=False):
        request = DescribeParameters.Request(names=["sensor.resolution"])
        (described,) = neighbour.ask(
            DescribeParameters, "cantilever/describe_parameters", request
        ).descriptors
        assert "[m]" in described.description
        before = neighbour.get("cantilever", "hysteresis.weights")
        answer = neighbour.set("cantilever", samples=7, **{"hysteresis.weights": [1e-7, -2e-7]})
        assert not answer.successful
        assert "weights" in answer.reason
        answer = neighbour.set("cantilever", plant="cardboard")
        assert not answer.successful
        assert "'cardboard', must be one of ['prandtl_ishlinskii', 'truth']" in answer.reason
        answer = neighbour.set("cantilever", reply_timeout=1e9)
        assert not answer.successful
        assert re.search(r"3600", answer.reason) and "1000000000" in answer.reason
        assert neighbour.get("cantilever", "hysteresis.weights") == before
        assert neighbour.get("cantilever", "samples") == 0  # the valid half was not applied either


def test_active_cantilever_refuses_what_needs_a_new_run(neighbour, tmp_path):
    with node("cantilever", tmp_path):
        neighbour.publisher("voltage")
        answer = neighbour.set("cantilever", samples=7)
        assert (answer.successful, answer.reason) == (
            False, "samples: deactivate 'cantilever' first",
        )  # fmt: skip
        assert neighbour.change_state("cantilever", Transition.TRANSITION_DEACTIVATE)
        assert neighbour.set("cantilever", samples=7).successful


def test_bad_start_parameter_ends_with_one_line(tmp_path):
    result = subprocess.run(
        [EXECUTABLES / "feedforward", "--ros-args", "-p", "voltage_high:=-3000.0"],
        capture_output=True, text=True, timeout=TIMEOUT,
    )  # fmt: skip
    assert result.returncode == 2
    assert "voltage_high" in result.stderr and "-3000.0" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_empty_list_is_refused_in_words():
    result = subprocess.run(
        [EXECUTABLES / "cantilever", "--ros-args", "-p", "hysteresis.weights:=[]"],
        capture_output=True, text=True, timeout=TIMEOUT,
    )  # fmt: skip
    assert result.returncode == 2
    assert result.stderr.startswith("cantilever: hysteresis.'weights' has 0 values, must have as")


def test_a_recorder_says_what_it_cannot_record(neighbour, capfd, monkeypatch):
    recorder = RecorderNode()
    neighbour.node.create_publisher(Sample, "voltage", SAMPLE)
    neighbour.wait(lambda: recorder.count_publishers("voltage"))
    for topics, words in (
        (["de flection"], "'topics' has 'de flection', which is no name of a topic"),
        (["voltage", "/voltage"], "'topics' has /voltage more than once"),
    ):
        recorder.set_parameters([Parameter("topics", value=topics)])
        assert recorder.trigger_configure() == TransitionCallbackReturn.FAILURE
        assert f"not configured: {words}" in capfd.readouterr().err
    recorder.set_parameters([Parameter("topics", value=["voltage"])])
    assert recorder.trigger_configure() == TransitionCallbackReturn.SUCCESS
    monkeypatch.setattr(recorder, "start", lambda: 1 / 0)  # what rclpy would pass over
    assert recorder.trigger_activate() == TransitionCallbackReturn.ERROR
    assert "transition failed: ZeroDivisionError: division by zero" in capfd.readouterr().err
    recorder.destroy_node()


@pytest.mark.parametrize(
    "name", ["cantilever", "temperature", "feedforward", "feedback", "recorder", "experiment"]
)
def test_help_says_what_the_node_does(name):
    result = subprocess.run(
        [EXECUTABLES / name, "--help"], capture_output=True, text=True, timeout=TIMEOUT
    )
    assert result.returncode == 0
    assert len(result.stdout) > 200


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_recorder_closes_its_bag_on_a_signal(neighbour, tmp_path, stop):
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as processes:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        deflection = neighbour.publisher("deflection")
        neighbour.insist(
            deflection, sample(0, 0.0), lambda: states and sum(states[-1].recorded) == 1
        )
        for number in (1, 1, 2, 5):  # one twice, two missing
            deflection.publish(sample(number, number * 1e-6))
        neighbour.wait(lambda: sum(states[-1].recorded) == 4)
        for number in (0, 1, 2):  # another run
            deflection.publish(sample(number, -1e-6))
        neighbour.wait(lambda: sum(states[-1].recorded) == 7)
        process = processes.running["recorder"]
        process.send_signal(stop)
        assert process.wait(TIMEOUT) == 0
    row = states[-1].topics.index("deflection")
    assert states[-1].duplicates[row] >= 1 and states[-1].missing[row] == 2
    with (bag / "bag.mcap").open("rb") as stream:
        messages = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert messages == ["/deflection"] * 7
    assert read(bag, run=0).number.tolist() == [0, 1, 2, 5]
    assert read(bag, run=1).deflection.tolist() == [-1e-6] * 3
    assert (bag / "metadata.yaml").exists()


def test_a_publisher_that_is_gone_before_a_busy_node_looks_around_is_told(neighbour, capfd):
    node, changes = neighbour.node, []
    SoleInput(node, "voltage", lambda _: None, SAMPLE, lambda: changes.append(1))
    node.create_publisher(Sample, "voltage", SAMPLE)
    neighbour.wait(lambda: changes)
    second = node.create_publisher(Sample, "voltage", SAMPLE)
    neighbour.wait_idle(lambda: second.get_subscription_count() > 0)
    node.destroy_publisher(second)
    neighbour.wait_idle(lambda: node.count_publishers("voltage") == 1)
    neighbour.wait(lambda: len(changes) > 1)
    assert (
        "publishers of '/voltage' came and went, it has now 1: /neighbour" in capfd.readouterr().err
    )


def test_series_are_recorded_as_the_samples_they_are_of(neighbour, tmp_path):
    """Every field of the messages that a subscriber of the single samples hears is in the bag."""
    bag = tmp_path / "bag"
    limits = {"command_low": -2e-6, "command_high": 2e-6}
    with (
        node("recorder", tmp_path, bag=bag) as recorder,
        node("feedback", tmp_path, "feedback_paper.yaml", subscribers=2, **limits),
    ):
        heard = neighbour.listen(Sample, "command")
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        reference.publish(sample(0, 10e-6))
        neighbour.insist(deflection, sample(0, 0.0), lambda: heard)
        for number in range(1, 250):
            deflection.publish(sample(number, 1e-8 * number))
        neighbour.wait(lambda: heard[-1].number == 249 and states)
        row = states[-1].topics.index("command")
        neighbour.wait(lambda: states[-1].recorded[row] == 250)
        assert states[-1].missing[row] == 0
        recorder.running["recorder"].terminate()
        assert recorder.running["recorder"].wait(TIMEOUT) == 0
    kept = open_bag(bag).topics["/command"]
    once = {command.number: serialize_message(command) for command in heard}
    assert kept.data == [once[number] for number in range(250)]
    assert any(command.limited for command in heard) and heard[0].by_controller


def test_stamps_that_no_bag_holds_end_no_recording(neighbour, tmp_path):
    """Of single messages, of series, and of offsets within a series; what comes after them is recorded."""
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as recorder:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        reference = neighbour.publisher("reference", SETPOINT)
        series = neighbour.node.create_publisher(SampleSeries, "voltage_series", SAMPLE)
        neighbour.wait(lambda: series.get_subscription_count() > 0 and states)
        wrong = sample(0, 1e-6)
        wrong.header.stamp.sec = -(2**31)
        reference.publish(wrong)
        for later in (-1, -(2**63), 2**63 - 1):
            series.publish(SampleSeries(number=1, later=[later], value=[1.0], flags=[0]))
        right = SampleSeries(number=1, later=[0, 100_000], value=[2.0, 3.0], flags=[0, 0])
        series.publish(right)
        row = states[-1].topics.index("voltage")
        neighbour.wait(lambda: states[-1].recorded[row] == 2)
        recorder.running["recorder"].terminate()
        assert recorder.running["recorder"].wait(TIMEOUT) == 0
    assert len(open_bag(bag).topics["/voltage"].data) == 2
    said = (tmp_path / "recorder.log").read_text()
    assert (
        "'reference' is stamped -2.14748e+09 s, must be in [0, 2.14748e+09) s; not recorded" in said
    )


def test_a_clock_that_leaps_ends_no_temperature(neighbour, tmp_path):
    """By the clock's own range, ahead or before 0; the grid goes on from wherever the clock is."""
    with node("temperature", tmp_path, subscribers=1) as processes:
        heard = neighbour.listen(Temperature, "temperature")
        clock = neighbour.node.create_publisher(Clock, "clock", SAMPLE)
        for seconds in (0, 2**31 - 1, 5):
            last = Clock()
            last.clock.sec = seconds
            neighbour.insist(
                clock, last, lambda s=seconds: heard and heard[-1].header.stamp.sec == s
            )
        last.clock.sec = -1
        clock.publish(last)
        log = tmp_path / "temperature.log"
        neighbour.wait(lambda: "'clock' is -1 s, must be at least 0 s" in log.read_text())
        processes.check()


def test_the_end_of_a_run_that_comes_after_the_next_began_belongs_to_it(neighbour, tmp_path):
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as recorder:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        publishers = {
            name: neighbour.node.create_publisher(SampleSeries, f"{name}_series", SAMPLE)
            for name in ("deflection", "command")
        }
        recorded = 0
        for name, first, value in (
            ("deflection", range(1), 1.0), ("command", range(1), 2.0),  # again until they are heard
            ("deflection", range(1, 10), 1.0), ("command", range(1, 6), 2.0),
            ("deflection", range(4), 3.0), ("command", range(6, 10), 2.0), ("command", range(4), 4.0),
        ):  # fmt: skip
            series = SampleSeries(number=first[0], period=1e-4, value=[value] * len(first))
            series.header.stamp.nanosec = first[0] * 100_000
            series.later = [i * 100_000 for i in range(len(first))]
            series.flags = [0] * len(first)
            recorded += len(first)
            is_there = lambda n=recorded: states and sum(states[-1].recorded) == n  # noqa: E731
            if first == range(1):
                neighbour.insist(publishers[name], series, is_there)
            else:
                publishers[name].publish(series)
                neighbour.wait(is_there)
        recorder.running["recorder"].terminate()
        assert recorder.running["recorder"].wait(TIMEOUT) == 0
    for run, count, values in ((0, 10, (1.0, 2.0)), (1, 4, (3.0, 4.0))):
        got = read(bag, run=run)
        assert got.number.tolist() == list(range(count))
        assert (got.deflection.tolist(), got.command.tolist()) == (
            [values[0]] * count, [values[1]] * count,
        )  # fmt: skip


def test_a_finger_that_runs_free_and_counts_anew_is_recorded_on(neighbour, tmp_path):
    """Activated again, it begins with the first sample whose time has passed, which is never sample 0."""
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as recorder:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        deflection, command = (neighbour.publisher(name) for name in ("deflection", "command"))
        begin, recorded = int(time.time()), 0
        for first, last in ((1, 50), (3, 20)):
            for publisher, offset in ((command, 2), (deflection, 0)):  # in either order
                for number in range(first + offset, last):
                    message = sample(number, 1e-6 * first)
                    message.header.stamp.sec = begin + first
                    message.header.stamp.nanosec = number * 1_000_000
                    if first == 1 and number == first + offset:
                        neighbour.insist(
                            publisher, message,
                            lambda n=recorded: states and sum(states[-1].recorded) > n,
                        )  # fmt: skip
                    else:
                        publisher.publish(message)
                    recorded += 1
                neighbour.wait(lambda n=recorded: sum(states[-1].recorded) == n)
        recorder.running["recorder"].terminate()
        assert recorder.running["recorder"].wait(TIMEOUT) == 0
    for run, first, last in ((0, 1, 50), (1, 3, 20)):
        got = read(bag, run=run)
        assert got.number.tolist() == list(range(first, last))
        assert np.isfinite(got.command).sum() == last - first - 2


def test_single_samples_that_overtake_their_series_lose_none_of_it(neighbour, tmp_path):
    """A foreign publisher of the topic lets the recorder hear single samples while a series is on its way."""
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as recorder:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        series = neighbour.node.create_publisher(SampleSeries, "deflection_series", SAMPLE)
        single, _ = (
            neighbour.node.create_publisher(Sample, "deflection", SAMPLE) for _ in range(2)
        )

        def sent(first, last):
            message = SampleSeries(number=first, period=1e-4, value=[1e-6] * (last - first))
            message.header.stamp.nanosec = first * 100_000
            message.later = [i * 100_000 for i in range(last - first)]
            message.flags = [0] * (last - first)
            return message

        neighbour.insist(series, sent(0, 1), lambda: states and sum(states[-1].recorded) == 1)
        later = sample(25, 1e-6)
        later.header.stamp.nanosec = 25 * 100_000
        neighbour.insist(single, later, lambda: sum(states[-1].recorded) == 2)
        series.publish(sent(1, 40))
        neighbour.wait(lambda: sum(states[-1].recorded) == 40)
        assert sum(states[-1].missing) == 0
        recorder.running["recorder"].terminate()
        assert recorder.running["recorder"].wait(TIMEOUT) == 0
    assert read(bag).number.tolist() == list(range(40))


def test_signals_that_come_while_a_node_ends_change_nothing(neighbour, tmp_path):
    """The end of Python itself included, which gives signals back their default."""
    with node("feedback", tmp_path) as processes:
        process = processes.running["feedback"]
        neighbour.get("feedback", "autostart")  # it spins, so signals are its own
        while process.poll() is None:
            process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                process.wait(1e-3)
        assert process.returncode == 0


def test_a_killed_recorder_loses_the_last_second_at_most(neighbour, tmp_path):
    bag = tmp_path / "bag"
    with node("recorder", tmp_path, bag=bag) as processes:
        states = neighbour.listen(RecorderState, "recorder_state", LATCHED)
        deflection = neighbour.publisher("deflection")
        numbers = itertools.count()
        neighbour.node.create_timer(0.01, lambda: deflection.publish(sample(next(numbers), 1e-6)))
        neighbour.wait(lambda: states and sum(states[-1].recorded) > 20)
        sent, begin = sum(states[-1].recorded), time.monotonic()
        neighbour.wait(lambda: time.monotonic() - begin > 1.0)
        processes.running["recorder"].kill()
    left = open_bag(bag)
    assert "did not finish" in left.damage
    assert len(left.topics["/deflection"].data) >= sent


def test_a_full_disk_is_named_and_what_was_written_stays(neighbour, tmp_path):
    """The limit of a file's size stands for the end of the disk: the same error at the same call."""
    bag = tmp_path / "bag"
    process = subprocess.Popen(
        [EXECUTABLES / "recorder", "--ros-args", "-p", f"bag:={bag}"],
        stderr=subprocess.PIPE, text=True,
        # What measures coverage writes files of its own, and has no disk for them either.
        env={name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )  # fmt: skip
    try:
        words = neighbour.listen(DiagnosticArray, "/diagnostics", 10)
        deflection = neighbour.publisher("deflection")
        numbers = itertools.count()
        neighbour.node.create_timer(0.002, lambda: deflection.publish(sample(next(numbers), 1e-6)))
        neighbour.wait(
            lambda: any("recording ended" in s.message for m in words for s in m.status), 60.0
        )
        assert process.poll() is None  # it goes on answering
    finally:
        process.terminate()
        _, log = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0
    assert "File too large" in log and "experiment recover" in log and "Traceback" not in log
    assert len(open_bag(bag).topics["/deflection"].data) > 0


def test_recorder_refuses_an_existing_folder(neighbour, tmp_path):
    with node("recorder", tmp_path, bag=tmp_path, autostart=False):
        assert neighbour.change_state("recorder", Transition.TRANSITION_CONFIGURE)
        assert not neighbour.change_state("recorder", Transition.TRANSITION_ACTIVATE)
    assert "exists; name a new folder" in (tmp_path / "recorder.log").read_text()


def test_a_temperature_log_that_cannot_be_replayed_is_refused_and_ends_nothing(neighbour, tmp_path):
    """At activation by file, column and row; one that breaks under way deactivates the node."""
    log = tmp_path / "log.csv"
    log.write_text("time,temperature\n0,22\n1,warm\n")
    replay = ("profile:=replay", f"file:={log}", "mode:=free_running", "period:=0.01")
    arguments = ["--ros-args", *(word for value in replay for word in ("-p", value))]
    with NodeProcesses({"temperature": arguments}, tmp_path) as processes:
        heard = neighbour.listen(Temperature, "temperature")
        assert not neighbour.change_state("temperature", Transition.TRANSITION_ACTIVATE)
        said = (tmp_path / "temperature.log").read_text()
        assert "not activated: " in said
        assert "log.csv: column 'temperature', row 3 is 'warm', must be a finite number" in said
        log.write_text("\ufefftime;temperature\n0,0;22,5\n\n# later\n1,0;22,5\n")
        assert neighbour.change_state("temperature", Transition.TRANSITION_ACTIVATE)
        neighbour.wait(lambda: heard)
        assert heard[0].temperature == 22.5
        log.unlink()
        neighbour.wait(lambda: "deactivates: " in (tmp_path / "temperature.log").read_text())
        assert not neighbour.change_state("temperature", Transition.TRANSITION_ACTIVATE)
        processes.check()


FIRST_LINE = """
import inspect
import rclpy
import piezo_sim.nodes.cantilever
from piezo_control.nodes import spin
spin.init([])
known = len(inspect.modulesbyfile)
rclpy.create_node("finger").get_logger().info("running")
print(known, len(inspect.modulesbyfile))
"""


def test_the_first_line_of_a_log_looks_through_no_modules():
    """That takes 0.1 s, so a cantilever that ran free stood still for its hold time as it said "running"."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_LINE], capture_output=True, text=True, timeout=TIMEOUT, check=True
    )  # fmt: skip
    before, after = map(int, done.stdout.split())
    assert 500 < before and after < before + 50
