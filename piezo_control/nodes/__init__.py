# SPDX-License-Identifier: Apache-2.0
"""The blocks as ROS 2 nodes: parameters, topics and lifecycle around the laws."""
