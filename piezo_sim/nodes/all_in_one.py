# SPDX-License-Identifier: Apache-2.0
"""All nodes of a simulated finger in one process, for the shortest way from block to block."""

from __future__ import annotations

from piezo_control.nodes import base as finger_node
from piezo_control.nodes.feedback import FeedbackNode
from piezo_control.nodes.feedforward import FeedforwardNode
from piezo_sim.nodes.cantilever import CantileverNode
from piezo_sim.nodes.temperature import TemperatureNode


def main() -> int:
    return finger_node.run(TemperatureNode, FeedforwardNode, FeedbackNode, CantileverNode)
