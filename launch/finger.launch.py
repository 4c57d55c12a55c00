# SPDX-License-Identifier: Apache-2.0
"""One finger in one namespace: feedforward and feedback, a simulated cantilever and its temperature, a recorder.

The nodes configure and activate themselves, in any order, unless `autostart:=false` leaves that to a supervisor. Ctrl-C
brings the voltage to rest before they end.

Record it with `ros2 bag record --qos-profile-overrides-path $(ros2 pkg prefix --share piezo_gripper)/params/rosbag2_qos.yaml`
and the topics; without the file rosbag2 loses samples (docs/recordings.md).
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from piezo_control.nodes import launched
from piezo_control.sequence import SAMPLE_TIME

ARGUMENTS = launched.ARGUMENTS | {
    "controller": ("robust", "controller: a shipped name, or the path of a parameter file"),
    "params": ("", "parameter file of the finger's nodes, over the arguments here"),
    "plant": ("simulated", "'simulated', or 'none': your driver publishes deflection, and applies voltage"),
    "mode": ("lockstep", "lockstep or free_running"),
    "sample_time": (str(SAMPLE_TIME), "sample time in s; that of the controller's design"),
    "force_control": ("false", "feel and limit the force, in place of the controller (docs/touch.md)"),
    "state_period": ("0.1", "how often the finger's state is published, in s"),
}  # fmt: skip
CHOICES = {"plant": ["simulated", "none"], "mode": ["lockstep", "free_running"]}


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    feels = launched.is_on(given, "force_control")
    simulated = given["plant"] == "simulated"
    sampled = {"mode": given["mode"], "sample_time": float(given["sample_time"])}
    models = {"compensator": "sensorless", "temperature_lockstep": simulated}
    parameters = {
        "feedforward": sampled | (models if feels else {"compensator": "inverse"}),
        "feedback": {
            "mode": given["mode"],
            "controller_file": ParameterValue(given["controller"], value_type=str),
            "force_control": feels,
        },
    }
    if given["controller"] == "none":
        parameters["feedback"] |= sampled
    if simulated:
        period = {"state_period": float(given["state_period"]), "temperature_lockstep": True}
        parameters |= {"cantilever": sampled | period, "temperature": {"mode": given["mode"]}}
    return launched.launched(context, given, parameters, file_wins=True)


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [*launched.declared(ARGUMENTS, **CHOICES), OpaqueFunction(function=nodes)]
    )
