"""A gripper: two fingers in the namespaces left and right."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    finger = PathJoinSubstitution([FindPackageShare("piezo_gripper"), "launch", "finger.launch.py"])
    return LaunchDescription(
        [
            IncludeLaunchDescription(finger, launch_arguments={"namespace": side}.items())
            for side in ("left", "right")
        ]
    )
