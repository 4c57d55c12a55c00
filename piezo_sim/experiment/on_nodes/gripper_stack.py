# SPDX-License-Identifier: Apache-2.0
"""Starts a whole simulated gripper: two fingers, the gripper in front of them, and a recorder for each finger.

What the nodes say comes out here. Ctrl-C ends all of them, with the fingers at rest; so does the end of any one.
A recorder waits until it is told to record, as by `fingerctl record on`. The fingers hold a force, without a force
sensor; with --controller they hold a position instead, and feel nothing. It is no node itself: in place of
`--ros-args -r __ns:=/NAME` it takes --namespace NAME, and --params in place of `--params-file`.

Exit code: 0 ended by a signal, 1 a node ended by itself, 2 unusable arguments.
"""

from __future__ import annotations

import argparse
import sys

from piezo_control.feedback import read_controller
from piezo_control.parameters import ParameterError
from piezo_control.start import stop_at_signals
from piezo_sim.experiment.on_nodes.processes import NodeDied, NodeProcesses
from piezo_sim.plant.cantilever import CantileverParameters

SIDES = ("left", "right")
FEELING = {"force_control": "true", "compensator": "sensorless", "temperature_lockstep": "true"}


def main() -> int:
    """Run the processes and return the exit code."""
    arguments = parse()
    try:
        finger = of_finger(arguments.controller)
    except ParameterError as error:
        print(f"gripper_stack: {error}", file=sys.stderr)
        return 2
    stop = stop_at_signals()
    try:
        with NodeProcesses(commands(arguments, finger)) as nodes:
            while not stop.wait(0.1):
                nodes.check()
    except NodeDied as error:
        print(f"gripper_stack: {error}", file=sys.stderr)
        return 1
    return 0


def of_finger(controller: str) -> dict[str, str]:
    """Return the ROS parameters of a finger that holds a position by `controller`; empty: a force."""
    if not controller:
        return {"sample_time": str(CantileverParameters.sample_time), **FEELING}
    # Nodes at other sample times than the controller's refuse the loop.
    sample_time = read_controller(controller).sample_time
    return {"sample_time": str(sample_time), "controller_file": controller}


def commands(arguments: argparse.Namespace, finger: dict[str, str]) -> dict[str, list[str]]:
    """Return the processes by name, and what they are started with."""
    namespace = "/" + arguments.namespace.strip("/")
    files = [word for path in arguments.params for word in ("--params-file", path)]
    found = {}
    for side in SIDES:
        here = ["--ros-args", "-r", f"__ns:={namespace.rstrip('/')}/{side}"]
        given = [word for item in finger.items() for word in ("-p", ":=".join(item))]
        found[f"{side}/finger"] = [*here, *given, *files]
        found[f"{side}/recorder"] = [*here, "-p", "autostart:=false"]
    gripper = ["-r", f"__ns:={namespace}", "-p", f"sample_time:={finger['sample_time']}"]
    found["gripper"] = ["--ros-args", *gripper]
    return found


def parse() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--controller",
        default="",
        metavar="NAME",
        help="hold a position by it: shipped name or file",
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
