# SPDX-License-Identifier: Apache-2.0
"""What can go wrong around a node, on live nodes: the voltage goes to rest, the cause is named, nothing dies."""

import itertools
import math
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from fault_bench import Network, may_make_networks
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from test_nodes import TIMEOUT, Neighbour, neighbour, node, sample
from trajectory_msgs.msg import JointTrajectory

from piezo_control.feedback import read_controller
from piezo_control.gripper import Goal, hold
from piezo_control.nodes import base
from piezo_control.nodes.faces.asker import Asker
from piezo_control.nodes.feedback import FeedbackNode
from piezo_control.nodes.feedforward import FeedforwardNode
from piezo_control.nodes.gripper import GripperNode
from piezo_control.nodes.network import Networks
from piezo_control.nodes.qos import FAULTS, LATCHED, SAMPLE, SETPOINT
from piezo_control.parameters import flatten
from piezo_control.start import Stop
from piezo_gripper_msgs.msg import Fault, FingerState, Sample
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes.processes import NodeDied, NodeProcesses

__all__ = ["neighbour"]  # a fixture of the module above
SLEW = 4e4 * 1e-4  # V: default slew limit times sample time


class Stream:
    """Samples of one topic at a steady pace, numbered, until stopped."""

    def __init__(self, neighbour: Neighbour, topic: str, value: float, period=0.005, **fields):
        self.publisher = neighbour.publisher(topic)
        self.value = value
        self.fields = fields
        self.numbers = itertools.count()
        self.timer = neighbour.node.create_timer(period, self.send)

    def send(self):
        message = sample(next(self.numbers), self.value)
        for name, value in self.fields.items():
            setattr(message, name, value)
        self.publisher.publish(message)


def reset(neighbour, name):
    return neighbour.ask(Trigger, f"{name}/reset", Trigger.Request())


def diagnosed(neighbour, name):
    """Return a function that gives the newest words of node `name` on /diagnostics."""
    heard = neighbour.listen(DiagnosticArray, "/diagnostics", 10)

    def words():
        found = [s for message in heard for s in message.status if s.name.endswith(name)]
        return found[-1].message if found else ""

    return words


@pytest.mark.parametrize("use_sim_time, rest", [(False, 0.0), (True, 8.0)])
def test_silence_ends_at_rest_and_stays_there_until_a_reset(
    neighbour, tmp_path, use_sim_time, rest
):
    parameters = {"hold_time": 1.0, "use_sim_time": use_sim_time, "rest_voltage": rest}
    with node("feedforward", tmp_path, mode="free_running", **parameters):
        voltages = neighbour.listen(Sample, "voltage")
        words = diagnosed(neighbour, "feedforward")
        stream = Stream(neighbour, "command", 18e-6)
        neighbour.wait(lambda: voltages and voltages[-1].value > 25.0)
        stream.timer.cancel()
        neighbour.wait(lambda: voltages[-1].value == rest)
        neighbour.wait(lambda: words() == "no command for 1 s")
        stream.timer.reset()  # the command is back, the voltage is not
        count = len(voltages)
        neighbour.wait(lambda: next(stream.numbers) and stream.timer.is_ready() or True)
        answer = reset(neighbour, "feedforward")
        assert answer.success and "no command for 1 s" in answer.message
        assert all(v.value == rest for v in voltages[count:])
        neighbour.wait(lambda: voltages[-1].value > 25.0)
    steps = [abs(b.value - a.value) for a, b in zip(voltages, voltages[1:])]
    assert max(steps) <= 10.0 * (
        1 + 1e-9
    )  # the ramp, 1e4 V/s, per ms; the slew limit is 4 V a sample


@pytest.mark.shows("deactivation, shutdown, SIGINT, SIGTERM, SIGHUP, SIGQUIT")
@pytest.mark.parametrize("end", ["deactivation", "SIGTERM", "SIGHUP", "SIGQUIT"])
def test_a_lockstep_feedforward_ramps_too(neighbour, tmp_path, end):
    with node("feedforward", tmp_path, rest_voltage=-3.0) as processes:
        voltages = neighbour.listen(Sample, "voltage")
        command = neighbour.publisher("command")
        neighbour.insist(command, sample(0, 5e-6), lambda: voltages)
        for number in range(1, 10):
            neighbour.ask_sample(command, sample(number, 18e-6), voltages)
        assert voltages[-1].value > 30.0
        if end == "deactivation":
            assert neighbour.change_state("feedforward", Transition.TRANSITION_DEACTIVATE)
        else:
            process = processes.running["feedforward"]
            process.send_signal(signal.Signals[end])
            assert process.wait(TIMEOUT) == 0
        neighbour.wait(lambda: voltages[-1].value == -3.0)
    # A plant that waits for sample 9 still, because the answer was lost, must not take the way to rest for it: 10 V
    # in a millisecond are more than the slew limit in one sample.
    assert [v.number for v in voltages].count(9) == 1


