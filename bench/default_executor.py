"""One of the package's nodes on rclpy's default executor with default settings, to compare with."""

import sys
from importlib import import_module

import rclpy

MODULES = {
    "cantilever": ("piezo_sim.cantilever_node", "CantileverNode"),
    "temperature": ("piezo_sim.temperature_node", "TemperatureNode"),
    "feedforward": ("piezo_control.feedforward_node", "FeedforwardNode"),
    "feedback": ("piezo_control.feedback_node", "FeedbackNode"),
}

module, name = MODULES[sys.argv.pop(1)]
rclpy.init()
node = getattr(import_module(module), name)()
node.trigger_configure()
node.trigger_activate()
rclpy.spin(node)
