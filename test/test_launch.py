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


def test_a_file_reaches_the_gripper_and_its_picture(started, tmp_path):
    file = tmp_path / "gripper.yaml"
    file.write_text("/**/gripper: {ros__parameters: {joint: jaw, force_limit: 1.0e-3}}")
    nodes = started("gripper.launch.py", namespace="cell", gripper_params=str(file))
    assert (nodes["/cell/gripper"]["joint"], nodes["/cell/gripper"]["force_limit"]) == ("jaw", 1e-3)
    assert nodes["/cell/gripper"]["sample_time"] == 1e-4  # what the file has nothing for stays


def test_a_servo_has_the_controller_that_was_named(started, tmp_path):
    file = tmp_path / "servo.yaml"
    file.write_text("/**/servo: {ros__parameters: {controller_file: fast, driver: udp}}")
    nodes = started("servo.launch.py", params=str(file), controller="robust")
    assert nodes["/finger/servo"]["controller_file"] == "robust"
    assert nodes["/finger/servo"]["driver"] == "udp"


def test_an_experiment_takes_its_options_by_their_names(monkeypatch):
    commands = []
    monkeypatch.setattr(
        ExecuteLocal,
        "execute",
        lambda process, context: commands.append(
            [perform_substitutions(context, part) for part in process.cmd]
        ),
    )
    source = PythonLaunchDescriptionSource(str(FOLDER / "experiment.launch.py"))
    given = {"controller": "robust fast", "out": "there", "arguments": "--duration 0.1"}
    service = LaunchService()
    service.include_launch_description(
        LaunchDescription([IncludeLaunchDescription(source, launch_arguments=given.items())])
    )
    assert service.run() == 0
    words = ["step", "--out", "there", "--controller", "robust", "fast", "--duration", "0.1"]
    assert [command[1:] for command in commands] == [words]