def test_a_restarted_feedforward_goes_on_from_the_voltage_that_is_applied(neighbour, tmp_path):
    """It does not answer before it has heard what that is, where somebody can tell."""
    states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
    with node("feedforward", tmp_path, mode="free_running"):
        voltages = neighbour.listen(Sample, "voltage")
        Stream(neighbour, "command", 0.0)
        neighbour.wait(lambda: "waits for '/state'" in log(tmp_path, "feedforward"))
        assert not voltages
        states.publish(FingerState(phase=FingerState.RUNNING, samples=1000, voltage=36.9))
        neighbour.wait(lambda: voltages)
    assert abs(voltages[0].value - 36.9) <= SLEW * (1 + 1e-9)


def test_a_finger_that_leaves_its_fault_is_led_from_rest(neighbour, tmp_path):
    """Its feedforward, which has no fault, heard commands all the while."""
    with node("feedforward", tmp_path, mode="free_running", slew_limit=1e3, hold_time=60.0):
        voltages = neighbour.listen(Sample, "voltage")
        states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
        states.publish(FingerState(phase=FingerState.RUNNING))
        commands = Stream(neighbour, "command", 10e-6)
        neighbour.wait(lambda: voltages and voltages[-1].value > 10.0)
        states.publish(FingerState(phase=FingerState.FAULT, voltage=3.0))
        neighbour.wait(lambda: voltages[-1].value == 3.0)
        heard = next(commands.numbers)
        neighbour.wait(lambda: voltages[-1].number > heard + 20)
        assert voltages[-1].value == 3.0
        # A reset on the way to rest stopped it at 5 V, where it waits for the first voltage that it takes again.
        states.publish(FingerState(phase=FingerState.WAITING, voltage=5.0))
        neighbour.wait(lambda: voltages[-1].value == 5.0)
        count = len(voltages)
        states.publish(FingerState(phase=FingerState.RUNNING, voltage=5.0))
        neighbour.wait(lambda: voltages[-1].value > 10.0)
        assert np.abs(np.diff([v.value for v in voltages[count - 1 :]])).max() <= 0.1 + 1e-9


def test_a_feedforward_that_stood_still_does_not_go_on(neighbour, tmp_path):
    """Its commands never stayed away, but its finger has missed voltages for longer than `hold_time`."""
    with node("feedforward", tmp_path, mode="free_running", hold_time=2.0) as processes:
        voltages = neighbour.listen(Sample, "voltage")
        words = diagnosed(neighbour, "feedforward")
        Stream(neighbour, "command", 18e-6)
        neighbour.wait(lambda: voltages and voltages[-1].value > 25.0)
        process = processes.running["feedforward"]
        process.send_signal(signal.SIGSTOP)
        before = time.monotonic()
        neighbour.wait(lambda: time.monotonic() - before > 3.0)
        count = len(voltages)
        process.send_signal(signal.SIGCONT)
        neighbour.wait(lambda: voltages[-1].value == 0.0)
        neighbour.wait(lambda: words() == "no command for 2 s")
    assert np.diff([v.value for v in voltages[count - 1 :]]).max() <= 0.0


@pytest.mark.shows("a value that is not finite or that no finger reaches")
@pytest.mark.parametrize(
    ("name", "nonsense"), [("voltage", math.nan), ("voltage", 1e30), ("max_force", -1e-3)]
)
def test_a_state_with_nonsense_is_no_place_to_begin_at(neighbour, tmp_path, name, nonsense):
    with node("feedforward", tmp_path, mode="free_running", slew_limit=1e3):
        voltages = neighbour.listen(Sample, "voltage")
        states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
        states.publish(FingerState(phase=FingerState.RUNNING, **{name: nonsense}))
        Stream(neighbour, "command", 10e-6)
        neighbour.wait(
            lambda: f"'state' has a {name} of {nonsense} " in log(tmp_path, "feedforward")
        )
        states.publish(FingerState(phase=FingerState.RUNNING, voltage=5.0))
        neighbour.wait(lambda: voltages)
    assert voltages[0].value == pytest.approx(5.1)  # V: the slew limit of a sample further


@pytest.mark.shows("two publishers of an input")
def test_two_publishers_are_a_named_fault(neighbour, tmp_path):
    with node("feedforward", tmp_path, mode="free_running"):
        voltages = neighbour.listen(Sample, "voltage")
        words = diagnosed(neighbour, "feedforward")
        stream = Stream(neighbour, "command", 18e-6)
        neighbour.wait(lambda: voltages and voltages[-1].value > 25.0)
        second = neighbour.node.create_publisher(Sample, "command", SAMPLE)
        neighbour.wait(lambda: voltages[-1].value == 0.0)
        neighbour.wait(lambda: "'/command' has 2 publishers: " in words())
        assert not reset(neighbour, "feedforward").success  # they are both still there
        neighbour.node.destroy_publisher(second)
        neighbour.wait(lambda: reset(neighbour, "feedforward").success)
        neighbour.wait(lambda: voltages[-1].value > 25.0)
        assert stream


