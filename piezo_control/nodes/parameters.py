# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of the loop and the files they come in; needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

from piezo_control.design.touching import check_stable
from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.parameters import ParameterError, build, group, load, parameter
from piezo_control.safety import SafetyParameters
from piezo_control.sensorless import SensorlessParameters
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.servo.parameters import ServoParameters
from piezo_control.thermometer import ThermometerParameters
from piezo_control.touch import TouchParameters

MODES = ("lockstep", "free_running")


@dataclass(frozen=True)
class LoopParameters:
    """How a node takes part in a loop."""

    mode: str = parameter(
        "lockstep",
        "lockstep: every sample once, in order; free_running: the newest sample, with watchdogs",
        choices=MODES,
    )
    subscribers: int = parameter(
        1,
        "lock-step: sample 0 waits for so many subscribers of the output: the next block, a recorder",
        low=0,
        high=100,
    )


@dataclass(frozen=True)
class BlockParameters(LoopParameters):
    """How a node takes samples from a loop."""

    age_limit: float = parameter(
        0.05,
        "running free: an input older than this is not acted upon",
        unit="s",
        low=1e-3,
        high=10.0,
    )


@dataclass(frozen=True)
class FeedforwardNodeParameters(
    FeedforwardParameters, SensorlessParameters, BlockParameters, SafetyParameters
):
    """The laws' parameters and the node's own."""

    compensator: str = parameter(
        "inverse",
        "inverse: analytic inverse of the hysteresis; static_gain: command / static_gain; sensorless: where "
        "no controller is in between, by the models of hysteresis, vibration, creep and heat, else inverse",
        choices=("inverse", "static_gain", "sensorless"),
    )
    sample_time: float = parameter(
        SAMPLE_TIME,
        "time from command to command, for the slew limit",
        unit="s",
        low=1e-6,
        high=1.0,
    )
    temperature_lockstep: bool = parameter(
        False, "sensorless in lock-step: each sample waits for its temperature, on a grid"
    )
    temperature_period: float = parameter(
        1e-3, "grid of these temperatures", unit="s", low=1e-6, high=10.0
    )
    thermometer: ThermometerParameters = group(ThermometerParameters)


@dataclass(frozen=True)
class FeedbackNodeParameters(FeedbackParameters, BlockParameters):
    """The law's parameters and the node's own."""

    controller_file: str = parameter(
        "",
        "parameter file to take the whole controller from, the name of a shipped one ('robust'), or 'none'",
    )
    force_control: bool = parameter(
        False,
        "a force limit acts in the loop, in place of the controller; needs the feedforward's "
        "`compensator: sensorless`, whose models say where a tip would be that nobody pushes",
    )
    touch: TouchParameters = group(TouchParameters)


@dataclass(frozen=True)
class ServoNodeParameters(ServoParameters):
    """The loop's parameters and those of its surroundings."""

    driver: str = parameter(
        "simulated", "'simulated', 'udp', or the path of a shared library (piezo_driver.h)"
    )
    driver_options: str = parameter(
        "", "of the driver; simulated: parameter file of a cantilever, udp: HOST:PORT"
    )
    controller_file: str = parameter(
        "robust",
        "parameter file of the controller, the name of a shipped one, or 'none'; also while running",
    )
    feedforward_file: str = parameter(
        "", "parameter file of the inverse hysteresis and the limits; empty: the paper's finger"
    )
    preview_band: float = parameter(
        0.0,
        "profiles and waveforms, known ahead, are followed without lag below this frequency; 0: that of the "
        "controller's file; also while running",
        unit="Hz", low=0.0, high=1e5,
    )  # fmt: skip
    voltage_share: float = parameter(
        1.0,
        "share of the way from rest to the voltage limits that is used, for a first power-on",
        low=1e-3,
        high=1.0,
    )
    force_control: bool = parameter(
        False,
        "a force limit acts in the loop, in place of the controller, of which sample time and range of the command "
        "stay; the models of hysteresis, creep and heat are those of `feedforward_file`",
    )
    touch: TouchParameters = group(TouchParameters)
    thermometer: ThermometerParameters = group(ThermometerParameters)
    priority: int = parameter(
        80, "of the loop under the real-time scheduler; 0: ordinary scheduler", low=0, high=99
    )
    cpu: int = parameter(-1, "CPU that the loop stays on; -1: any", low=-1, high=1023)
    spin: float = parameter(
        5e-5,
        "how long before its time the loop stops sleeping and spins",
        unit="s",
        low=0.0,
        high=1e-2,
    )
    block_period: float = parameter(
        1e-2, "how often `samples` are published", unit="s", low=1e-3, high=1.0
    )
    sample_period: float = parameter(
        1e-2, "how often a single deflection, command, voltage and push is published", unit="s",
        low=1e-3, high=10.0,
    )  # fmt: skip
    state_period: float = parameter(
        0.1, "how often `state` is published", unit="s", low=5e-3, high=1.0
    )
    tolerance: float = parameter(
        0.5e-6, "on target: the error stays so small", unit="m", low=0.0, high=1e-3
    )


