# SPDX-License-Identifier: Apache-2.0
"""One of the package's nodes on rclpy's default executor with default settings, to compare with."""

import sys
from importlib import import_module

import rclpy

MODULES = {
    "cantilever": ("piezo_sim.nodes.cantilever", "CantileverNode"),
    "temperature": ("piezo_sim.nodes.temperature", "TemperatureNode"),
    "feedforward": ("piezo_control.nodes.feedforward", "FeedforwardNode"),
    "feedback": ("piezo_control.nodes.feedback", "FeedbackNode"),
}

module, name = MODULES[sys.argv.pop(1)]
rclpy.init()
node = getattr(import_module(module), name)()
node.trigger_configure()
node.trigger_activate()
rclpy.spin(node)
