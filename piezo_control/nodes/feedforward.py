# SPDX-License-Identifier: Apache-2.0
"""The block H_s⁻¹ of the paper's loop: from the commanded deflection to the voltage.

in:  command (Sample, m), state (FingerState: the voltage that is applied when this node starts)
out: voltage (Sample, V), clipped and limited in slew: the last place before the actuator

Running free, a command that stays away is held and then ramped to rest, the voltage nearest to 0 V, where
it stays until `~/reset`. When the node is deactivated, shut down or stopped by a signal, the voltage ramps to
rest too, in either mode. A restart goes on from the voltage that is applied.
"""

from __future__ import annotations

import time
from typing import Any

from piezo_control.feedforward import Feedforward
from piezo_control.nodes import base
from piezo_control.nodes.block import BlockNode
from piezo_control.nodes.parameters import FeedforwardNodeParameters
from piezo_control.safety import (
    FAULT,
    LARGEST_DEFLECTION,
    RAMP_PERIOD,
    RAMPING,
    limits,
)
from piezo_gripper_msgs.msg import Sample


class FeedforwardNode(BlockNode):
    NAME = "feedforward"
    PARAMETERS = FeedforwardNodeParameters
    INPUT = "command"
    OUTPUT = "voltage"
    LARGEST = LARGEST_DEFLECTION

    def __init__(self) -> None:
        super().__init__()
        self.watchdog = self.create_steady_timer(RAMP_PERIOD, self._watch, autostart=False)
        self.moved = time.monotonic()
        self._clipped = 0
        self._build(0.0)

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"hold_time", "ramp"}

    def apply(self) -> None:
        self.guard.hold_time = self.parameters.hold_time

    def start(self) -> None:
        super().start()
        self.apply()
        if self.finger and not self.last.number:
            self._build(self.finger.voltage)  # another process moved the finger before this one
        elif self.built_with != self.parameters:
            self._build(self.law.voltage)
        self.moved = time.monotonic()
        if self.parameters.mode == "free_running":
            self.watchdog.reset()

    def restart(self) -> None:
        """Begin with a homed finger at the voltage that is applied, or else at the last one."""
        self._build(self.finger.voltage if self.finger else self.law.voltage)

    def _build(self, voltage: float) -> None:
        """Make a new law of a homed finger that was led to `voltage` (V)."""
        self.built_with = self.parameters
        self.law = Feedforward(self.parameters, self.parameters.sample_time)
        if voltage != self.law.voltage:
            self.law.follow(voltage)

    def compute(self, number: int, value: float) -> float:
        now = time.monotonic()
        share = 1.0
        if self.parameters.mode == "free_running":
            share = min(1.0, (now - self.moved) / self.parameters.sample_time)
        self.moved = now
        self.guard.hear(now)
        self._clipped = self.law.clipped
        return self.law.step(value, share)

    def limited(self) -> bool:
        return self.law.clipped > self._clipped

    def report(self) -> tuple[str, dict[str, Any]]:
        wrong, figures = super().report()
        return wrong, {**figures, "voltage": self.law.voltage, "clipped": self.law.clipped}

    def reset(self) -> None:
        super().reset()
        self.moved = time.monotonic()

    def trip(self, cause: str) -> None:
        super().trip(cause)
        self.watchdog.reset()  # in lock-step too: the voltage goes to rest

    def stop(self) -> None:
        self.watchdog.cancel()
        self.guard.trip("stopped", time.monotonic())
        while self.guard.phase == RAMPING:
            self._ramp()
            time.sleep(RAMP_PERIOD)
        self.guard.reset()

    def _watch(self) -> None:
        now = time.monotonic()
        before = self.guard.phase
        self.guard.look(now, 2.0 * self.parameters.sample_time + RAMP_PERIOD, "command")
        if self.guard.phase != before and self.guard.is_latched:
            self.get_logger().error(
                f"{self.guard.cause}: voltage goes to rest and stays there until '~/reset'"
            )
            self.publish_diagnostics()
        if self.guard.phase == RAMPING:
            self._ramp()
        elif self.guard.phase == FAULT and self.parameters.mode == "lockstep":
            self.watchdog.cancel()

    def _ramp(self) -> None:
        """Publish the next voltage on the way to rest; the law's plays go along."""
        now = time.monotonic()
        p = self.parameters
        # What a late timer missed is not made up for: the ramp becomes longer, never steeper.
        elapsed = min(now - self.moved, RAMP_PERIOD)
        self.moved = now
        value = self.guard.voltage(limits(p, p.ramp), self.law.voltage, elapsed)
        if value == self.law.voltage:
            return
        voltage = Sample(number=self.last.number, value=value, period=p.sample_time)
        voltage.header.stamp = self.last.header.stamp
        if p.mode == "free_running":
            voltage.header.stamp = base.system_time()
        self.law.follow(value)
        self.answers.publish(voltage)
        self.last = voltage


def main() -> int:
    return base.run(FeedforwardNode)
