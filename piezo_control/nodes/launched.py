# SPDX-License-Identifier: Apache-2.0
"""The nodes of one namespace, as the launch files start them; for machines with ROS 2's launch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from launch import LaunchContext
from launch.actions import DeclareLaunchArgument
from launch_ros.actions import Node

from piezo_control.parameters import is_for, need_one_for

RESPAWN_DELAY = 1.0  # s
SWITCH = ["true", "false", "True", "False"]
ARGUMENTS = {
    "namespace": ("finger", "namespace of the finger's nodes and topics"),
    "record": ("false", "record every topic into a bag in the present folder"),
    "autostart": ("true", "false: whoever supervises the nodes configures and activates them"),
    "respawn": ("false", "start a node again that ends"),
    "use_sim_time": ("false", "stamps by /clock; the loop's watchdogs do not follow it"),
    "log_level": ("info", "of every node"),
}
"""Arguments of each launch file that starts nodes, with their defaults."""


def declared(
    arguments: Mapping[str, tuple[str, str]], **choices: list[str]
) -> list[DeclareLaunchArgument]:
    """Return the declarations of `arguments`, by default and description; some have `choices`, as switches have."""
    return [
        DeclareLaunchArgument(
            name,
            default_value=default,
            description=text,
            choices=SWITCH if default in SWITCH else choices.get(name),
        )
        for name, (default, text) in arguments.items()
    ]


def is_on(given: Mapping[str, str], name: str) -> bool:
    """Say whether a switch among the given arguments is on."""
    return given[name].lower() == "true"


def launched(
    context: LaunchContext,
    given: Mapping[str, str],
    parameters: Mapping[str, Mapping[str, Any]],
    file_wins: bool,
    remappings: Sequence[tuple[str, str]] = (),
) -> list[Node]:
    """Return the nodes whose `parameters` are named, by what is `given` for `ARGUMENTS` and `params`, a file.

    Of what both say, the file's value is taken if `file_wins`. A file that has nothing for any of them is refused
    by ParameterError; a node refuses one that has nothing for it, so it goes to those only that it is for.
    """
    if is_on(given, "record"):
        parameters = {**parameters, "recorder": {}}
    common = {name: is_on(given, name) for name in ("autostart", "use_sim_time")}
    folders = (context.launch_configurations.get("ros_namespace", ""), given["namespace"])
    place = "".join("/" + folder.strip("/") for folder in folders if folder.strip("/"))
    file = given["params"]
    if file:
        need_one_for(file, [f"{place}/{name}" for name in parameters])

    def sources(name: str) -> list[Any]:
        own = parameters[name]
        if not file or not is_for(file, f"{place}/{name}"):
            return [common, own]
        return [common, own, file] if file_wins else [common, file, own]

    return [
        Node(
            package="piezo_gripper",
            executable=name,
            namespace=given["namespace"],
            parameters=sources(name),
            remappings=remappings,
            ros_arguments=["--log-level", given["log_level"]],
            respawn=is_on(given, "respawn"),
            respawn_delay=RESPAWN_DELAY,
            output="screen",
        )
        for name in parameters
    ]
