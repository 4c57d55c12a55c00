# SPDX-License-Identifier: Apache-2.0
"""A named experiment of the simulated finger over real nodes: recorded, analysed, with a report.

What else the command takes goes into `arguments`: `arguments:="--duration 0.1 --overwrite"`. It records by itself; who
records beside it loses nothing with
`ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`.
"""

import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

from piezo_control.nodes import launched

# Options of the command by the same names; empty: its default.
OPTIONS = {
    "out": ("out/experiment", "folder of the results"),
    "namespace": ("", "namespace of the nodes"),
    "params": ("", "folder of parameter files, as `identify` writes them"),
    "controller": ("", "controllers: shipped names, or paths of parameter files, one or more"),
    "plant": ("", "'prandtl_ishlinskii' or 'truth'"),
}
ARGUMENTS = {
    "experiment": ("step", "name of the experiment, as `experiment --help` lists them"),
    **OPTIONS,
    "arguments": ("", "more of the command's arguments"),
}


def command(context: LaunchContext) -> list[ExecuteProcess]:
    """Return the command that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    options = [
        word for name in OPTIONS if given[name] for word in (f"--{name}", *shlex.split(given[name]))
    ]
    program = PathJoinSubstitution(
        [FindPackagePrefix("piezo_gripper"), "lib", "piezo_gripper", "experiment"]
    )
    more = shlex.split(given["arguments"])
    return [ExecuteProcess(cmd=[program, given["experiment"], *options, *more], output="screen")]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*launched.declared(ARGUMENTS), OpaqueFunction(function=command)])