RECORDED = (
    "reference", "reference_profile", "reference_waveform", "reference_followed_profile",
    "reference_followed_waveform", "deflection", "command", "voltage", "samples", "temperature", "tip_force",
    "tip_force_profile", "tip_force_waveform", "push", "state",
)  # fmt: skip
"""Topics of a finger."""


@dataclass(frozen=True)
class RecorderParameters:
    """Where to write, and what."""

    bag: str = parameter("", "folder to write, new; empty: namespace and time, in this folder")
    topics: tuple[str, ...] = parameter(RECORDED, "topics to record, relative or absolute")

    def __post_init__(self) -> None:
        if not self.topics:
            raise ParameterError("'topics' is empty, must name at least one topic")


def read_feedforward(parameters: ServoNodeParameters) -> FeedforwardNodeParameters:
    """Return inverse, models and limits of a parameter file, the limits as near to rest as the share to be used says."""
    path = parameters.feedforward_file
    whole = build(FeedforwardNodeParameters, load(path, "feedforward") if path else {}, path)
    share, rest = parameters.voltage_share, whole.rest
    return replace(
        whole,
        voltage_low=rest + share * (whole.voltage_low - rest),
        voltage_high=rest + share * (whole.voltage_high - rest),
        rest_voltage=rest,
    )


def check_force(
    p: ServoNodeParameters, feedforward: FeedforwardNodeParameters, sample_time: float
) -> None:
    """Raise ParameterError for a finger whose force nobody could tell, or that would swing itself up."""
    path = p.feedforward_file
    if path and "dynamics.elastic_constant" not in load(path, "feedforward"):
        raise ParameterError(
            f"{path}: 'dynamics.elastic_constant' is missing, and with it what a deflection means in N: "
            "`identify stiffness` measures it"
        )
    check_stable(p.touch, feedforward.dynamics, sample_time, loop_delay(p))


def check_sensor(
    controller: FeedbackParameters, feedforward: FeedforwardNodeParameters, p: ServoNodeParameters
) -> None:
    """Raise ParameterError for a finger that should go by its models alone, which no servo does."""
    is_open = controller.controller == "none" and not p.force_control
    if is_open and feedforward.compensator == "sensorless":
        raise ParameterError(
            f"{p.feedforward_file}: 'compensator' is 'sensorless' and 'controller_file' is '{p.controller_file}': "
            "the models of vibration, creep and heat run in the node 'feedforward' alone; with 'inverse' the servo "
            "undoes the hysteresis only"
        )


def loop_delay(p: ServoNodeParameters) -> int:
    """Return the delay of the servo's loop in samples."""
    return p.delay_samples + (p.write == "next_edge")


def check_delay(controller: FeedbackParameters, p: ServoNodeParameters) -> None:
    """Raise ParameterError unless the controller was designed for the delay of the servo's loop.

    An open loop was designed for any, and a loop that feels has no controller.
    """
    delay = loop_delay(p)
    has_one = controller.controller != "none" and not p.force_control
    if has_one and controller.delay_samples != delay:
        raise ParameterError(
            f"controller '{p.controller_file}' was designed for a delay of {controller.delay_samples} samples, "
            f"this loop has {delay}: 'delay_samples' {p.delay_samples}, 'write' {p.write}"
        )
