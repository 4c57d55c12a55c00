# SPDX-License-Identifier: Apache-2.0
"""A gripper: two fingers in the namespaces left and right, and the gripper node in front of them.

What finger.launch.py takes goes to both fingers, as `params:=FILE` or `plant:=none`. `rviz:=true` shows the gripper,
where robot_state_publisher and rviz2 are installed.

Record it with `ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushROSNamespace
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from piezo_control.nodes import launched
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
    "rviz": ("false", "show the gripper in RViz"),
    "visual_scale": ("20", "RViz shows ways across the gap so much larger"),
}


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("piezo_gripper")
    finger = PathJoinSubstitution([share, "launch", "finger.launch.py"])
    xacro = PathJoinSubstitution([share, "description", "piezo_gripper.urdf.xacro"])
    scale = LaunchConfiguration("visual_scale")
    description = Command(["xacro ", xacro, " ros2_control:=false visual_scale:=", scale])
    layout = PathJoinSubstitution([share, "description", "config", "gripper.rviz"])
    joint_states = ("joint_states", LaunchConfiguration("joint_states"))
    clock = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    shown = IfCondition(LaunchConfiguration("rviz"))
    nodes = [
        *(
            IncludeLaunchDescription(finger, launch_arguments=[("namespace", side)])
            for side in FINGERS
        ),
        Node(
            package="piezo_gripper",
            executable="gripper",
            parameters=[
                {name: LaunchConfiguration(name) for name in ("sample_time", "autostart")},
                clock,
            ],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            remappings=[joint_states],
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=launched.RESPAWN_DELAY,
            output="screen",
        ),
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": ParameterValue(description, value_type=str)}, clock],
            remappings=[joint_states],
            condition=shown,
            output="screen",
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["-d", layout],
            parameters=[clock],
            condition=shown,
            output="screen",
        ),
    ]
    return LaunchDescription(
        [
            *launched.declared(ARGUMENTS),
            GroupAction([PushROSNamespace(LaunchConfiguration("namespace")), *nodes]),
        ]
    )
