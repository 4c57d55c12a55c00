# SPDX-License-Identifier: Apache-2.0
"""The client and `fingerctl` with a running finger and its recorder."""

import io
import math
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from ament_index_python.packages import get_package_prefix
from rich.console import Console

from piezo_control.nodes import fingerctl
from piezo_control.nodes.client import LEAD_TIME, ClientError, connect
from piezo_control.nodes.profile_input import waveform_message
from piezo_control.nodes.qos import FOLLOWED, LATCHED, SETPOINT
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import WAVEFORM_TYPE, read
from piezo_control.waveform import Waveform
from piezo_gripper_msgs.msg import FingerState, Profile, Sample
from piezo_gripper_msgs.msg import Waveform as WaveformMessage
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"
TIMEOUT = 180.0  # s, generous: the tests wait on conditions
RECORDED = "[reference_waveform, deflection]"
SAMPLE_TIME = 1e-4  # s, of the controller `robust`


@pytest.fixture(scope="module")
def ros(tmp_path_factory):
    folder = tmp_path_factory.mktemp("client")
    commands = {
        "finger": ["-p", "controller_file:=robust"],
        "recorder": ["-p", "autostart:=false", "-p", f"topics:={RECORDED}"],
    }
    processes = []
    for name, arguments in commands.items():
        with (folder / f"{name}.log").open("wb") as log:
            processes.append(
                subprocess.Popen(
                    [EXECUTABLES / name, "--ros-args", "-r", "__ns:=/finger", *arguments],
                    stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                )
            )  # fmt: skip
    try:
        with connect(TIMEOUT) as connection:
            finger = connection.finger("finger")
            finger.wait_for(lambda: finger.state and finger.state.phase == FingerState.RUNNING)
            finger.node("recorder")
            connection.log = folder / "finger.log"
            yield connection
    finally:
        for process in processes:
            os.killpg(process.pid, signal.SIGTERM)
        codes = [process.wait(TIMEOUT) for process in processes]
    assert codes == [0, 0]


@pytest.fixture(scope="module")
def finger(ros):
    finger = ros.finger()
    finger.wait_for(lambda: math.isfinite(finger.newest().number))
    return finger


@pytest.fixture
def control(ros):
    """Return a function that runs `fingerctl` with some words and returns exit code and what it prints."""

    def run(*words):
        text = io.StringIO()
        arguments = fingerctl.parse(list(words))
        code = fingerctl.carry_out(ros, arguments, Console(file=text, width=120))
        return code, text.getvalue()

    return run


def test_every_node_says_once_what_it_waits_for_and_that_it_runs(ros):
    said = ros.log.read_text()
    for words in (
        "[finger.temperature]: waits for '/finger/clock'",
        "[finger.temperature]: publishes '/finger/temperature'",
        "[finger.feedback]: waits for '/finger/deflection'",
        "[finger.feedback]: answers '/finger/deflection'",
        "[finger.feedforward]: waits for '/finger/command'",
        "[finger.feedforward]: answers '/finger/command'",
        "[finger.cantilever]: running, at sample 1",
    ):
        assert said.count(words) == 1, said
    assert said.count("feedback_robust.yaml: Controller 'robust', by `synthesize") == 1


def near(finger, target):
    return lambda: abs(finger.newest().deflection - target) < 0.1e-6


def test_the_only_finger_is_found(ros, finger):
    assert ros.fingers() == ["/finger"]
    names = {"cantilever", "feedback", "feedforward", "temperature", "recorder"}
    assert set(finger.nodes()) == {f"/finger/{name}" for name in names}


def test_set_point_and_reading(finger):
    finger.set(10e-6)
    finger.wait_for(near(finger, 10e-6))
    finger.wait_for(lambda: finger.newest().reference == 10e-6)
    reading = finger.newest()
    assert reading.command == pytest.approx(10e-6, abs=1e-6)
    assert reading.temperature == 22.0
    assert reading.tip_force == 0.0
    assert finger.words() == "running"
    finger.zero()
    finger.wait_for(near(finger, 0.0))


