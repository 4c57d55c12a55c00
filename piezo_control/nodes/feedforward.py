# SPDX-License-Identifier: Apache-2.0
"""The block H_s⁻¹ of the paper's loop: from the commanded deflection to the voltage.

in:  command (Sample, m)
out: voltage (Sample, V), clipped and limited in slew: the last place before the actuator

Running free, a command that stays away is held and then ramped to 0 V; so is the voltage when the node
is deactivated, shut down or stopped by a signal. In lock-step the cantilever, master of time, does that.
"""

from __future__ import annotations

import dataclasses
import math
import time

from piezo_control.feedforward import Feedforward, FeedforwardParameters, toward_zero
from piezo_control.nodes import base as finger_node
from piezo_control.nodes.block import SampleFilterNode, mode, subscribers
from piezo_control.parameters import parameter
from piezo_gripper_msgs.msg import Sample

RAMP_PERIOD = 1e-3  # s between two voltages of a ramp


@dataclasses.dataclass(frozen=True)
class FeedforwardNodeParameters(FeedforwardParameters):
    """The law's parameters and the node's own."""

    mode: str = mode()
    subscribers: int = subscribers()
    sample_time: float = parameter(
        1e-4, "time from command to command, for the slew limit", unit="s", low=1e-6, high=1.0
    )
    hold_time: float = parameter(
        0.1, "running free: how long the voltage holds without a command before it ramps to 0 V",
        unit="s", low=1e-3, high=60.0,
    )  # fmt: skip
    ramp: float = parameter(1e4, "slope of the ramp to 0 V", unit="V/s", low=1.0, high=1e7)


class FeedforwardNode(SampleFilterNode):
    NAME = "feedforward"
    PARAMETERS = FeedforwardNodeParameters
    INPUT = "command"
    OUTPUT = "voltage"

    def __init__(self) -> None:
        super().__init__()
        self.watchdog = self.create_timer(RAMP_PERIOD, self._watch, autostart=False)
        self.restart()

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"hold_time", "ramp"}

    def restart(self) -> None:
        self.law = Feedforward(self.parameters, self.parameters.sample_time)
        self.heard = math.inf
        if self.parameters.mode == "free_running":
            self.watchdog.reset()

    def compute(self, number: int, value: float) -> float:
        self.heard = time.monotonic()
        return self.law.step(value)

    def stop(self) -> None:
        self.watchdog.cancel()
        if self.parameters.mode == "free_running":
            while self.last.value:
                self._ramp()
                time.sleep(RAMP_PERIOD)

    def _watch(self) -> None:
        if self.last.value and time.monotonic() - self.heard > self.parameters.hold_time:
            self.get_logger().error(
                f"no command for {self.parameters.hold_time:g} s: voltage ramped to 0 V",
                throttle_duration_sec=1.0,
            )
            self._ramp()

    def _ramp(self) -> None:
        """Publish the next voltage on the way to 0 V; the law's plays go along."""
        step = self.parameters.ramp * RAMP_PERIOD
        last = self.last.value
        voltage = Sample(number=self.last.number)
        voltage.header.stamp = self.get_clock().now().to_msg()
        voltage.value = toward_zero(last, step)
        self.law.follow(voltage.value)
        self.answers.publish(voltage)
        self.last = voltage


def main() -> int:
    return finger_node.run(FeedforwardNode)
