# SPDX-License-Identifier: Apache-2.0
"""The block H_s⁻¹ of the paper's loop: from the commanded deflection to the voltage.

in:  command (Sample, m), state (FingerState: the voltage that is applied when this node starts),
     temperature (sensor_msgs/Temperature, °C) with `compensator: sensorless`,
     deflection (Sample, m) with that and `adaptation.time_constant`
out: voltage (Sample, V), clipped and limited in slew: the last place before the actuator;
     expected (Sample, m) with `compensator: sensorless`: the deflection that the models expect a sample later,
     dynamics (Dynamics), of the tip, for a feedback that feels; without that compensator an empty one

Running free, a command that stays away is held and then ramped to rest, `rest_voltage`, where
it stays until `~/reset`. When the node is deactivated, shut down or stopped by a signal, the voltage ramps to
rest too, in either mode. A restart goes on from the voltage that is applied.

With `compensator: sensorless` a command that is the reference itself goes through the models of hysteresis,
vibration, creep and heat; a controller's command goes through the inverse hysteresis, and the models follow.
So a `feedback` that is told `controller: none` in mid-run leaves a finger that goes on without a bump, with
models that were adapted to the deflections until then, where `adaptation.time_constant` is not 0. A
temperature that is missing or frozen is named in `state`, on `/diagnostics` and in the log, until it is back.
"""

from __future__ import annotations

import math
import time
from typing import Any

from rclpy.subscription import Subscription

from piezo_control.feedforward import Feedforward
from piezo_control.nodes import base
from piezo_control.nodes.block import BlockNode
from piezo_control.nodes.parameters import FeedforwardNodeParameters
from piezo_control.nodes.phases import TAKES_NONE
from piezo_control.nodes.qos import DELIVERY_TIMEOUT, LATCHED, SAMPLE
from piezo_control.nodes.temperature_input import TemperatureInput
from piezo_control.safety import (
    FAULT,
    LARGEST_DEFLECTION,
    RAMP_PERIOD,
    RAMPING,
    is_physical,
    limits,
)
from piezo_control.sensorless import Sensorless
from piezo_control.sequence import grid_index
from piezo_control.thermometer import Thermometer
from piezo_gripper_msgs.msg import Dynamics, FingerState, Sample


