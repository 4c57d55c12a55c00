# SPDX-License-Identifier: Apache-2.0
"""A named experiment of the simulated finger over real nodes: recorded, analysed, with a report.

What else the command takes goes into `arguments`: `arguments:="--params folder --controller robust,fast"`. It records by
itself; who records beside it loses nothing with
`ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix

ARGUMENTS = {
    "experiment": ("step", "name of the experiment, as `experiment --help` lists them"),
    "out": ("out/experiment", "folder of the results"),
    "arguments": ("", "more of the command's arguments"),
}


def generate_launch_description() -> LaunchDescription:
    program = PathJoinSubstitution(
        [FindPackagePrefix("piezo_gripper"), "lib", "piezo_gripper", "experiment"]
    )
    name, out, more = (LaunchConfiguration(argument) for argument in ARGUMENTS)
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(argument, default_value=value, description=text)
                for argument, (value, text) in ARGUMENTS.items()
            ),
            # The words of `arguments` are several; the shell takes them apart.
            ExecuteProcess(
                cmd=[["'", program, "' '", name, "' --out '", out, "' ", more]],
                shell=True,
                output="screen",
            ),
        ]
    )
