# SPDX-License-Identifier: Apache-2.0
"""The loop in real time on a driver, and a recorder if wanted, in one namespace.

Record it with `ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "namespace": ("finger", "namespace of the finger's nodes and topics"),
    "driver": ("simulated", "'simulated', 'udp', 'iio', or the path of a shared library"),
    "driver_options": ("", "of the driver"),
    "controller_file": ("robust", "controller: a shipped name, or the path of a parameter file"),
    "feedforward_file": ("", "parameter file of inverse and limits; empty: the paper's finger"),
    "voltage_share": ("1.0", "share of the voltage limits that is used"),
    "record": ("false", "record every sample into a bag in the present folder"),
}
TEXTS = ("driver", "driver_options", "controller_file", "feedforward_file")


def generate_launch_description() -> LaunchDescription:
    namespace = LaunchConfiguration("namespace")
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in TEXTS}
    parameters["voltage_share"] = ParameterValue(
        LaunchConfiguration("voltage_share"), value_type=float
    )
    common = {"package": "piezo_gripper", "namespace": namespace, "output": "screen"}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()
            ),
            Node(executable="servo", parameters=[parameters], **common),
            Node(
                executable="recorder",
                condition=IfCondition(LaunchConfiguration("record")),
                **common,
            ),
        ]
    )