class FeedforwardNode(BlockNode):
    NAME = "feedforward"
    PARAMETERS = FeedforwardNodeParameters
    INPUT = "command"
    OUTPUT = "voltage"
    LARGEST = LARGEST_DEFLECTION
    MOVES_VOLTAGE = True

    def __init__(self) -> None:
        super().__init__()
        self.expectations = self.create_publisher(Sample, "expected", LATCHED)
        self.dynamics = self.create_publisher(Dynamics, "dynamics", LATCHED)
        self.watchdog = self.create_steady_timer(RAMP_PERIOD, self._watch, autostart=False)
        self.moved = time.monotonic()
        self._told = -math.inf  # when `state` was heard
        self.thermometer = Thermometer(self.parameters.thermometer, self.moved)
        self._temperatures: dict[int, float] = {}  # of lock-step, by their place on the grid
        self._temperature_input: TemperatureInput | None = None
        self._deflection_input: Subscription | None = None
        self._deflection = Sample(value=math.nan)  # the newest that the models may adapt to
        self._complained = ""
        self._build(self.parameters.rest)

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
        self.thermometer = Thermometer(self.parameters.thermometer, self.moved)
        self._temperatures.clear()
        self._complained = ""
        told = Dynamics()
        if self.parameters.compensator == "sensorless":
            self._temperature_input = TemperatureInput(self, self._on_temperature)
            self._deflection = Sample(value=math.nan)
            tip = self.parameters.dynamics
            told = Dynamics(denominator=tip.denominator, elastic_constant=tip.elastic_constant)
            if self.parameters.adaptation.time_constant:
                self._deflection_input = self.create_subscription(
                    Sample, "deflection", self._on_deflection, SAMPLE
                )
        told.header.stamp = base.system_time()
        self.dynamics.publish(told)
        if self.parameters.mode == "free_running":
            self.watchdog.reset()

    def _on_state(self, state: FingerState) -> None:
        is_first = self.finger is None
        super()._on_state(state)
        self._told = time.monotonic()
        if is_first and self.active and self.sequence.next < 0:
            self._build(state.voltage)

    def _on_sample(self, sample: Sample) -> None:
        is_lockstep = self.parameters.mode == "lockstep"
        if is_lockstep or self._answers or self.finger or not self.count_publishers("state"):
            super()._on_sample(sample)
        else:
            # Another process may have moved the finger before this one.
            self.say(f"waits for '{self.resolve_topic_name('state')}': the voltage that is applied")

    def restart(self) -> None:
        """Begin with a homed finger at the voltage that is applied: that of `state`, or one that was sent since."""
        is_told = self.parameters.mode == "lockstep" or self._told > self.moved
        self._build(self.finger.voltage if self.finger and is_told else self.law.voltage)

    def _build(self, voltage: float) -> None:
        """Make a new law of a homed finger that was led to `voltage` (V)."""
        p = self.built_with = self.parameters
        self.law: Feedforward | Sensorless
        if p.compensator == "sensorless":
            degc = self.thermometer.degc
            self._settled = not math.isnan(degc)
            start = degc if self._settled else p.thermometer.degc_at_start
            self.law = Sensorless(p, p.sample_time, start)
        else:
            self.law = Feedforward(p, p.sample_time)
        if voltage != self.law.voltage:
            self.law.follow(voltage)

    # --- temperature --------------------------------------------------------------------------------

    def _on_temperature(self, degc: float, instant: float) -> None:
        if not self._is_on_grid():
            self.thermometer.hear(degc, time.monotonic())
        else:
            place = round(instant / self.parameters.temperature_period)
            if self._temperatures and place <= max(self._temperatures):
                self._temperatures.clear()  # a new run, or once more from the present instant on
            self._temperatures[place] = degc
            self.go_on()

    def _is_on_grid(self) -> bool:
        p = self.parameters
        return p.temperature_lockstep and p.mode == "lockstep"

    def _on_deflection(self, sample: Sample) -> None:
        if is_physical(sample.value, LARGEST_DEFLECTION):
            self._deflection = sample
            self.go_on()

    def prepare(self, sample: Sample) -> str:
        """Take up the temperature of this sample; the deflection that its command answers has to be there, too."""
        p, number = self.parameters, sample.number
        if p.compensator != "sensorless":
            return ""
        adapts = sample.by_controller and bool(p.adaptation.time_constant)
        if adapts and not self._is_read(sample):
            return "its deflection"
        if not p.temperature_lockstep:
            return ""
        place = grid_index(number, p.sample_time, p.temperature_period)
        if place not in self._temperatures:
            return "its temperature"
        if number == 0:
            self.thermometer = Thermometer(p.thermometer, 0.0)
        self.thermometer.hear(self._temperatures[place], number * p.sample_time)
        self._temperatures = {n: t for n, t in self._temperatures.items() if n >= place}
        return ""

    def _is_read(self, sample: Sample) -> bool:
        """Say whether the deflection that a command answers is known."""
        return self._deflection.number == sample.number and not math.isnan(self._deflection.value)

    def _read(self, law: Sensorless, now: float) -> float:
        """Return the temperature (°C), NaN for one that cannot be believed, and say so once."""
        degc = self.thermometer.read(now)
        if not self._settled and not math.isnan(degc):
            law.settle(degc)
            self._settled = True
        if self.thermometer.wrong != self._complained:
            self._complained = self.thermometer.wrong
            if not self._complained:
                self.get_logger().info(f"temperature is back: {degc:g} °C")
            elif not self.thermometer.ends:
                self.get_logger().error(
                    f"{self._complained}; the models go on with {law.body_degc:g} °C"
                )
            self.publish_diagnostics()
        if self.thermometer.ends:
            self.trip(self.thermometer.ends)
        return degc

    # --- samples ------------------------------------------------------------------------------------

    def compute(self, sample: Sample, answer: Sample) -> bool:
        p = self.parameters
        now = time.monotonic()
        is_free = p.mode == "free_running"
        share = min(1.0, (now - self.moved) / p.sample_time) if is_free else 1.0
        if is_free:
            # After standing still as a process: the finger is on its way to rest, and this voltage is not where it is.
            self._look(now)
            if self.guard.is_latched:
                return False
        self.guard.hear(now)
        clipped = self.law.clipped
        finger = self.finger
        if is_free and finger and finger.phase in TAKES_NONE:
            # It leaps to the first voltage that it takes again unless that begins where it is.
            self.law.follow(finger.voltage)
            answer.value = self.law.voltage
            if isinstance(self.law, Sensorless):
                self._expect(sample)
        elif isinstance(self.law, Sensorless):
            instant = sample.number * p.sample_time if self._is_on_grid() else now
            degc = self._read(self.law, instant)
            if self.guard.is_latched:
                return False
            answer.without_temperature = bool(self.thermometer.wrong)
            if is_free and sample.number > self.last.number + 1:
                self.law.pause(sample.number - self.last.number - 1)
            if sample.by_controller:
                deflection = self._deflection.value if self._is_read(sample) else math.nan
                answer.value = self.law.lead(sample.value, degc, share, deflection)
            else:
                answer.value = self.law.step(sample.value, degc, share)
            self._expect(sample)
        else:
            answer.value = self.law.step(sample.value, share)
        self.moved = now
        answer.limited = sample.limited or self.law.clipped > clipped
        return True

    def _expect(self, sample: Sample) -> None:
        """Tell what the next reading is if nobody pushes the tip; before the voltage that leads to it."""
        assert isinstance(self.law, Sensorless)
        expected = Sample(header=sample.header, number=sample.number + 1)
        expected.period = self.parameters.sample_time
        expected.value = self.law.predicted
        self.expectations.publish(expected)

    def report(self) -> tuple[str, dict[str, Any]]:
        wrong, figures = super().report()
        figures |= {"voltage": self.law.voltage, "clipped": self.law.clipped}
        if isinstance(self.law, Sensorless):
            figures |= {
                "temperature": self.thermometer.degc,
                "body temperature": self.law.body_degc,
                "expected deflection": self.law.predicted,
            }
            wrong = wrong or self.thermometer.wrong
            if self.parameters.adaptation.time_constant:
                adapted = self.law.state.adapted
                figures |= {
                    "adapted gain": adapted.gain[0],
                    "adapted offset": adapted.offset[0],
                    "adapted resonance": adapted.ratio[0],
                }
        return wrong, figures

    def reset(self) -> None:
        if self._temperature_input and not self._is_on_grid():
            self.thermometer.read(time.monotonic())
            self.thermometer.check()  # it would move the finger until the fault comes back
        super().reset()
        self.moved = time.monotonic()

    def trip(self, cause: str) -> None:
        super().trip(cause)
        self.watchdog.reset()  # in lock-step too: the voltage goes to rest

    def stop(self) -> None:
        if self._temperature_input:
            self._temperature_input.close()
            self._temperature_input = None
        if self._deflection_input:
            self.destroy_subscription(self._deflection_input)
            self._deflection_input = None
        self.watchdog.cancel()
        self.guard.trip("stopped", time.monotonic())
        while self.guard.phase == RAMPING:
            self._ramp()
            time.sleep(RAMP_PERIOD)
        # The program may end right after this; what was sent last is what the finger is left at.
        self.answers.finish(DELIVERY_TIMEOUT)
        self.guard.reset()

    def _look(self, now: float) -> None:
        """See at `now` (s) whether commands have stayed away."""
        before = self.guard.phase
        self.guard.look(now, 2.0 * self.parameters.sample_time + RAMP_PERIOD, "command")
        if self.guard.phase != before and self.guard.is_latched:
            self.get_logger().error(
                f"{self.guard.cause}: voltage goes to rest and stays there; {self.way_on()}"
            )
            self._tell()

    def _watch(self) -> None:
        self._look(time.monotonic())
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
        # In lock-step the answer before it may be lost, and the way to rest is no answer: it takes milliseconds, not
        # samples. So it has the number of the sample before, which nobody waits for.
        number = self.last.number if p.mode == "free_running" else max(0, self.sequence.next - 2)
        voltage = Sample(number=number, value=value, period=p.sample_time)
        voltage.header.stamp = self.last.header.stamp
        if p.mode == "free_running":
            voltage.header.stamp = base.system_time()
        self.law.follow(value)
        self.answers.publish(voltage)
        self.last = voltage


def main() -> int:
    return base.run(FeedforwardNode)