def test_waveform_is_followed_sample_by_sample_and_recorded(finger, tmp_path):
    """The bag's reference, evaluated at each sample, is what the finger followed."""
    wanted = Waveform("sine", amplitude=5e-6, frequency=5.0, offset=2e-6)
    assert finger.record(str(tmp_path / "bag")) == str(tmp_path / "bag")
    before = finger.newest().time
    finger.wave(wanted)
    sent = finger.newest().time
    finger.wait_for(lambda: finger.newest().deflection > 6.5e-6)
    seen = finger.newest().time
    finger.wait_for(lambda: finger.newest().time > seen + 0.2)
    with pytest.raises(ClientError, match="is recording already; `fingerctl record off` ends that"):
        finger.record()
    finger.end_record()
    with pytest.raises(ClientError, match="'/finger/recorder' is not recording$"):
        finger.end_record()
    finger.zero()
    (message,) = open_bag(tmp_path / "bag").messages("/finger/reference_waveform", WAVEFORM_TYPE)
    followed = Waveform.of(message)
    assert followed == replace(wanted, start=message.start)
    assert before + LEAD_TIME <= message.start <= sent + LEAD_TIME
    recording = read(tmp_path / "bag")
    time = recording.number * SAMPLE_TIME
    heard = np.isfinite(recording.reference)
    np.testing.assert_array_equal(recording.reference[heard], followed.at(time[heard]))
    # `robust` settles within 4 ms, in which this sine moves by 0.63 µm at most; noise is 5 nm, a quantum 10 nm.
    runs = time > time[-1] - 0.2
    assert np.max(np.abs(recording.deflection - recording.reference)[runs]) < 0.7e-6
    assert np.ptp(recording.deflection[runs]) == pytest.approx(10e-6, rel=0.05)


def test_waveforms_too_fast_for_the_loop_and_too_large_ones_are_refused(finger):
    finger.set(3e-6)
    finger.wait_for(near(finger, 3e-6))
    with pytest.raises(ClientError, match="the waveform goes up to 0.002 m"):
        finger.wave(Waveform("sine", amplitude=2e-3, frequency=1.0))
    with pytest.raises(ClientError, match=r"deflection is 10 m, must be within ±0.001 m: metres\?"):
        finger.set(10.0)
    with pytest.raises(
        ClientError, match="'reference_waveform' ignored: frequency is up to 6000 Hz"
    ):
        finger.wave(Waveform("sine", amplitude=5e-6, frequency=6000.0))
    assert finger.newest().reference == 3e-6
    sent = finger.newest().time
    finger.wait_for(lambda: finger.newest().time > sent + 0.1)
    assert near(finger, 3e-6)()


def test_the_reference_is_the_one_that_is_followed_also_for_who_joins_later(ros, finger):
    profiles = ros.node.create_publisher(Profile, "/finger/reference_profile", LATCHED)
    waveforms = ros.node.create_publisher(WaveformMessage, "/finger/reference_waveform", SETPOINT)
    for publisher in (profiles, waveforms):
        finger.wait_for(lambda p=publisher: p.get_subscription_count() > 0)
    profiles.publish(Profile(time=[0.0], value=[4e-6]))
    finger.wait_for(near(finger, 4e-6))
    finger.set(6e-6)
    finger.wait_for(lambda: finger.newest().reference == 6e-6)
    with connect(TIMEOUT) as later:
        late = later.finger("finger")
        late.wait_for(lambda: late.state and math.isfinite(late.newest().number))
        assert late.newest().reference == 6e-6
        wave = Waveform("sine", amplitude=5e-6, frequency=2.0)
        waveforms.publish(waveform_message(wave))
        for one in (finger, late):
            one.wait_for(lambda one=one: one.newest().reference not in (4e-6, 6e-6))
    with connect(TIMEOUT) as later:
        late = later.finger("finger")

        def is_smooth():
            reading = late.newest()
            return abs(reading.reference - wave.at(reading.time)) < 1e-12

        late.wait_for(is_smooth)
        for _ in range(20):  # looks between two states see it move, too
            assert is_smooth()
    ros.node.destroy_publisher(profiles)
    ros.node.destroy_publisher(waveforms)
    finger.zero()
    finger.wait_for(near(finger, 0.0))


def test_nonsense_about_what_is_followed_does_not_end_a_client(ros, finger):
    """A profile needs as many values as times; the reference stays that of the finger's state."""
    finger.set(2e-6)
    finger.wait_for(near(finger, 2e-6))
    topic = "/finger/reference_followed_profile"
    followed = ros.node.create_publisher(Profile, topic, FOLLOWED)
    finger.wait_for(lambda: followed.get_subscription_count() > 0)
    followed.publish(Profile(time=[0.0, 1.0], value=[9e-6]))
    finger.set(3e-6)
    finger.wait_for(near(finger, 3e-6))
    assert finger.newest().reference == 3e-6
    ros.node.destroy_publisher(followed)


