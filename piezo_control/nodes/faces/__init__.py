# SPDX-License-Identifier: Apache-2.0
"""The faces of the gripper: each lets it be driven or watched in one of the ways that ROS 2 has for that."""
