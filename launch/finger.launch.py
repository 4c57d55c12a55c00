# SPDX-License-Identifier: Apache-2.0
"""One finger in one namespace: feedforward and feedback, a simulated cantilever and its temperature, a recorder.

The nodes configure and activate themselves, in any order, unless `autostart:=false` leaves that to a supervisor. Ctrl-C
brings the voltage to rest before they end.

Record it with `ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from piezo_control.parameters import is_for, need_one_for

ARGUMENTS = {
    "namespace": ("finger", "namespace of the finger's nodes and topics"),
    "controller": ("robust", "controller: a shipped name, or the path of a parameter file"),
    "params": ("", "parameter file of the finger's nodes, over the arguments here"),
    "plant": ("simulated", "'simulated', or 'none': your driver publishes deflection, and applies voltage"),
    "mode": ("lockstep", "lockstep or free_running"),
    "sample_time": ("0.0001", "sample time in s; that of the controller's design"),
    "force_control": ("false", "feel and limit the force, in place of the controller (docs/touch.md)"),
    "state_period": ("0.1", "how often the finger's state is published, in s"),
    "record": ("false", "record every topic into a bag in the present folder"),
    "autostart": ("true", "false: whoever supervises the nodes configures and activates them"),
    "respawn": ("false", "start a node again that ends"),
    "use_sim_time": ("false", "stamps by /clock; the loop's watchdogs do not follow it"),
    "log_level": ("info", "of every node"),
}  # fmt: skip
SWITCH = ["true", "false", "True", "False"]
CHOICES = {"plant": ["simulated", "none"], "mode": ["lockstep", "free_running"]} | {
    name: SWITCH for name, (default, _) in ARGUMENTS.items() if default in SWITCH
}


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    feels = given["force_control"].lower() == "true"
    sampled = {"mode": given["mode"], "sample_time": float(given["sample_time"])}
    controller = ParameterValue(given["controller"], value_type=str)
    simulated = given["plant"] == "simulated"
    models = {"compensator": "sensorless", "temperature_lockstep": simulated}
    parameters = {
        "feedforward": sampled | (models if feels else {"compensator": "inverse"}),
        "feedback": {
            "mode": given["mode"],
            "controller_file": controller,
            "force_control": feels,
        },
    }
    if given["controller"] == "none":
        parameters["feedback"] |= sampled
    if simulated:
        period = {"state_period": float(given["state_period"]), "temperature_lockstep": True}
        parameters |= {"cantilever": sampled | period, "temperature": {"mode": given["mode"]}}
    if given["record"].lower() == "true":
        parameters["recorder"] = {}
    common = {name: given[name].lower() == "true" for name in ("autostart", "use_sim_time")}
    folders = (context.launch_configurations.get("ros_namespace", ""), given["namespace"])
    place = "".join("/" + folder.strip("/") for folder in folders if folder.strip("/"))
    file = given["params"]
    if file:
        need_one_for(file, [f"{place}/{name}" for name in parameters])
    return [
        Node(
            package="piezo_gripper",
            executable=name,
            namespace=given["namespace"],
            # A node refuses a file that has nothing for it.
            parameters=[
                common | own,
                *([file] if file and is_for(file, f"{place}/{name}") else []),
            ],
            ros_arguments=["--log-level", given["log_level"]],
            respawn=given["respawn"].lower() == "true",
            respawn_delay=1.0,
            output="screen",
        )
        for name, own in parameters.items()
    ]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name, default_value=value, description=text, choices=CHOICES.get(name)
                )
                for name, (value, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=nodes),
        ]
    )
