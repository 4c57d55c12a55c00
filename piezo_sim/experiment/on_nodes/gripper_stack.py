# SPDX-License-Identifier: Apache-2.0
"""Starts a whole simulated gripper: two fingers, the gripper in front of them, and a recorder for each finger.

What the nodes say comes out here. Ctrl-C ends all of them, with the fingers at rest; so does the end of any one.
A recorder waits until it is told to record, as by `fingerctl record on`.

Exit code: 0 ended by a signal, 1 a node ended by itself, 2 unusable arguments.
"""

from __future__ import annotations

import argparse
import sys

from piezo_control.feedback import read_controller
from piezo_control.nodes import spin
from piezo_control.parameters import ParameterError
from piezo_sim.experiment.on_nodes.processes import NodeDied, NodeProcesses

SIDES = ("left", "right")


def main() -> int:
    """Run the processes and return the exit code."""
    arguments = parse()
    try:
        controller = read_controller(arguments.controller)
    except ParameterError as error:
        print(f"gripper_stack: {error}", file=sys.stderr)
        return 2
    namespace = "/" + arguments.namespace.strip("/")
    stop = spin.stop_event()
    try:
        with NodeProcesses(commands(arguments, namespace, controller.sample_time)) as nodes:
            while not stop.wait(0.1):
                nodes.check()
    except NodeDied as error:
        print(f"gripper_stack: {error}", file=sys.stderr)
        return 1
    return 0


def commands(
    arguments: argparse.Namespace, namespace: str, sample_time: float
) -> dict[str, list[str]]:
    """Return the processes by name, and what they are started with."""
    files = [word for path in arguments.params for word in ("--params-file", path)]
    found = {}
    for side in SIDES:
        here = ["--ros-args", "-r", f"__ns:={namespace.rstrip('/')}/{side}"]
        finger = [*here, "-p", f"controller_file:={arguments.controller}"]
        # Nodes at other sample times than the controller's refuse the loop.
        finger += ["-p", f"sample_time:={sample_time}", *files]
        found[f"{side}/finger"] = finger
        found[f"{side}/recorder"] = [*here, "-p", "autostart:=false"]
    found["gripper"] = [
        "--ros-args",
        "-r",
        f"__ns:={namespace}",
        "-p",
        f"sample_time:={sample_time}",
    ]
    return found


def parse() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--controller", default="robust", metavar="NAME", help="shipped name or file (robust)"
    )
    parser.add_argument(
        "--namespace", default="/", metavar="NAME", help="of the gripper; fingers are below it"
    )
    parser.add_argument(
        "--params",
        action="append",
        default=[],
        metavar="FILE",
        help="ROS parameters of both fingers",
    )
    return parser.parse_args()