def test_what_a_finger_cannot_follow_is_refused_naming_its_reach(ros, control, capsys, finger):
    """Commands of `robust` end at ±22 µm, as in its file."""
    assert finger.reach() == (-22e-6, 22e-6)
    before = finger.newest().reference
    for words in (["set", "30"], ["wave", "sine", "--amplitude-um", "500", "--frequency-hz", "1"]):
        assert control(*words)[0] == 1
        assert "'/finger' has commands of -22 to 22 µm" in capsys.readouterr().err
    assert finger.newest().reference == before
    ros.set_parameters("/finger/feedback", {"command_high": 5e-6})
    with pytest.raises(ClientError, match="goes to 6 µm, '/finger' has commands of -22 to 5 µm"):
        finger.set(6e-6)
    ros.set_parameters("/finger/feedback", {"command_high": 22e-6})
    finger.home()  # to both ends, and not beyond


def test_a_command_at_its_end_counts_as_limited(ros, finger):
    set_points = ros.node.create_publisher(Sample, "/finger/reference", SETPOINT)
    finger.wait_for(lambda: set_points.get_subscription_count() > 0)
    before = finger.state.clipped
    set_points.publish(Sample(value=30e-6))
    finger.wait_for(lambda: finger.newest().command == 22e-6)
    finger.wait_for(lambda: finger.state.clipped > before + 1000)
    finger.zero()
    finger.wait_for(near(finger, 0.0))
    ros.node.destroy_publisher(set_points)


def test_controllers_take_over_and_open_loop_is_one(ros, finger):
    finger.control("none")
    assert ros.parameters("/finger/feedback")["controller"] == "none"
    with pytest.raises(ClientError, match="'robst' is no file, and not one of the known"):
        finger.control("robst")
    finger.control("robust")
    values = ros.parameters("/finger/feedback")
    assert (values["controller"], values["certified"]) == ("state_space", True)


def test_stopped_finger_is_at_rest_and_starts_again(finger):
    finger.set(5e-6)
    finger.wait_for(near(finger, 5e-6))
    finger.stop()
    finger.wait_for(lambda: finger.words() == "idle" and finger.state.voltage == 0.0)
    with pytest.raises(
        ClientError, match="does not move, it is idle; `fingerctl start` lets it run"
    ):
        finger.set(2e-6)
    finger.start()
    finger.wait_for(lambda: finger.words() == "running" and near(finger, 5e-6)())


def test_a_finger_that_runs_free_is_stopped_and_starts_again_without_a_fault(ros, tmp_path):
    """Stopped one by one, its blocks would miss each other for longer than their hold time."""
    hold_time = 1.0  # s: other processes share this machine
    values = f"mode:=free_running sample_time:=0.01 hold_time:={hold_time}"
    words = [word for value in values.split() for word in ("-p", value)]
    with NodeProcesses({"finger": ["--ros-args", "-r", "__ns:=/free", *words]}, tmp_path):
        finger = ros.finger("free")
        finger.wait_for(lambda: finger.words() == "running")
        finger.stop()
        finger.wait_for(lambda: finger.words() == "idle" and finger.state.voltage == 0.0)
        begin = time.monotonic()
        ros.wait(lambda: time.monotonic() > begin + 1.5 * hold_time, lambda: "")
        finger.start()
        finger.wait_for(lambda: finger.words() == "running")
        finger.set(3e-6)
        finger.wait_for(lambda: finger.state.voltage > 1.0)


def test_fault_is_in_words_and_reset_ends_it(ros, finger, control, capsys):
    """A `feedforward` that is deactivated answers nothing, which ends a run in lock-step."""
    ros.lifecycle("/finger/feedforward", "deactivate")
    finger.wait_for(lambda: finger.state.phase == FingerState.FAULT)
    assert "fault: no answer to sample" in finger.words()
    wave = ["wave", "sine", "--amplitude-um", "1", "--frequency-hz", "1"]
    for words in (["set", "1"], wave, ["zero"], ["home"]):
        assert control(*words)[0] == 1
        assert "fault: no answer to sample" in (said := capsys.readouterr().err)
        assert "`fingerctl reset` goes on" in said
    way_on = "service '/finger/cantilever/reset' (`fingerctl reset`) or a new activation goes on"
    assert way_on in ros.log.read_text()
    ros.lifecycle("/finger/feedforward", "activate")
    assert set(finger.reset()) == set(finger.nodes())
    finger.wait_for(lambda: finger.words() == "running")


