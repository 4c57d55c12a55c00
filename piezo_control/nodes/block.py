# SPDX-License-Identifier: Apache-2.0
"""A block of the loop: one numbered sample in, one out, each answered exactly once.

The rule that makes the loop deterministic whatever the transport does. A sample numbered one more than
the last is computed and published. The last number again is a request to repeat: the stored answer is
published, nothing is computed. Number 0 starts a new run. Anything else means that somebody else
answered samples of this topic, which no order of computation can mend: the node says so and goes
silent, and the cantilever runs into its time limit and to 0 V.
"""

from __future__ import annotations

import math

from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.qos import SAMPLE
from piezo_control.parameters import parameter
from piezo_gripper_msgs.msg import Sample

MODE = "lockstep: every sample once, in order; free_running: the newest sample, with watchdogs"
MODES = ("lockstep", "free_running")


def mode() -> str:
    """Declare the parameter `mode` of a node of the loop."""
    return parameter("lockstep", MODE, choices=MODES)


def subscribers() -> int:
    """Declare the parameter `subscribers` of a node of the loop."""
    return parameter(
        1,
        "lock-step: sample 0 waits for so many subscribers of the output: the next block, a recorder",
        low=0,
        high=100,
    )


class SampleFilterNode(FingerNode):
    """Subscribe `INPUT`, publish `OUTPUT`; a subclass says what becomes of a value."""

    INPUT: str
    OUTPUT: str

    def __init__(self) -> None:
        super().__init__()
        self.answers = self.create_publisher(Sample, self.OUTPUT, SAMPLE)
        self.create_subscription(Sample, self.INPUT, self._on_sample, SAMPLE)
        self.last = Sample()
        self.expected = -1

    def restart(self) -> None:
        """Take up a new run, before its first sample."""
        raise NotImplementedError

    def compute(self, number: int, value: float) -> float:
        """Return the answer to sample `number`."""
        raise NotImplementedError

    def start(self) -> None:
        self.expected = -1
        self.restart()

    def _on_sample(self, sample: Sample) -> None:
        if not self.active:
            return
        number = sample.number
        if number != self.expected:
            if number == self.expected - 1:
                self.answers.publish(self.last)
                return
            if number == 0:
                if self.answers.get_subscription_count() < self.parameters.subscribers:
                    return  # the cantilever asks again
                if self.expected > 0:
                    self.restart()
            elif self.expected >= 0 and self.parameters.mode == "lockstep":
                self.get_logger().error(
                    f"'{self.INPUT}' brought sample {number}, expected {self.expected}: "
                    "does another node answer this topic?",
                    throttle_duration_sec=1.0,
                )
                return
        if not math.isfinite(sample.value):
            self.get_logger().error(
                f"'{self.INPUT}' sample {number} is {sample.value}, must be finite; not answered",
                throttle_duration_sec=1.0,
            )
            return
        answer = Sample(header=sample.header, number=number)
        answer.value = self.compute(number, sample.value)
        self.answers.publish(answer)
        self.last = answer
        self.expected = number + 1
