# SPDX-License-Identifier: Apache-2.0
"""The simulated cantilever and its temperature as ROS 2 nodes."""
