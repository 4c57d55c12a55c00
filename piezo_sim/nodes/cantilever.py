# SPDX-License-Identifier: Apache-2.0
"""The simulated piezocantilever with its amplifier and sensor: the block H_s·D(s) + b of the paper.

in:  voltage (Sample, V), temperature (sensor_msgs/Temperature, °C),
     tip_force (Sample, N: one value), tip_force_profile (Profile, N)
out: deflection (Sample, m), clock (rosgraph_msgs/Clock), state (FingerState)

In lock-step it is the master of time: it publishes deflection k, moves on when voltage k is there, and
asks again for what is late by publishing the same sample and the same clock once more. An answer that
never comes ends the run with 0 V and an error that says which topic fell silent. Running free it moves
on with the wall clock, holds the newest voltage and ramps to 0 V when that gets old.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from time import monotonic

import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from piezo_control.feedforward import toward_zero
from piezo_control.nodes import base as finger_node
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.block import mode, subscribers
from piezo_control.nodes.profile_input import ProfileInput
from piezo_control.nodes.qos import LATCHED, SAMPLE
from piezo_control.parameters import parameter
from piezo_gripper_msgs.msg import FingerState, Sample
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.temperature import grid_index

STATE_PERIOD = 0.1  # s
JITTER_WINDOW = 1000  # periods: to sort more takes longer than a period
RETRY_PERIOD = 0.1  # s


@dataclasses.dataclass(frozen=True)
class CantileverNodeParameters(CantileverParameters):
    """The plant's parameters and the node's own."""

    mode: str = mode()
    subscribers: int = subscribers()
    samples: int = parameter(0, "samples to take, then finish; 0: without end", low=0, high=10**12)
    ambient_temperature_degc: float = parameter(
        22.0, "temperature as long as the topic says nothing", unit="°C", low=-50.0, high=150.0
    )
    temperature_lockstep: bool = parameter(
        False, "lock-step waits for the temperature of every sample too, asking by `clock`"
    )
    temperature_period: float = parameter(
        1e-3, "grid on which the temperature comes in lock-step", unit="s", low=1e-6, high=10.0
    )
    clock_period: float = parameter(
        1e-2, "how often `clock` is published", unit="s", low=1e-6, high=10.0
    )
    reply_timeout: float = parameter(
        2.0, "lock-step: how long an answer may take once the loop has run", unit="s",
        low=0.2, high=3600.0,
    )  # fmt: skip
    hold_time: float = parameter(
        0.1, "running free: how long an old voltage is held before the ramp to 0 V", unit="s",
        low=1e-3, high=60.0,
    )  # fmt: skip
    ramp: float = parameter(1e4, "slope of the ramp to 0 V", unit="V/s", low=1.0, high=1e7)


class CantileverNode(FingerNode):
    NAME = "cantilever"
    PARAMETERS = CantileverNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.deflections = self.create_publisher(Sample, "deflection", SAMPLE)
        self.clocks = self.create_publisher(Clock, "clock", SAMPLE)
        self.states = self.create_publisher(FingerState, "state", LATCHED)
        self.create_subscription(Sample, "voltage", self._on_voltage, SAMPLE)
        self.create_subscription(Temperature, "temperature", self._on_temperature, SAMPLE)
        self.tip_force = ProfileInput(self, "tip_force", self.parameters.sample_time)
        self.create_timer(STATE_PERIOD, self._publish_state)
        self.watchdog = self.create_timer(RETRY_PERIOD, self._watch, autostart=False)
        self.tick = self.create_timer(1.0, self._tick, autostart=False)
        self.phase = FingerState.IDLE
        self.text = ""
        self.ticks: deque[float] = deque(maxlen=JITTER_WINDOW)
        self._reset()

    def _reset(self) -> None:
        p = self.parameters
        self.plant = Cantilever(p)
        self.tip_force.restart(p.sample_time)
        self.number = 0
        self.asked_again = 0
        self.sample = Sample()
        self.pending_voltage: float | None = None
        self.temperature = p.ambient_temperature_degc
        self.temperatures: dict[int, float] = {}
        self.grid = -1
        self.samples_per_clock = max(1, round(p.clock_period / p.sample_time))

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"reply_timeout", "hold_time", "ramp"}

    def start(self) -> None:
        self._reset()
        self._enter(FingerState.WAITING)
        self.heard = monotonic()
        if self.parameters.mode == "lockstep":
            self.watched = -1
            self.watchdog.reset()
            self._measure()
        else:
            self.ticks.clear()
            self.tick.timer_period_ns = round(self.parameters.sample_time * 1e9)
            self.tick.reset()

    def stop(self) -> None:
        if self.phase in (FingerState.WAITING, FingerState.RUNNING):
            self._end(FingerState.IDLE)
        else:
            self._enter(FingerState.IDLE)

    # --- lock-step ----------------------------------------------------------------------------------

    def _measure(self) -> None:
        """Take deflection `self.number` and ask for its voltage."""
        sample = Sample(number=self.number)
        stamp = sample.header.stamp
        stamp.sec, stamp.nanosec = divmod(
            round(self.number * self.parameters.sample_time * 1e9), 10**9
        )
        sample.value = self.plant.measure()
        self.sample = sample
        if self.number == 0:
            self._ask()
            return
        if self.number % self.samples_per_clock == 0:
            self.clocks.publish(Clock(clock=stamp))
        self.deflections.publish(sample)

    def _ask(self) -> None:
        """Publish clock and deflection, once more where that was done, if they have their readers."""
        if self.deflections.get_subscription_count() >= self.parameters.subscribers:
            self.clocks.publish(Clock(clock=self.sample.header.stamp))
            self.deflections.publish(self.sample)

    def _on_voltage(self, voltage: Sample) -> None:
        if not self.active or self.phase not in (FingerState.WAITING, FingerState.RUNNING):
            return
        if self.parameters.mode == "free_running":
            self._hold(voltage)
        elif voltage.number == self.number and self.pending_voltage is None:
            if not math.isfinite(voltage.value):
                self._fault(f"'voltage' sample {voltage.number} is {voltage.value} V, not finite")
                return
            self.pending_voltage = voltage.value
            self._advance()

    def _on_temperature(self, message: Temperature) -> None:
        if not math.isfinite(message.temperature):
            self.get_logger().error(
                f"'temperature' is {message.temperature} °C, must be finite; ignored",
                throttle_duration_sec=1.0,
            )
        elif self.parameters.mode == "free_running" or not self.parameters.temperature_lockstep:
            self.temperature = message.temperature
        elif self.active:
            stamp = message.header.stamp
            instant = stamp.sec + stamp.nanosec * 1e-9
            self.temperatures[round(instant / self.parameters.temperature_period)] = (
                message.temperature
            )
            self._advance()

    def _advance(self) -> None:
        """Go on to the next sample when everything the present one needs is there."""
        if self.pending_voltage is None:
            return
        if self.parameters.temperature_lockstep:
            p = self.parameters
            grid = grid_index(self.number, p.sample_time, p.temperature_period)
            if grid != self.grid:
                if grid not in self.temperatures:
                    return
                self.temperature = self.temperatures[grid]
                self.temperatures = {n: t for n, t in self.temperatures.items() if n > grid}
                self.grid = grid
        self.plant.advance(self.pending_voltage, self.temperature, self.tip_force[self.number])
        self.pending_voltage = None
        self.number += 1
        if self.phase == FingerState.WAITING:
            self._enter(FingerState.RUNNING)
        if self.number == self.parameters.samples:
            self._end(FingerState.FINISHED)
        else:
            self._measure()

    def _watch(self) -> None:
        """Ask again for what is late; give up when it stays away."""
        if self.number != self.watched:
            self.watched = self.number
            self.heard = monotonic()
            return
        silence = monotonic() - self.heard
        if self.phase == FingerState.RUNNING and silence > self.parameters.reply_timeout:
            self._fault(f"no answer to sample {self.number} for {silence:.1f} s: {self._missing()}")
            return
        if self.phase == FingerState.WAITING:
            self.text = f"waiting for sample 0: {self._missing()}"
        else:
            self.asked_again += 1
        self._ask()

    def _missing(self) -> str:
        """Say which topic is silent, and whether anybody publishes it."""
        if self.pending_voltage is not None:
            topics = {"temperature": "temperature"}
        else:
            topics = {"command": "feedback", "voltage": "feedforward"}
        for topic, node in topics.items():
            if not self.count_publishers(topic):
                return f"node '{node}' is gone: nobody publishes '{self.resolve_topic_name(topic)}'"
        silent = " or ".join(f"'{self.resolve_topic_name(topic)}'" for topic in topics)
        return f"{silent} is published but silent; is the node active?"

    # --- running free -------------------------------------------------------------------------------

    def _hold(self, voltage: Sample) -> None:
        if math.isfinite(voltage.value):
            self.pending_voltage = voltage.value
            self.heard = monotonic()
        else:
            self.get_logger().error(
                f"'voltage' is {voltage.value} V, must be finite; ignored",
                throttle_duration_sec=1.0,
            )

    def _tick(self) -> None:
        p = self.parameters
        self.ticks.append(monotonic())
        sample = Sample(number=self.number)
        sample.header.stamp = self.get_clock().now().to_msg()
        sample.value = self.plant.measure()
        self.deflections.publish(sample)
        self.sample = sample
        if self.number % self.samples_per_clock == 0:
            self.clocks.publish(Clock(clock=sample.header.stamp))
        voltage = self.pending_voltage or 0.0
        if voltage and monotonic() - self.heard > p.hold_time:
            step = p.ramp * p.sample_time
            voltage = toward_zero(voltage, step)
            self.pending_voltage = voltage
            self.text = f"no voltage for {p.hold_time:g} s: to 0 V"
        self.plant.advance(voltage, self.temperature, self.tip_force[self.number])
        self.number += 1
        if self.phase == FingerState.WAITING and self.pending_voltage is not None:
            self._enter(FingerState.RUNNING)
        if self.number == p.samples:
            self._end(FingerState.FINISHED)

    # --- ends ---------------------------------------------------------------------------------------

    def _fault(self, text: str) -> None:
        self.get_logger().error(f"{text}; voltage ramped to 0 V")
        self._end(FingerState.FAULT, text)

    def _end(self, phase: int, text: str = "") -> None:
        """Ramp the finger to 0 V and say how the run ended."""
        self.watchdog.cancel()
        self.tick.cancel()
        step = self.parameters.ramp * self.parameters.sample_time
        voltage = self.plant.voltage
        while voltage:
            voltage = toward_zero(voltage, step)
            self.plant.advance(voltage, self.temperature, 0.0)
        self._enter(phase, text)

    def _enter(self, phase: int, text: str = "") -> None:
        self.phase = phase
        self.text = text
        self._publish_state()

    def _publish_state(self) -> None:
        state = FingerState(phase=self.phase, samples=self.number, text=self.text)
        state.header.stamp = self.sample.header.stamp
        state.deflection = self.sample.value
        state.voltage = self.plant.voltage
        state.tip_force = self.plant.tip_force
        state.temperature = self.temperature
        state.clipped = self.plant.clipped
        state.asked_again = self.asked_again
        if len(self.ticks) > 1:
            late = np.abs(np.diff(self.ticks) - self.parameters.sample_time)
            state.jitter = float(np.quantile(late, 0.999))
        self.states.publish(state)


def main() -> int:
    return finger_node.run(CantileverNode)
