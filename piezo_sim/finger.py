"""All nodes of a simulated finger in one process, for the shortest way from block to block."""

from __future__ import annotations

from piezo_control import finger_node
from piezo_control.feedback_node import FeedbackNode
from piezo_control.feedforward_node import FeedforwardNode
from piezo_sim.cantilever_node import CantileverNode
from piezo_sim.temperature_node import TemperatureNode


def main() -> int:
    return finger_node.run(TemperatureNode, FeedforwardNode, FeedbackNode, CantileverNode)
