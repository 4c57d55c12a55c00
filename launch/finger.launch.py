# SPDX-License-Identifier: Apache-2.0
"""One finger: cantilever, temperature, feedforward and feedback, started and active in one namespace."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "namespace": ("finger", "namespace of the finger's nodes and topics"),
    "controller": ("robust", "controller: params/feedback_<controller>.yaml"),
    "mode": ("lockstep", "lockstep or free_running"),
    "sample_time": ("0.0001", "sample time in s; that of the controller's design"),
}


def generate_launch_description() -> LaunchDescription:
    params = PathJoinSubstitution([FindPackageShare("piezo_gripper"), "params"])
    controller = LaunchConfiguration("controller")
    common = {"mode": LaunchConfiguration("mode")}
    sampled = {**common, "sample_time": LaunchConfiguration("sample_time")}
    nodes = {
        "temperature": [common],
        "feedforward": [sampled],
        "feedback": [ParameterFile([params, "/feedback_", controller, ".yaml"]), common],
        "cantilever": [{**sampled, "temperature_lockstep": True}],
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()
            ),
            *(
                Node(
                    package="piezo_gripper",
                    executable=name,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=parameters,
                    output="screen",
                )
                for name, parameters in nodes.items()
            ),
        ]
    )
