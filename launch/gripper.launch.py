# SPDX-License-Identifier: Apache-2.0
"""A gripper: two fingers in the namespaces left and right, and the gripper node in front of them.

What finger.launch.py takes goes to both fingers, as `params:=FILE` or `plant:=none`; `gripper_params:=FILE` is for the node
in front of them. `rviz:=true` shows the gripper, as its parameters have it, where robot_state_publisher and rviz2 are installed.

Record it with `ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription, OpaqueFunction
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushROSNamespace
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from piezo_control.nodes import launched
from piezo_control.nodes.gripper import GripperNodeParameters
from piezo_control.parameters import build, load
from piezo_control.sequence import SAMPLE_TIME

FINGERS = ("left", "right")  # the default of the gripper node; lists do not pass launch whole
ARGUMENTS = launched.ARGUMENTS | {
    "namespace": ("", "namespace of the gripper; those of the fingers are below it"),
    "sample_time": (str(SAMPLE_TIME), "sample time in s, of fingers and gripper alike"),
    "force_control": ("true", "the fingers keep a force limit by themselves (docs/touch.md)"),
    "state_period": ("0.01", "how often a finger's state is published, in s; as joint states are"),
    "joint_states": (
        "joint_states",
        "topic of joint states; behind ros2_control: gripper/joint_states",
    ),
    "gripper_params": ("", "parameter file of the gripper node: its joints' names, reach, limits"),
    "rviz": ("false", "show the gripper in RViz"),
    "visual_scale": ("20", "RViz shows ways across the gap so much larger"),
}
OF_THE_DESCRIPTION = (
    "rest_opening",
    "deflection_low",
    "deflection_high",
    "speed_limit",
    "force_limit",
)

SHARE = FindPackageShare("piezo_gripper")


def gripper(context: LaunchContext) -> list[Node]:
    """Return the gripper node, and what shows it."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    file = given["gripper_params"]
    joint_states = ("joint_states", given["joint_states"])
    nodes = launched.launched(
        context,
        given | {"namespace": "", "record": "false", "params": file},
        {"gripper": {"sample_time": float(given["sample_time"])}},
        file_wins=True,
        remappings=[joint_states],
    )
    if not launched.is_on(given, "rviz"):
        return nodes
    law = build(GripperNodeParameters, load(file, "gripper") if file else {}, file)
    described = {"ros2_control": "false", "visual_scale": given["visual_scale"], "joint": law.joint}
    described |= zip(("left_finger_joint", "right_finger_joint"), law.finger_joints, strict=True)
    described |= {name: getattr(law, name) for name in OF_THE_DESCRIPTION}
    xacro = PathJoinSubstitution([SHARE, "description", "piezo_gripper.urdf.xacro"])
    description = Command(["xacro ", xacro, *(f" {name}:={it}" for name, it in described.items())])
    clock = {"use_sim_time": launched.is_on(given, "use_sim_time")}
    return [
        *nodes,
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": ParameterValue(description, value_type=str)}, clock],
            remappings=[joint_states],
            output="screen",
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=[
                "-d",
                PathJoinSubstitution([SHARE, "description", "config", "gripper.rviz"]),
            ],
            parameters=[clock],
            output="screen",
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    finger = PathJoinSubstitution([SHARE, "launch", "finger.launch.py"])
    fingers = [
        IncludeLaunchDescription(finger, launch_arguments=[("namespace", side)]) for side in FINGERS
    ]
    place = PushROSNamespace(LaunchConfiguration("namespace"))
    return LaunchDescription(
        [
            *launched.declared(ARGUMENTS),
            GroupAction([place, *fingers, OpaqueFunction(function=gripper)]),
        ]
    )
