# SPDX-License-Identifier: Apache-2.0
"""The client and `fingerctl` with a running finger and its recorder."""

import io
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from ament_index_python.packages import get_package_prefix
from rich.console import Console

from piezo_control.nodes import fingerctl
from piezo_control.nodes.client import LEAD_TIME, ClientError, connect
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import WAVEFORM_TYPE, read
from piezo_control.waveform import Waveform
from piezo_gripper_msgs.msg import FingerState

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
    return ros.finger()


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


def test_waveform_too_fast_for_the_loop_is_ignored_and_too_large_ones_are_refused(finger):
    finger.set(3e-6)
    finger.wait_for(near(finger, 3e-6))
    with pytest.raises(ClientError, match="the waveform goes up to 0.002 m"):
        finger.wave(Waveform("sine", amplitude=2e-3, frequency=1.0))
    with pytest.raises(ClientError, match=r"deflection is 10 m, must be within ±0.001 m: metres\?"):
        finger.set(10.0)
    finger.wave(Waveform("sine", amplitude=5e-6, frequency=6000.0))
    sent = finger.newest().time
    finger.wait_for(lambda: finger.newest().time > sent + 0.1)
    assert near(finger, 3e-6)()


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
    finger.start()
    finger.wait_for(lambda: finger.words() == "running" and near(finger, 5e-6)())


def test_fault_is_in_words_and_reset_ends_it(ros, finger):
    """A `feedforward` that is deactivated answers nothing, which ends a run in lock-step."""
    ros.lifecycle("/finger/feedforward", "deactivate")
    finger.wait_for(lambda: finger.state.phase == FingerState.FAULT)
    assert "fault: no answer to sample" in finger.words()
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


def test_fingerctl_lifecycle_and_parameters(control):
    assert control("lifecycle", "temperature") == (0, "/finger/temperature: active\n")
    assert "/finger/recorder: unconfigured\n" in control("lifecycle")[1]
    code, text = control("params", "cantilever")
    assert yaml.safe_load(text)["sample_time"] == SAMPLE_TIME
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
def test_fingerctl_says_what_is_refused(control, capsys, words, code, message):
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
