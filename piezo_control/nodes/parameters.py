# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of the loop, the laws' own and those of running as a node; needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.parameters import parameter
from piezo_control.safety import SafetyParameters

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
    age_limit: float = parameter(
        0.05,
        "running free: an input older than this is not acted upon",
        unit="s",
        low=1e-3,
        high=10.0,
    )


@dataclass(frozen=True)
class FeedforwardNodeParameters(FeedforwardParameters, LoopParameters, SafetyParameters):
    """The law's parameters and the node's own."""

    sample_time: float = parameter(
        1e-4, "time from command to command, for the slew limit", unit="s", low=1e-6, high=1.0
    )


@dataclass(frozen=True)
class FeedbackNodeParameters(FeedbackParameters, LoopParameters):
    """The law's parameters and the node's own."""

    controller_file: str = parameter(
        "",
        "parameter file to take the whole controller from, or the name of a shipped one ('robust')",
    )


RECORDED = (
    "reference", "reference_profile", "deflection", "command", "voltage", "temperature", "tip_force",
    "tip_force_profile", "state",
)  # fmt: skip
"""Topics of a finger."""


@dataclass(frozen=True)
class RecorderParameters:
    """Where to write, and what."""

    bag: str = parameter("", "folder to write, new; empty: 'finger_' and the time in this folder")
    topics: tuple[str, ...] = parameter(RECORDED, "topics to record, relative or absolute")
