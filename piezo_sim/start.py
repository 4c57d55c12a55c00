# SPDX-License-Identifier: Apache-2.0
"""Starts the executables of the simulation."""

from piezo_control.start import executable

cantilever = executable("piezo_sim.nodes.cantilever")
experiment = executable("piezo_sim.experiment.cli")
finger = executable("piezo_sim.nodes.all_in_one")
gripper_stack = executable("piezo_sim.experiment.on_nodes.gripper_stack")
monte_carlo = executable("piezo_sim.experiment.monte_carlo")
temperature = executable("piezo_sim.nodes.temperature")
udp_finger = executable("piezo_sim.udp_finger")
