# SPDX-License-Identifier: Apache-2.0
"""Launch files start what their arguments say; where ROS 2's launch is installed, and without starting a process."""

from itertools import pairwise
from pathlib import Path

import pytest
import yaml

pytest.importorskip("launch_ros", reason="ROS 2's launch is not installed")

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import ExecuteLocal, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.utilities import perform_substitutions
from launch.utilities.type_utils import perform_typed_substitution

from piezo_control.nodes import launched

FOLDER = Path(__file__).resolve().parents[1] / "launch"


def offered(file):
    """Return the arguments that `ros2 launch --show-args` shows, with their defaults."""
    context = LaunchContext()
    source = PythonLaunchDescriptionSource(str(FOLDER / file))
    return {
        argument.name: perform_substitutions(context, argument.default_value)
        for argument in source.get_launch_description(context).get_launch_arguments()
    }


@pytest.fixture
def started(monkeypatch):
    """Return what launches a file with arguments: parameters of each node that would start, and if it does so again."""
    nodes = {}

    def execute(process, context):
        command = [perform_substitutions(context, part) for part in process.cmd]
        place = next(
            (w.removeprefix("__ns:=").rstrip("/") for w in command if w.startswith("__ns:=")), ""
        )
        again = perform_typed_substitution(context, process._ExecuteLocal__respawn, bool)
        parameters = {"respawn": again}
        for option, file in pairwise(command):
            if option == "--params-file":
                (content,) = yaml.safe_load(Path(file).read_text()).values()
                parameters |= content["ros__parameters"]
        nodes[f"{place}/{Path(command[0]).name}"] = parameters

    monkeypatch.setattr(ExecuteLocal, "execute", execute)

    def launch(file, **arguments):
        nodes.clear()
        source = PythonLaunchDescriptionSource(str(FOLDER / file))
        service = LaunchService()
        service.include_launch_description(
            LaunchDescription(
                [IncludeLaunchDescription(source, launch_arguments=arguments.items())]
            )
        )
        assert service.run() == 0
        return nodes

    return launch


FINGER = ("cantilever", "feedback", "feedforward", "temperature")


def test_what_a_gripper_offers_acts_on_its_fingers_and_itself(started):
    nodes = started(
        "gripper.launch.py", namespace="cell", force_control="false", state_period="0.05",
        use_sim_time="true", respawn="true", autostart="false", sample_time="0.0002",
    )  # fmt: skip
    fingers = {f"/cell/{side}/{name}" for side in ("left", "right") for name in FINGER}
    assert set(nodes) == fingers | {"/cell/gripper"}
    for name, parameters in nodes.items():
        assert (parameters["respawn"], parameters["use_sim_time"]) == (True, True), name
        assert parameters["autostart"] is False, name
    for side in ("left", "right"):
        assert nodes[f"/cell/{side}/feedback"]["force_control"] is False
        assert nodes[f"/cell/{side}/cantilever"]["state_period"] == 0.05
    assert nodes["/cell/gripper"]["sample_time"] == 0.0002


def test_defaults_that_are_shown_are_those_in_force(started):
    shown = offered("gripper.launch.py")
    nodes = started("gripper.launch.py")
    assert shown["namespace"] == "" and "/gripper" in nodes
    for side in ("left", "right"):
        assert nodes[f"/{side}/cantilever"]["state_period"] == float(shown["state_period"]) == 0.01
        assert nodes[f"/{side}/feedback"]["force_control"] and shown["force_control"] == "true"


@pytest.mark.parametrize("file", ["finger.launch.py", "gripper.launch.py", "servo.launch.py"])
def test_arguments_of_all_nodes_are_offered_by_every_file(file):
    assert set(launched.ARGUMENTS) <= set(offered(file))