def test_nonsense_of_a_second_publisher_is_told_with_who_publishes(neighbour, tmp_path):
    """It may come before the match of its publisher is told; the first one is still silent."""
    with node("cantilever", tmp_path, reply_timeout=600.0):
        states = neighbour.listen(FingerState, "state", LATCHED)
        deflections = neighbour.listen(Sample, "deflection")
        first = neighbour.publisher("voltage")
        neighbour.wait(lambda: deflections and states)
        second = neighbour.node.create_publisher(Sample, "voltage", SAMPLE)
        neighbour.insist(second, sample(0, 1e6), lambda: states[-1].phase == FingerState.FAULT)
        assert "'/voltage' has 2 publishers: " in states[-1].text
        assert first


@pytest.mark.skipif(not may_make_networks(), reason="no rights to make networks")
def test_a_network_that_comes_up_after_a_node_is_named(monkeypatch):
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    networks = Networks()
    assert networks.missed() == ""
    with Network() as network:
        assert f"'{network.link}'" in networks.missed()
        assert Networks().missed() == ""
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        assert networks.missed() == ""
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    assert networks.missed() == ""


@pytest.mark.shows("a fault of a block")
def test_the_fault_of_a_block_is_one_of_the_finger_and_stays_until_both_are_reset(
    neighbour, tmp_path
):
    before = time.time()
    arguments = {
        "feedback": ["--ros-args"],
        "cantilever": ["--ros-args", "-p", "reply_timeout:=600.0"],
    }
    with NodeProcesses(arguments, tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        commands = neighbour.listen(Sample, "command")
        voltage = neighbour.publisher("voltage")
        neighbour.wait(lambda: commands)
        neighbour.insist(voltage, sample(0, 20.0), lambda: commands[-1].number == 1)
        second = neighbour.node.create_publisher(Sample, "deflection", SAMPLE)
        neighbour.wait(lambda: states[-1].phase == FingerState.FAULT)
        told = states[-1]
        assert told.text.startswith("feedback: '/deflection' has 2 publishers: ")
        assert told.voltage == 0.0 and told.times >= 1
        assert before - 1.0 <= told.since.sec + told.since.nanosec * 1e-9 <= time.time()
        answer = reset(neighbour, "cantilever")
        assert not answer.success and answer.message == told.text
        neighbour.node.destroy_publisher(second)
        neighbour.wait(lambda: reset(neighbour, "feedback").success)
        neighbour.wait(lambda: reset(neighbour, "cantilever").success)
        neighbour.wait(lambda: states[-1].phase == FingerState.WAITING)
        assert states[-1].since.sec == states[-1].times == 0


def test_the_fault_of_a_block_that_is_gone_or_never_was_can_be_reset(neighbour, tmp_path):
    with node("cantilever", tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        faults = neighbour.node.create_publisher(Fault, "fault", FAULTS)
        fault = Fault(node="nobody", text="saw\n\nnothing")
        neighbour.insist(faults, fault, lambda: states and states[-1].phase == FingerState.FAULT)
        assert states[-1].text == "nobody: saw nothing"
        assert reset(neighbour, "cantilever").success
        neighbour.wait(lambda: states[-1].phase == FingerState.WAITING)


@pytest.mark.shows("a publisher of an input that cannot be heard (quality of service)")
def test_a_publisher_that_cannot_be_heard_is_named(neighbour, tmp_path):
    """Best effort, as sensors often publish, where reliable is asked for: nothing would ever arrive."""
    with node("feedback", tmp_path):
        faults = neighbour.listen(Fault, "fault", FAULTS)
        unfit = neighbour.node.create_publisher(Sample, "deflection", qos_profile_sensor_data)
        neighbour.wait(lambda: faults and faults[-1].text)
        # Its name may not have been discovered yet.
        assert re.fullmatch(
            "'/deflection' is published by (/neighbour|a node just started) with another RELIABILITY than "
            "RELIABLE, which is asked for",
            faults[-1].text,
        )
        assert faults[-1].node == "feedback"
        neighbour.node.destroy_publisher(unfit)
        neighbour.wait(lambda: reset(neighbour, "feedback").success)
        neighbour.wait(lambda: faults[-1].text == "")


@pytest.mark.shows("an impossible lifecycle transition")
def test_an_impossible_transition_is_answered_with_no(neighbour, tmp_path):
    with node("feedback", tmp_path) as processes:
        assert not neighbour.change_state("feedback", Transition.TRANSITION_CONFIGURE)
        assert neighbour.change_state("feedback", Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert not neighbour.change_state("feedback", Transition.TRANSITION_ACTIVATE)
        process = processes.running["feedback"]
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(TIMEOUT) == 0
    assert "Traceback" not in (tmp_path / "feedback.log").read_text()


@pytest.mark.shows("samples at another sample time than the node's", "samples of the other mode")
@pytest.mark.parametrize(
    "fields, words",
    [
        (
            {"period": 1e-3},
            "comes every 0.001 s, must come at the sample time of 'feedback': 0.0001 s",
        ),
        ({"stamped": True}, "is sent in mode 'free_running', 'feedback' is in mode 'lockstep'"),
        # As of a finger that has been running free for a while.
        (
            {"stamped": True, "number": 1515},
            "is sent in mode 'free_running', 'feedback' is in mode 'lockstep'",
        ),
    ],
    ids=["sample time", "mode", "mode, long since"],
)
def test_samples_of_another_loop_are_refused_by_name(neighbour, tmp_path, fields, words):
    with node("feedback", tmp_path, "feedback_robust.yaml"):
        commands = neighbour.listen(Sample, "command")
        said = diagnosed(neighbour, "feedback")
        deflection = neighbour.publisher("deflection")
        first = sample(fields.get("number", 0), 0.0)
        first.period = fields.get("period", 0.0)
        if "stamped" in fields:
            first.header.stamp.sec = int(time.time())
        neighbour.insist(deflection, first, lambda: words in said())
    assert commands == []


@pytest.mark.shows("a sample older than `age_limit`")
def test_an_old_sample_is_not_acted_upon(neighbour, tmp_path):
    with node("feedforward", tmp_path, mode="free_running") as processes:
        voltages = neighbour.listen(Sample, "voltage")
        command = neighbour.publisher("command")
        old = sample(5, 18e-6)
        old.header.stamp.sec = int(time.time()) - 3
        neighbour.insist(
            command, old, lambda: "old, must be at most 0.05 s" in log(tmp_path, "feedforward")
        )
        assert processes.running["feedforward"].poll() is None
    assert [v for v in voltages if v.value] == []


def log(folder, name):
    return (folder / f"{name}.log").read_text()


@pytest.mark.shows("a stray sample number")
def test_a_stray_number_does_not_stop_the_count(neighbour, tmp_path):
    with node("feedback", tmp_path):
        commands = neighbour.listen(Sample, "command")
        deflection = neighbour.publisher("deflection")
        deflection.publish(sample(2**64 - 1, 0.0))
        neighbour.insist(deflection, sample(0, 0.0), lambda: commands)
        deflection.publish(sample(2**64 - 1, 0.0))
        deflection.publish(sample(1, 1e-6))
        neighbour.wait(lambda: commands[-1].number == 1)


@pytest.mark.shows("a value that is not finite or that no finger reaches")
@pytest.mark.parametrize("nonsense", [1.7e308, 20.0, math.inf, math.nan])
def test_a_reference_that_no_finger_reaches_is_refused(neighbour, tmp_path, nonsense):
    with node("feedback", tmp_path, "feedback_robust.yaml"):
        commands = neighbour.listen(Sample, "command")
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        reference.publish(sample(0, nonsense))
        neighbour.insist(
            deflection,
            sample(0, 0.0),
            lambda: commands and "'reference' ignored" in log(tmp_path, "feedback"),
        )
        neighbour.tell("feedback", reference, sample(0, 1e-6))
        for number in range(1, 40):
            neighbour.ask_sample(deflection, sample(number, 0.0), commands)
    assert all(math.isfinite(c.value) for c in commands)
    assert 0.0 < commands[-1].value < 22e-6


@pytest.mark.shows("half a controller, an unknown name, a value out of range")
def test_a_controller_changes_as_a_whole_or_not_at_all(neighbour, tmp_path):
    """One parameter after the other, as tools that load parameter files send them."""
    second = {
        "controller": "state_space", "name": "b", "certified": True, "sample_time": 1e-4,
        "a": [0.9, 0.0, 0.0, 0.8], "b": [0.1, 0.1], "c": [0.5, 0.5], "d": 0.9,
        "anti_windup": [0.1, 0.1],
    }  # fmt: skip
    with node("feedback", tmp_path, "feedback_paper.yaml"):
        before = neighbour.get("feedback", "a")
        request = SetParameters.Request(
            parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in second.items()]
        )
        results = neighbour.ask(SetParameters, "feedback/set_parameters", request).results
        assert any("changes as a whole" in r.reason for r in results)
        # All at once, they are a controller that nobody has certified.
        for value in (True, False):
            answer = neighbour.set("feedback", **{**second, "certified": value})
            assert answer.successful is not value
            assert value is False or "bring no certificate" in answer.reason
        assert neighbour.set("feedback", controller_file="paper").successful
        neighbour.wait(lambda: neighbour.get("feedback", "name") == "paper")
        assert neighbour.get("feedback", "name") == "paper"
        assert list(neighbour.get("feedback", "a")) == list(before)
        path = tmp_path / "b.yaml"
        path.write_text(yaml.safe_dump({"/**/feedback": {"ros__parameters": second}}))
        assert neighbour.set("feedback", controller_file=str(path)).successful
        neighbour.wait(lambda: neighbour.get("feedback", "name") == "b")
        assert list(neighbour.get("feedback", "a")) == second["a"]
        path.write_text("{")  # the same name again, and no controller any more
        answer = neighbour.set("feedback", controller_file=str(path))
        assert not answer.successful and "b.yaml" in answer.reason
        assert list(neighbour.get("feedback", "a")) == second["a"]
        answer = neighbour.set("feedback", controller_file="robsut")
        assert not answer.successful and "robust" in answer.reason
        assert neighbour.get("feedback", "name") == "b"


def test_what_is_given_beside_a_controllers_file_counts(neighbour, tmp_path):
    with node("feedback", tmp_path, controller_file="robust", command_high=5e-6):
        assert neighbour.get("feedback", "command_high") == 5e-6
        assert neighbour.get("feedback", "command_low") == -22e-6  # of the file
        answer = neighbour.set("feedback", controller_file="fast", command_high=3e-6)
        assert answer.successful
        assert neighbour.get("feedback", "name") == "fast"
        assert neighbour.get("feedback", "command_high") == 3e-6
        answer = neighbour.set("feedback", controller_file="robust", d=0.5)
        assert not answer.successful and answer.reason.startswith("d: part of a controller")
        assert neighbour.get("feedback", "controller_file") == "fast"
    ended = node("feedback", tmp_path, "feedback_paper.yaml", controller_file="robust")
    with pytest.raises(NodeDied), ended:
        neighbour.wait(lambda: ended.check())
    assert "not as in that of 'controller_file' (robust)" in log(tmp_path, "feedback")


@pytest.mark.parametrize("is_active", [True, False])
def test_the_controller_that_was_set_last_is_the_one_in_use(neighbour, is_active):
    own = flatten(read_controller("paper")) | {"name": "own", "certified": False}
    types = {name: base.parameter_type(FeedbackNode.PARAMETERS, name) for name in own}
    feedback = FeedbackNode()
    feedback.trigger_configure()
    if is_active:
        feedback.trigger_activate()
    for changes, name in (
        ([Parameter("controller_file", value="robust")], "robust"),
        ([Parameter(n, kind, own[n]) for n, kind in types.items()], "own"),
        ([Parameter("controller_file", value="robust")], "robust"),
    ):
        assert feedback.set_parameters_atomically(changes).successful
        assert feedback.get_parameter("name").value == name
        assert not is_active or feedback.law.parameters.name == name
    feedback.set_parameters_atomically([Parameter(n, kind, own[n]) for n, kind in types.items()])
    assert feedback.get_parameter("controller_file").value == ""
    if not is_active:
        feedback.trigger_activate()
    assert feedback.law.parameters.name == "own"
    feedback.destroy_node()


def test_a_recorder_takes_no_topics_that_it_would_not_record(neighbour, tmp_path):
    with node("recorder", tmp_path, bag=tmp_path / "bag", autostart=False):
        assert neighbour.set("recorder", topics=["voltage", "command"]).successful
        assert neighbour.change_state("recorder", Transition.TRANSITION_CONFIGURE)
        answer = neighbour.set("recorder", topics=["voltage"])
        assert not answer.successful and "clean it up first" in answer.reason
        assert neighbour.change_state("recorder", Transition.TRANSITION_CLEANUP)
        assert neighbour.set("recorder", topics=["voltage"]).successful


def test_a_changed_parameter_is_used_before_the_first_sample(neighbour, tmp_path):
    with node("feedback", tmp_path):
        commands = neighbour.listen(Sample, "command")
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        assert neighbour.set("feedback", command_high=5e-6).successful
        neighbour.tell("feedback", reference, sample(0, 10e-6))
        neighbour.insist(deflection, sample(0, 0.0), lambda: commands)
    assert commands[0].value == 5e-6


@pytest.mark.shows("a reset of what is not at fault")
def test_a_reset_of_a_feedback_that_runs_changes_nothing(neighbour, tmp_path):
    with node("feedback", tmp_path, "feedback_robust.yaml"):
        commands = neighbour.listen(Sample, "command")
        reference = neighbour.publisher("reference", SETPOINT)
        deflection = neighbour.publisher("deflection")
        neighbour.tell("feedback", reference, sample(0, 20e-6))
        neighbour.insist(deflection, sample(0, 0.0), lambda: commands)
        for number in range(1, 40):
            neighbour.ask_sample(deflection, sample(number, 1e-6), commands)
            if number == 20:
                assert reset(neighbour, "feedback").success
    steps = np.abs(np.diff([c.value for c in commands[1:]]))
    assert steps[18:22].max() <= 2.0 * steps[10:18].max()


@pytest.mark.shows("a count of samples that begins anew")
def test_a_loop_that_runs_free_follows_a_count_that_begins_anew(neighbour, tmp_path):
    """As of a driver that was started again: numbers from 1 on after thousands."""
    with node("feedback", tmp_path, mode="free_running"):
        commands = neighbour.listen(Sample, "command")
        stream = Stream(neighbour, "deflection", 1e-6)
        stream.numbers = itertools.count(5000)
        neighbour.wait(lambda: commands and commands[-1].number > 5000)
        stream.numbers = itertools.count(1)
        neighbour.wait(lambda: 1 < commands[-1].number < 1000)
    assert "counts anew" in log(tmp_path, "feedback")


def test_a_stray_number_ahead_leaves_the_voltage_where_it_is(neighbour, tmp_path):
    """The count then seems to begin anew; `state` is older than what was sent since."""
    states = neighbour.node.create_publisher(FingerState, "state", LATCHED)
    states.publish(FingerState(phase=FingerState.RUNNING))
    with node("feedforward", tmp_path, mode="free_running", hold_time=5.0):
        voltages = neighbour.listen(Sample, "voltage")
        stream = Stream(neighbour, "command", 18e-6)
        neighbour.wait(lambda: voltages and voltages[-1].value > 30.0)
        ahead = (
            10**6
        )  # again and again: a newer command takes its place before a busy feedforward has read it
        neighbour.insist(
            stream.publisher,
            sample(ahead, 18e-6),
            lambda: any(v.number == ahead for v in voltages),
            period=0.003,
        )
        neighbour.wait(lambda: "counts anew" in log(tmp_path, "feedforward"))
        count = len(voltages)
        neighbour.wait(lambda: len(voltages) > count + 5)
        stream.timer.cancel()
        steps = np.abs(np.diff([v.value for v in voltages]))
    assert steps.max() <= SLEW * (1 + 1e-9)


def test_an_uncertified_controller_is_said_loudly(neighbour, tmp_path):
    with node("feedback", tmp_path, "feedback_paper.yaml"):
        neighbour.publisher("deflection")
        neighbour.wait(lambda: "controller 'paper'" in log(tmp_path, "feedback"))
    assert "not certified" in log(tmp_path, "feedback")


@pytest.mark.shows("a loop that falls behind its sample time")
def test_a_loop_at_another_rate_than_the_controllers_is_not_driven(neighbour, tmp_path):
    parameters = {"mode": "free_running"}
    with node("feedback", tmp_path, "feedback_robust.yaml", **parameters):
        commands = neighbour.listen(Sample, "command")
        Stream(neighbour, "deflection", 0.0, period=0.005)
        neighbour.wait(
            lambda: "controller 'robust' was made for 0.1 ms" in log(tmp_path, "feedback")
        )
    assert commands == []


def test_a_free_cantilever_latches_and_moves_with_the_wall_clock(neighbour, tmp_path):
    parameters = {"mode": "free_running", "sample_time": 0.005, "hold_time": 1.0}
    with node("cantilever", tmp_path, **parameters) as processes:
        states = neighbour.listen(FingerState, "state", LATCHED)
        deflections = neighbour.listen(Sample, "deflection")
        stream = Stream(neighbour, "voltage", 20.0)
        neighbour.wait(lambda: any(s.voltage == 20.0 for s in states))
        process = processes.running["cantilever"]
        process.send_signal(signal.SIGSTOP)
        before = time.monotonic()
        neighbour.wait(lambda: time.monotonic() - before > 0.5)
        process.send_signal(signal.SIGCONT)
        count = len(deflections)
        neighbour.wait(lambda: len(deflections) > count + 20)
        stream.timer.cancel()
        neighbour.wait(lambda: states[-1].phase == FingerState.FAULT)
        assert states[-1].text == "no voltage for 1 s" and states[-1].voltage == 0.0
        stream.timer.reset()
        count = states[-1].samples
        neighbour.wait(lambda: states[-1].samples > count + 50)
        assert states[-1].phase == FingerState.FAULT and states[-1].voltage == 0.0
        assert reset(neighbour, "cantilever").success
        neighbour.wait(lambda: states[-1].voltage == 20.0 and states[-1].text == "")
    stamps = [d.header.stamp.sec + d.header.stamp.nanosec * 1e-9 for d in deflections]
    behind = [t - d.number * d.period for t, d in zip(stamps, deflections)]
    assert max(behind) - min(behind) < 0.3
    assert deflections[-1].number > len(deflections) + 50  # the halt is in the numbers


def test_a_reset_on_the_way_to_rest_ends_it(neighbour, tmp_path):
    parameters = {"mode": "free_running", "sample_time": 0.005, "ramp": 1.0}  # 20 s to rest
    with node("cantilever", tmp_path, **parameters):
        states = neighbour.listen(FingerState, "state", LATCHED)
        stream = Stream(neighbour, "voltage", 20.0)
        neighbour.wait(lambda: states and states[-1].voltage == 20.0)
        stream.timer.cancel()
        neighbour.wait(lambda: states[-1].phase == FingerState.RAMPING)
        answer = reset(neighbour, "cantilever")
        assert answer.success and "no voltage for 0.1 s" in answer.message
        neighbour.wait(lambda: states[-1].phase == FingerState.WAITING)
        stopped = states[-1].voltage
        assert 0.0 < stopped < 20.0
        stream.timer.reset()
        neighbour.wait(lambda: states[-1].phase == FingerState.RUNNING)
        neighbour.wait(lambda: states[-1].voltage == 20.0)


def test_a_free_cantilever_does_not_act_upon_an_old_voltage(neighbour, tmp_path):
    with node("cantilever", tmp_path, mode="free_running", sample_time=0.005):
        states = neighbour.listen(FingerState, "state", LATCHED)
        old = Stream(neighbour, "voltage", 30.0)
        old.fields = {"header": Header(stamp=base.wall_time(time.monotonic() - 2.0))}
        neighbour.wait(lambda: "s old, must be at most 0.05 s" in log(tmp_path, "cantilever"))
        old.fields = {}
        old.value = 10.0
        neighbour.wait(lambda: states and states[-1].voltage == 10.0)
    assert max(s.voltage for s in states) == 10.0


def test_a_wild_voltage_neither_moves_the_tip_nor_goes_unnoticed(neighbour, tmp_path):
    with node("cantilever", tmp_path):
        states = neighbour.listen(FingerState, "state", LATCHED)
        deflections = neighbour.listen(Sample, "deflection")
        voltage = neighbour.publisher("voltage")
        neighbour.wait(lambda: deflections)
        neighbour.insist(voltage, sample(0, 20.0), lambda: deflections[-1].number == 1)
        voltage.publish(sample(1, 1e6))
        neighbour.wait(lambda: states[-1].phase == FingerState.FAULT)
    assert "'voltage' sample 1 is 1000000.0 V" in states[-1].text
    assert states[-1].voltage == 0.0


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--params-file", "/nowhere/at/all.yaml"], "/nowhere/at/all.yaml"),
        (["-p", "voltage_high"], "voltage_high"),
        (["-p", "voltage_high:=1.0e308"], "voltage_high"),
        (["-p", "voltage_high:=[1.0, 2.0]"], "voltage_high"),
        (["-p", "voltage_high:=[1, 2]"], "voltage_high"),
        (["-p", "hysteresis.weights:=3"], "hysteresis.weights"),
        (["-p", "voltage_high:=text"], "voltage_high"),
        (
            ["-p", "voltage_hihg:=5.0"],
            "unknown parameter 'voltage_hihg'; did you mean 'voltage_high'?",
        ),
        (["-p", "weights:=[1.0e-7]"], "did you mean 'hysteresis.weights'?"),
        (["--params-file", "{robust}"], "nothing for node '/feedforward'; it has ['/**/feedback']"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_unusable_arguments_end_with_one_line(arguments, words, monkeypatch, capsys):
    robust = params_folder() / "feedback_robust.yaml"
    arguments = [argument.format(robust=robust) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["feedforward", "--ros-args", *arguments])
    monkeypatch.setattr(base, "stop_at_signals", Stop)  # pytest keeps its signals
    assert base.run(FeedforwardNode) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "given, words",
    [
        ("{voltage_high: 1.0e+30}", "voltage_high"),
        ("{voltage_high: text}", "voltage_high"),
        ("{voltage_low: 50.0}", "must be below 'voltage_high'"),
        ("{voltage_hihg: 5.0}", "did you mean 'voltage_high'?"),
    ],
)
def test_what_is_refused_of_a_file_names_the_file(given, words, tmp_path, monkeypatch, capsys):
    file = tmp_path / "mine.yaml"
    file.write_text(f"/**/feedforward:\n  ros__parameters: {given}\n")
    arguments = ["--ros-args", "--params-file", str(file), "-p", "slew_limit:=1.0e4"]
    monkeypatch.setattr(sys, "argv", ["feedforward", *arguments])
    monkeypatch.setattr(base, "stop_at_signals", Stop)
    assert base.run(FeedforwardNode) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert words in said and said.endswith(f"; parameters come from {file}, -p")


def test_whole_numbers_stand_for_doubles():
    given = ("voltage_high:=20", "hysteresis.weights:=[1]", "hysteresis.thresholds:=[0]")
    rclpy.init(args=["--ros-args", *(word for text in given for word in ("-p", text))])
    node = FeedforwardNode()
    assert node.parameters.voltage_high == 20.0
    assert node.parameters.hysteresis.weights == (1.0,)
    assert node.set_parameters([Parameter("voltage_low", value=-7)])[0].successful
    assert node.parameters.voltage_low == -7.0
    for name, value in (("voltage_low", [-8, -9]), ("hysteresis.weights", 3)):
        assert not node.set_parameters([Parameter(name, value=value)])[0].successful
    assert node.parameters.voltage_low == -7.0
    node.destroy_node()
    rclpy.shutdown()


def test_events_that_were_on_their_way_when_a_gripper_was_stopped_change_nothing():
    """They are called as the executor calls what it had queued before."""
    rclpy.init()
    node = GripperNode()
    node.trigger_configure()
    node.trigger_activate()
    states, commands, _ = node.faces
    finger = node.fingers[0]
    finger._take(FingerState(phase=FingerState.RUNNING))
    finger.follow(hold(1e-6))
    node.trigger_deactivate()
    finger._take(FingerState(phase=FingerState.IDLE))
    states._publish()
    commands._on_command(JointState(name=["gripper_joint"], position=[3e-5]))
    commands._on_trajectory(JointTrajectory(joint_names=["gripper_joint"]))
    node._watch()
    assert node.motion is None
    node.destroy_node()
    rclpy.shutdown()


def test_a_gripper_counts_silence_in_the_time_that_it_has_listened_for():
    """One that stood still looks again before it has heard what its fingers said meanwhile; `state_timeout` is 1 s."""
    rclpy.init()
    node = GripperNode()
    node.trigger_configure()
    node.trigger_activate()
    finger = node.fingers[0]
    finger._feel(sample(100, 1e-4))
    finger._take(FingerState(phase=FingerState.RUNNING, samples=60_000, period=1e-4))
    assert not finger.problem()  # the push of 6 s ago is the newest that was heard of so far
    for _ in range(10):
        node._watch()
    assert not finger.problem()
    node._watch()
    assert "finger 'left' is silent: nothing on '/left/state' for 1.1 s" in finger.problem()
    finger._take(FingerState(phase=FingerState.RUNNING, samples=61_000, period=1e-4))
    assert "finger 'left' feels no more: nothing on '/left/push' for 60900" in finger.problem()
    node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize("phase, place", [(FingerState.HOLDING, 7e-6), (FingerState.RAMPING, 0.0)])
def test_a_finger_that_bridges_a_late_sample_lets_nothing_go(phase, place):
    """Its reference stays; that of one on its way to rest becomes the place where it will be."""
    rclpy.init()
    node = GripperNode()
    node.trigger_configure()
    node.trigger_activate()
    finger = node.fingers[0]
    state = FingerState(phase=FingerState.RUNNING, samples=100, period=1e-4)
    state.deflection = state.reference = 7e-6
    finger._take(state)
    finger.follow(hold(7e-6))
    state.phase = phase
    finger._take(state)
    assert finger.place() == pytest.approx(place)
    node.destroy_node()
    rclpy.shutdown()


@pytest.mark.shows("a gripper whose `sample_time` is not its fingers'")
def test_a_gripper_with_another_sample_time_than_its_fingers_says_so_and_does_not_move():
    """Its ways are planned in the fingers' time: with another one they would be steps."""
    rclpy.init()
    node = GripperNode()
    node.trigger_configure()
    node.trigger_activate()
    for finger in node.fingers:
        finger._take(FingerState(phase=FingerState.RUNNING, period=1e-4))
    assert "takes a sample" not in node.fingers[0].problem()
    node.fingers[1]._take(FingerState(phase=FingerState.RUNNING, period=1e-3))
    expected = "finger 'right' takes a sample every 0.001 s, 'sample_time' of 'gripper' is 0.0001 s"
    assert node.fingers[1].problem() == expected
    node.destroy_node()
    rclpy.shutdown()


def test_a_gripper_that_is_started_again_opens_with_no_more_force_than_is_held():
    rclpy.init()
    node = GripperNode()
    node.trigger_configure()
    node.trigger_activate()
    for finger in node.fingers:
        finger._take(FingerState(phase=FingerState.RUNNING, period=1e-4, max_force=2e-4))
    node.move(Goal(60e-6, 1e-3, 20e-6), Asker())
    assert [finger.max_force for finger in node.fingers] == [2e-4, 2e-4]
    node.destroy_node()
    rclpy.shutdown()


def test_ctrl_c_during_the_imports_leaves_no_traceback(tmp_path):
    (tmp_path / "slow.py").write_text(
        "print('importing', flush=True)\nimport time\ntime.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", "from piezo_control.start import executable; executable('slow')()"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    _, words = process.communicate(timeout=TIMEOUT)
    assert (process.returncode, words) == (-signal.SIGINT, "")


@pytest.mark.parametrize(
    "hang",
    [
        "with over_within(0.2, 3): ctypes.PyDLL(None).sleep(100)",
        "atexit.register(ctypes.PyDLL(None).sleep, 100); atexit.register(end_within, 0.2, 3)",
    ],
)
def test_a_middleware_that_hangs_with_the_interpreters_lock_does_not_keep_a_program_from_its_end(
    tmp_path, hang
):
    (tmp_path / "program.py").write_text(
        "import atexit, ctypes, time\n"
        "from piezo_control.start import end_within, over_within\n"
        "with over_within(0.2, 7):\n"
        "    pass\n"
        "time.sleep(0.5)\n"
        "print('on', flush=True)\n"
        f"{hang}\n"
    )
    program = [sys.executable, tmp_path / "program.py"]
    result = subprocess.run(program, capture_output=True, text=True, timeout=TIMEOUT)
    assert (result.returncode, result.stdout, result.stderr) == (3, "on\n", "")


@pytest.mark.shows("a signal while another one is being handled")
def test_a_signal_between_any_two_steps_of_the_handler_of_another_is_heard(tmp_path):
    """Each line that runs while a signal is handled or waited for is interrupted by one more."""
    (tmp_path / "program.py").write_text(
        "import signal, sys\n"
        "from piezo_control.start import stop_at_signals\n"
        "stop = stop_at_signals()\n"
        "left = [20]\n"
        "def interrupt(frame, event, argument):\n"
        "    if event == 'line' and left[0]:\n"
        "        left[0] -= 1\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "    return interrupt\n"
        "sys.settrace(interrupt)\n"
        "while not stop.wait(0.05):\n    pass\n"
        "stop.set()\n"
        "print('at rest, interrupted', 20 - left[0])\n"
    )
    ended = subprocess.run(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout.removeprefix("at rest, interrupted ")) > 3


def test_a_timer_that_was_due_when_it_was_cancelled_or_destroyed_does_nothing(neighbour):
    """An executor of events serves it still when its event was on the way."""
    owner = FeedforwardNode()
    called = []
    timer = owner.create_steady_timer(10.0, lambda: called.append(True))
    timer.callback()
    timer.cancel()
    timer.callback()
    owner.destroy_timer(timer)
    timer.callback()
    owner.destroy_node()
    assert called == [True]
