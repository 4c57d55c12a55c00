# SPDX-License-Identifier: Apache-2.0
"""One finger: cantilever, temperature, feedforward and feedback, started and active in one namespace."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import IfElseSubstitution, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "namespace": ("finger", "namespace of the finger's nodes and topics"),
    "controller": ("robust", "controller: a shipped name, or the path of a parameter file"),
    "mode": ("lockstep", "lockstep or free_running"),
    "sample_time": ("0.0001", "sample time in s; that of the controller's design"),
    "force_control": (
        "false",
        "feel and limit the force, in place of the controller (docs/touch.md)",
    ),
    "state_period": ("0.1", "how often the finger's state is published, in s"),
}


def generate_launch_description() -> LaunchDescription:
    controller = ParameterValue(LaunchConfiguration("controller"), value_type=str)
    common = {"mode": LaunchConfiguration("mode")}
    sampled = {**common, "sample_time": LaunchConfiguration("sample_time")}
    feels = LaunchConfiguration("force_control")
    compensator = IfElseSubstitution(feels, "sensorless", "inverse")
    nodes = {
        "temperature": [common],
        "feedforward": [{**sampled, "compensator": compensator}],
        "feedback": [{**common, "controller_file": controller, "force_control": feels}],
        "cantilever": [
            {
                **sampled,
                "temperature_lockstep": True,
                "state_period": LaunchConfiguration("state_period"),
            }
        ],
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
