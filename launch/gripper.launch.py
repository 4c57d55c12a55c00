# SPDX-License-Identifier: Apache-2.0
"""A gripper: two fingers in the namespaces left and right, and the action server in front of them."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FINGERS = ("left", "right")


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("piezo_gripper")
    finger = PathJoinSubstitution([share, "launch", "finger.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "sample_time",
                default_value="0.0001",
                description="sample time in s, of fingers and gripper alike",
            ),
            *(
                IncludeLaunchDescription(finger, launch_arguments={"namespace": side}.items())
                for side in FINGERS
            ),
            Node(
                package="piezo_gripper",
                executable="gripper",
                parameters=[
                    {
                        "fingers": list(FINGERS),
                        "sample_time": LaunchConfiguration("sample_time"),
                    },
                ],
                output="screen",
            ),
        ]
    )
