# SPDX-License-Identifier: Apache-2.0
"""A named experiment of the simulated finger over real nodes: recorded, analysed, with a report.

What else the command takes goes into `arguments`: `arguments:="--params folder --controller robust,fast"`. It records by
itself; who records beside it loses nothing with
`ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`.
"""

import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

from piezo_control.nodes import launched

ARGUMENTS = {
    "experiment": ("step", "name of the experiment, as `experiment --help` lists them"),
    "out": ("out/experiment", "folder of the results"),
    "arguments": ("", "more of the command's arguments"),
}


def command(context: LaunchContext) -> list[ExecuteProcess]:
    """Return the command that the arguments ask for."""
    name, out, more = (LaunchConfiguration(argument).perform(context) for argument in ARGUMENTS)
    program = PathJoinSubstitution(
        [FindPackagePrefix("piezo_gripper"), "lib", "piezo_gripper", "experiment"]
    )
    return [ExecuteProcess(cmd=[program, name, "--out", out, *shlex.split(more)], output="screen")]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*launched.declared(ARGUMENTS), OpaqueFunction(function=command)])
