# SPDX-License-Identifier: Apache-2.0
"""The block K of the paper's loop: from the deflection and the reference to the command.

in:  deflection (Sample, m), reference (Sample, m: a set-point), reference_profile (Profile, m)
out: command (Sample, m)

The newest of set-point and profile is followed. With `controller: none` the reference passes through:
open loop. A changed controller takes over while the loop runs, with the command where it was.
"""

from __future__ import annotations

import dataclasses

from piezo_control.feedback import Feedback, FeedbackParameters
from piezo_control.nodes import base as finger_node
from piezo_control.nodes.block import SampleFilterNode, mode, subscribers
from piezo_control.nodes.profile_input import ProfileInput


@dataclasses.dataclass(frozen=True)
class FeedbackNodeParameters(FeedbackParameters):
    """The law's parameters and the node's own."""

    mode: str = mode()
    subscribers: int = subscribers()


class FeedbackNode(SampleFilterNode):
    NAME = "feedback"
    PARAMETERS = FeedbackNodeParameters
    INPUT = "deflection"
    OUTPUT = "command"

    def __init__(self) -> None:
        super().__init__()
        self.law = Feedback(self.parameters)
        self.reference = ProfileInput(self, "reference", self.parameters.sample_time)

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names & {"mode", "sample_time"}

    def restart(self) -> None:
        self.law = Feedback(self.parameters)
        self.reference.restart(self.parameters.sample_time)

    def apply(self) -> None:
        if self.expected > 0:
            law = Feedback(self.parameters)
            law.start(self.reference[self.expected - 1], self.deflection, self.last.value)
            self.law = law

    def compute(self, number: int, value: float) -> float:
        self.deflection = value
        return self.law.step(self.reference[number], value)


def main() -> int:
    return finger_node.run(FeedbackNode)
