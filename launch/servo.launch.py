# SPDX-License-Identifier: Apache-2.0
"""The loop in real time on a driver, and a recorder if wanted, in one namespace.

    ros2 launch piezo_gripper servo.launch.py params:=commissioned/servo.yaml

What is named here goes before what the parameter file says. Record it with
`ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from piezo_control.nodes import launched

# Of the servo; empty: as the parameter file says, or else the node's default.
OF_THE_SERVO = {
    "driver": (str, "'simulated', 'udp', 'iio', or the path of a shared library"),
    "driver_options": (str, "of the driver"),
    "feedforward_file": (
        str,
        "parameter file of inverse and limits; the paper's finger where none is named",
    ),
    "voltage_share": (float, "share of the voltage limits that is used"),
    "force_control": (bool, "feel and limit the force, in place of the controller (docs/touch.md)"),
}
ARGUMENTS = (
    launched.ARGUMENTS
    | {"controller": ("", "controller: a shipped name, or the path of a parameter file")}
    | {"params": ("", "parameter file, such as the servo.yaml that `commission` writes")}
    | {name: ("", text) for name, (_, text) in OF_THE_SERVO.items()}
)


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    asked = {
        name: ParameterValue(given[name], value_type=kind)
        for name, (kind, _) in OF_THE_SERVO.items()
        if given[name]
    }
    if given["controller"]:
        asked["controller_file"] = ParameterValue(given["controller"], value_type=str)
    return launched.launched(context, given, {"servo": asked}, file_wins=False)


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*launched.declared(ARGUMENTS), OpaqueFunction(function=nodes)])
