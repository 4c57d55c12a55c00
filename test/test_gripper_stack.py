# SPDX-License-Identifier: Apache-2.0
"""A whole simulated gripper by one command, driven by the client class and by `fingerctl`."""

import io
import re
import signal
import subprocess
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_prefix
from rich.console import Console

from piezo_control.gripper import AT_LIMIT, GripperParameters
from piezo_control.nodes import fingerctl
from piezo_control.nodes.client import ClientError, connect

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"
TIMEOUT = 180.0  # s, generous: the tests wait on conditions
FORCE = 0.5e-3  # N
STIFFNESS = 3000.0  # N/m, ten times a tip's
FREE_PLAY = 5e-6  # m, so tips touch the object at an opening of 30 µm
DEFAULTS = GripperParameters()


@pytest.fixture(scope="module")
def ros(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stack")
    contact = {"stiffness": STIFFNESS, "free_play": FREE_PLAY, "damping": 0.05}
    file = folder / "object.yaml"
    file.write_text(yaml.safe_dump({"/**/cantilever": {"ros__parameters": {"contact": contact}}}))
    log = folder / "stack.log"
    command = [EXECUTABLES / "gripper_stack", "--namespace", "cell", "--params", file]
    with log.open("wb") as output:
        stack = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        with connect(TIMEOUT) as connection:
            yield connection
    finally:
        stack.send_signal(signal.SIGINT)
        code = stack.wait(TIMEOUT)
    assert code == 0, log.read_text()
    assert "Traceback" not in log.read_text()


def test_something_is_grasped_and_let_go(ros):
    gripper = ros.gripper("cell")
    felt = []
    assert gripper.move(36e-6, on_feedback=felt.append).reached_goal
    assert felt and felt[0].opening == pytest.approx(DEFAULTS.rest_opening, abs=0.5e-6)
    grasped = gripper.grasp(FORCE, 200e-6)
    # The sensors have a quantum of 10 nm, 3 % of the tip's way at this force.
    assert AT_LIMIT * FORCE <= grasped.force < 1.05 * FORCE
    touching = DEFAULTS.rest_opening - 2 * FREE_PLAY
    assert grasped.opening == pytest.approx(touching - 2 * FORCE / STIFFNESS, abs=0.1e-6)
    released = gripper.release(500e-6)
    assert released.reached_goal
    assert released.opening == pytest.approx(80e-6, abs=DEFAULTS.tolerance)


def test_impossible_goals_are_refused_with_the_range(ros):
    gripper = ros.gripper("cell")
    with pytest.raises(ClientError, match=r"opening is 0.0002, must be in \[0, 8e-05\] m"):
        gripper.move(200e-6)
    with pytest.raises(ClientError, match=r"max_force is 1, must be in \[5e-05, 0.005\] N"):
        gripper.grasp(1.0)


def test_fingerctl_grips_and_says_how_it_ended(ros, capsys):
    text = io.StringIO()

    def run(*words):
        arguments = fingerctl.parse(["grip", *words, "--gripper", "cell"])
        return fingerctl.carry_out(ros, arguments, Console(file=text, width=120))

    assert run("38") == 0
    assert run("10", "--force-mn", "0.5") == 0
    ways, openings = zip(*re.findall(r"(.+): opening (\S+) µm, force", text.getvalue()))
    assert ways == ("there", "stopped before")
    pressed = DEFAULTS.rest_opening - 2 * (FREE_PLAY + FORCE / STIFFNESS)
    near = DEFAULTS.tolerance * 1e6
    assert [float(o) for o in openings] == pytest.approx([38.0, pressed * 1e6], abs=near)
    assert run("200") == 1
    assert "'/cell/gripper': opening is 0.0002, must be in" in capsys.readouterr().err