def test_fingerctl_moves_and_shows(control, finger):
    assert control("set", "8", "--wait", "--near-um", "0.1")[0] == 0
    assert near(finger, 8e-6)()
    code, text = control("state")
    assert code == 0
    assert "running" in text and "deflection [µm]" in text and "tip force [mN]" in text
    code, text = control("watch", "--seconds", "0.5")
    assert code == 0 and "reference [µm]" in text
    assert control("zero") == (0, "")
    code, text = control("list")
    assert text.startswith("/finger: cantilever, feedback, feedforward")
    wave = ["decaying_sine", "--amplitude-um", "5", "--frequency-hz", "20", "--duration", "0.2"]
    assert control("wave", *wave) == (0, "")


def test_fingerctl_lifecycle_and_parameters(ros, control):
    assert control("lifecycle", "temperature") == (0, "/finger/temperature: active\n")
    assert "/finger/recorder: unconfigured\n" in control("lifecycle")[1]
    code, text = control("params", "cantilever")
    assert yaml.safe_load(text)["sample_time"] == SAMPLE_TIME
    narrow = io.StringIO()  # as a pipe is; lines stay whole
    fingerctl.carry_out(
        ros, fingerctl.parse(["params", "cantilever"]), Console(file=narrow, width=20)
    )
    assert narrow.getvalue() == text
    assert control("params", "cantilever", "hold_time", "1") == (0, "")
    assert control("params", "cantilever", "hold_time") == (0, "{hold_time: 1.0}\n")


def test_diagnostics_say_where_a_controller_comes_from(ros):
    def values():
        status = ros.diagnostics.get("/finger/feedback")
        return {pair.key: pair.value for pair in status.values} if status else {}

    ros.wait(lambda: "controller from" in values(), lambda: str(ros.diagnostics))
    assert values()["controller from"].startswith("Controller 'robust', by `synthesize")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (
            ["params", "cantilever", "hold_time", "0"],
            1,
            "refuses: Parameter hold_time out of range",
        ),
        (["params", "cantilever", "hold"], 1, "has no parameter 'hold'"),
        (
            ["params", "cantilever", "hold_time", "[1"],
            2,
            "'hold_time' is '[1', must be YAML: while",
        ),
        (
            ["params", "cantilever", "hold_time", "{a: 1}"],
            2,
            "'hold_time' is {'a': 1}, must be a number",
        ),
        (
            ["params", "/bad name", "hold_time"],
            2,
            "'/bad name' cannot be: namespace must not contain",
        ),
        (["-f", "bad name!", "state"], 2, "'bad name!' cannot be: namespace must not contain"),
        (["grip", "30", "--gripper", "1x"], 2, "'1x' cannot be: namespace must not have a token"),
        # The sensor's quantum is 10 nm.
        (["set", "0.005", "--wait", "--near-um", "0.001"], 1, "µm, not at 0.005 µm: "),
        (["control", "robst"], 1, "not one of the known"),
        (["wave", "sweep", "--amplitude-um", "1", "--frequency-hz", "1"], 2, "end_frequency is 0"),
        (["set", "1e6"], 1, "deflection is 1 m, must be within"),
        (
            ["lifecycle", "recorder", "deactivate"],
            1,
            "'/finger/recorder' refuses to deactivate: it is unconfigured; transition 4 is not possible",
        ),
    ],
)
def test_fingerctl_says_what_is_refused(ros, control, capsys, monkeypatch, words, code, message):
    monkeypatch.setattr(ros, "timeout", 10.0)
    assert control(*words)[0] == code
    assert message in capsys.readouterr().err


def test_fingerctl_names_the_fingers_that_are_there(ros, capsys):
    """The executable, beside a finger of another name."""
    done = subprocess.run(
        [EXECUTABLES / "fingerctl", "--timeout", "3", "-f", "fingr", "state"],
        capture_output=True, text=True, timeout=TIMEOUT,
    )  # fmt: skip
    assert done.returncode == 1
    assert (
        "'/fingr' is silent: nothing on '/fingr/state'; fingers that are there: /finger"
        in done.stderr
    )
    assert "Traceback" not in done.stderr


def test_what_another_thread_destroys_does_not_end_the_connection():
    """The thread that hears prepares to wait for it at that very moment."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with connect(TIMEOUT) as connection:
            node = connection.node
            first, second = (node.create_publisher(Sample, "nobody", SETPOINT) for _ in range(2))
            for _ in range(1000):
                node.destroy_publisher(first)
                first, second = second, node.create_publisher(Sample, "nobody", SETPOINT)
            assert "client" in [thread.name for thread in threading.enumerate()]
    finally:
        sys.setswitchinterval(before)
