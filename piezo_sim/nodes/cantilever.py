# SPDX-License-Identifier: Apache-2.0
"""The simulated piezocantilever with its amplifier and sensor: the block H_s·D(s) + b of the paper.

in:  voltage (Sample, V), temperature (sensor_msgs/Temperature, °C),
     tip_force (Sample, N: one value), tip_force_profile (Profile, N), tip_force_waveform (Waveform, N),
     fault (Fault: of the blocks of its loop)
out: deflection (Sample, m), clock (rosgraph_msgs/Clock), state (FingerState); with an object in front of the tip
     (`contact.stiffness`), contact_force (Sample, N): how it pushes the tip back, which no real finger knows

In lock-step it is the master of time: it publishes deflection k, moves on when voltage k is there, and
asks again for what is late by publishing the same sample and the same clock once more. An answer that
never comes ends the run with 0 V and an error that says which topic fell silent. Running free it moves
on with the wall clock, holds the newest voltage and ramps to 0 V when that gets old. A fault that a block
of the loop has latched is one of the finger: it goes to rest, and its `state` says which and why.
"""

from __future__ import annotations

import math
from collections import deque
from time import monotonic
from typing import Any

import numpy as np
from rosgraph_msgs.msg import Clock

from piezo_control.nodes import base
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.block import stray, too_old, wrong_time
from piezo_control.nodes.phases import PHASES
from piezo_control.nodes.profile_input import ProfileInput
from piezo_control.nodes.qos import DELIVERY_TIMEOUT, FAULTS, LATCHED, SAMPLE
from piezo_control.nodes.sample_output import SampleOutput
from piezo_control.nodes.sole_input import SoleInput
from piezo_control.nodes.temperature_input import TemperatureInput
from piezo_control.safety import (
    FAULT,
    HOLDING,
    LARGEST_DEFLECTION,
    LARGEST_FORCE,
    LARGEST_VOLTAGE,
    NORMAL,
    RAMPING,
    Guard,
    Limits,
    is_physical,
    limits,
)
from piezo_control.sequence import grid_index
from piezo_gripper_msgs.msg import Fault, FingerState, Sample
from piezo_sim.nodes.parameters import CantileverNodeParameters
from piezo_sim.plant.cantilever import Cantilever

JITTER_WINDOW = 1000  # periods: to sort more takes longer than a period
RETRY_PERIOD = 0.1  # s
SAID = (FingerState.RUNNING, FingerState.FINISHED)
PHASE_OF = {HOLDING: FingerState.HOLDING, RAMPING: FingerState.RAMPING, FAULT: FingerState.FAULT}


class CantileverNode(FingerNode):
    NAME = "cantilever"
    PARAMETERS = CantileverNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.deflections = SampleOutput(self, "deflection")
        self.contact_forces = SampleOutput(self, "contact_force")
        self.clocks = self.create_publisher(Clock, "clock", SAMPLE)
        self.states = self.create_publisher(FingerState, "state", LATCHED)
        self.voltages = SoleInput(self, "voltage", self._on_voltage, SAMPLE, self._look_around)
        TemperatureInput(self, self._on_temperature)
        self.create_subscription(Fault, "fault", self._on_fault, FAULTS)
        self.faults: dict[str, str] = {}
        self.tip_force = ProfileInput(self, "tip_force", self.parameters.sample_time, LARGEST_FORCE)
        self.follows = False
        self.followed = ProfileInput(
            self,
            "reference_followed",
            self.parameters.sample_time,
            LARGEST_DEFLECTION,
            self._on_followed,
        )
        self.teller = self.create_steady_timer(self.parameters.state_period, self._publish_state)
        self.watchdog = self.create_steady_timer(RETRY_PERIOD, self._watch, autostart=False)
        self.tick = self.create_steady_timer(1.0, self._tick, autostart=False)
        self.phase = FingerState.IDLE
        self.text = ""
        self.ticks: deque[float] = deque(maxlen=JITTER_WINDOW)
        self._reset()

    def _reset(self) -> None:
        p = self.parameters
        self.plant = Cantilever(p)
        self.guard = Guard(p.hold_time)
        self.limited = 0
        self.without_temperature = False
        self.tip_force.restart(p.sample_time)
        self.followed.restart(p.sample_time)
        self.number = 0
        self.asked_again = 0
        self.sample = Sample()
        self.pending_voltage: float | None = None
        self.temperature = p.ambient_temperature_degc
        self.temperatures: dict[int, float] = {}
        self.grid = -1
        self.samples_per_clock = max(1, round(p.clock_period / p.sample_time))
        self.clocked = 0.0

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"reply_timeout", "hold_time", "ramp"}

    def start(self) -> None:
        self._reset()
        self.teller.timer_period_ns = round(self.parameters.state_period * 1e9)
        self._enter(FingerState.WAITING)
        self.begun = monotonic()
        self.silence = 0.0
        if wrong := self._wrong():
            self._fault(wrong)
        if self.parameters.mode == "lockstep":
            if self.guard.is_latched:
                return
            self.watched = -1
            self.watchdog.reset()
            self._measure()
        else:
            self.ticks.clear()
            self.tick.timer_period_ns = round(self.parameters.sample_time * 1e9)
            self.tick.reset()

    def stop(self) -> None:
        if self.phase in (FingerState.FINISHED, FingerState.FAULT):
            self.tick.cancel()
            self._enter(FingerState.IDLE)
        else:
            self._end(FingerState.IDLE)
        self.guard.reset()
        self.deflections.finish(DELIVERY_TIMEOUT)

    def apply(self) -> None:
        self.guard.hold_time = self.parameters.hold_time

    def reset(self) -> None:
        """Leave a fault: a new run in lock-step; running free, voltages count again."""
        if not self.guard.is_latched:
            return
        # Who is gone, or never was, resets nothing any more.
        present = self.get_node_names_and_namespaces()
        own = self.get_namespace()
        self.faults = {name: text for name, text in self.faults.items() if (name, own) in present}
        if self.parameters.mode == "lockstep":
            self.start()
        else:
            self.guard.reset()
            self.pending_voltage = None
            self._look_around()
            self._follow_guard()  # at once, so that `state` never tells a fault that is over
        if self.guard.is_latched:
            raise ValueError(self.text)

    def report(self) -> tuple[str, dict[str, Any]]:
        figures = {
            "samples": self.number,
            "asked again": self.asked_again,
            "clipped": self._clipped(),
            **base.told(self.guard),
        }
        is_wrong = self.phase in (FingerState.FAULT, FingerState.HOLDING, FingerState.RAMPING)
        return self.text if is_wrong else "", figures

    def _clipped(self) -> int:
        return self.limited + self.plant.clipped

    def _limits(self) -> Limits:
        return limits(self.parameters.amplifier, self.parameters.ramp)

    def _on_fault(self, fault: Fault) -> None:
        """Take note of what a block of the loop has latched."""
        self.faults.pop(fault.node, None)
        if fault.text:
            self.faults[fault.node] = " ".join(fault.text.split())
            self._look_around()

    def _look_around(self) -> None:
        """Latch what is wrong with the loop around this node."""
        if self.active and self.phase != FingerState.FINISHED and (wrong := self._wrong()):
            self._fault(wrong)

    def _wrong(self) -> str:
        """Say what is wrong with the loop around this node; empty: nothing."""
        blocks = "; ".join(f"{node}: {text}" for node, text in self.faults.items())
        return self.voltages.wrong() or blocks

    def _publish(self, sample: Sample) -> None:
        """Publish a deflection and, where there is an object, how that pushes the tip back."""
        self.deflections.publish(sample)
        if self.parameters.contact.stiffness > 0.0 and sample.number > 0:
            force = Sample(header=sample.header, number=sample.number, period=sample.period)
            force.value = self.tip_force[sample.number - 1] - self.plant.tip_force
            self.contact_forces.publish(force)

    # --- lock-step ----------------------------------------------------------------------------------

    def _measure(self) -> None:
        """Take deflection `self.number` and ask for its voltage."""
        sample = Sample(number=self.number, period=self.parameters.sample_time)
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
        self._publish(sample)

    def _ask(self) -> None:
        """Publish clock and deflection, once more where that was done, if they have their readers."""
        if self.deflections.readers() >= self.parameters.subscribers:
            self.clocks.publish(Clock(clock=self.sample.header.stamp))
            self.deflections.publish(self.sample)

    def _on_voltage(self, voltage: Sample) -> None:
        if not self.active or self.phase in (FingerState.FINISHED, FingerState.FAULT):
            return
        if self.parameters.mode == "free_running":
            self._hold(voltage)
        elif voltage.number == self.number and self.pending_voltage is None:
            if wrong := wrong_time(voltage, "voltage", self.parameters, self.NAME):
                self._fault(wrong + self.voltages.others())
            elif not is_physical(voltage.value, LARGEST_VOLTAGE):
                self._fault(
                    f"'voltage' sample {voltage.number} is {voltage.value} V, must be finite and within "
                    f"±{LARGEST_VOLTAGE:g} V{self.voltages.others()}"
                )
            else:
                self._take(voltage)
                self._advance()
        elif not self.number - 2 <= voltage.number <= self.number:
            # An answer may come twice, and a way to rest has the number of an older sample.
            words = stray(voltage, "voltage", self.number) + self.voltages.others()
            self.get_logger().error(words, throttle_duration_sec=1.0)

    def _take(self, voltage: Sample) -> None:
        self.limited += voltage.limited
        self.without_temperature = voltage.without_temperature
        self.pending_voltage = voltage.value

    def _on_temperature(self, degc: float, instant: float) -> None:
        if self.parameters.mode == "free_running" or not self.parameters.temperature_lockstep:
            self.temperature = degc
        elif self.active:
            self.temperatures[round(instant / self.parameters.temperature_period)] = degc
            self._advance()

    def _on_followed(self) -> None:
        self.follows = True

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
            self.silence = 0.0
            return
        self.silence += RETRY_PERIOD  # counted: one that stood still has not heard what is there
        if self.phase == FingerState.RUNNING and self.silence > self.parameters.reply_timeout:
            words = f"no answer to sample {self.number} for {self.silence:.1f} s"
            self._fault(f"{words}: {self._missing()}")
            return
        if self.phase == FingerState.WAITING:
            self.text = f"waiting for sample 0: {self._missing()}"
            self.say(self.text)
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
                missed = self.missed_networks()
                return (
                    f"node '{node}' is gone: nobody publishes '{self.resolve_topic_name(topic)}'"
                    f"{missed and f'; {missed}'}"
                )
        silent = " or ".join(f"'{self.resolve_topic_name(topic)}'" for topic in topics)
        return f"{silent} is published but silent; is the node active?"

    # --- running free -------------------------------------------------------------------------------

    def _hold(self, voltage: Sample) -> None:
        """Take a voltage that holds until the next one comes, unless a fault is latched."""
        now = monotonic()
        if self.guard.is_latched:
            return
        if wrong := wrong_time(voltage, "voltage", self.parameters, self.NAME):
            self._fault(wrong + self.voltages.others())
        elif not is_physical(voltage.value, LARGEST_VOLTAGE):
            self.get_logger().error(
                f"'voltage' is {voltage.value} V, must be finite and within ±{LARGEST_VOLTAGE:g} V; ignored"
                f"{self.voltages.others()}",
                throttle_duration_sec=1.0,
            )
        elif old := too_old(voltage, "voltage", self.parameters.age_limit):
            self.get_logger().error(old, throttle_duration_sec=1.0)
        else:
            self._take(voltage)
            self.guard.hear(now)

    def _tick(self) -> None:
        """Move on by the samples whose time has passed on the wall, then measure and publish the newest."""
        p = self.parameters
        now = monotonic()
        self.ticks.append(now)
        was_latched = self.guard.is_latched
        self.guard.look(now, 2.0 * p.sample_time + RETRY_PERIOD * p.hold_time, "voltage")
        if self.guard.is_latched and not was_latched:
            self.get_logger().error(
                f"{self.guard.cause}: voltage goes to rest and stays there; {self.way_on()}"
            )
        due = int((now - self.begun) / p.sample_time) + 1
        if p.samples:
            due = min(due, p.samples)
        if due == self.number:
            return  # the tick before this one was late: no sample's time has passed since
        rest = self._limits()
        for number in range(self.number, due):
            demand = self.plant.voltage if self.pending_voltage is None else self.pending_voltage
            if self.guard.is_latched:
                demand = self.guard.voltage(rest, self.plant.voltage, p.sample_time)
                self.pending_voltage = None
            self.plant.advance(demand, self.temperature, self.tip_force[number])
        self.number = due
        sample = Sample(number=self.number, value=self.plant.measure(), period=p.sample_time)
        sample.header.stamp = base.wall_time(now)
        self.sample = sample
        self._publish(sample)
        if now - self.clocked >= p.clock_period:
            self.clocked = now
            self.clocks.publish(Clock(clock=sample.header.stamp))
        self._follow_guard()
        if self.number == p.samples:
            self._end(FingerState.FINISHED)

    def _follow_guard(self) -> None:
        """Say in `state` what the guard does."""
        if self.guard.phase == NORMAL:
            is_waiting = self.pending_voltage is None
            phase = FingerState.WAITING if is_waiting else FingerState.RUNNING
            text = f"waiting for '{self.resolve_topic_name('voltage')}'" if is_waiting else ""
        else:
            phase, text = PHASE_OF[self.guard.phase], self.guard.cause
        self.text = text
        if phase != self.phase:
            self._enter(phase, text)

    # --- ends ---------------------------------------------------------------------------------------

    def _fault(self, text: str) -> None:
        was_latched = self.guard.is_latched
        self.guard.trip(text, monotonic())
        if was_latched:
            return
        if self.parameters.mode == "free_running":
            self.get_logger().error(
                f"{text}; voltage goes to rest and stays there; {self.way_on()}"
            )
            return
        self.get_logger().error(f"{text}; voltage ramped to rest; {self.way_on()} with a new run")
        self._end(FingerState.FAULT, text)

    def _end(self, phase: int, text: str = "") -> None:
        """Ramp the finger to rest and say how the run ended."""
        self.watchdog.cancel()
        self.tick.cancel()
        ending = self.guard
        if not ending.is_latched:
            ending = Guard(self.parameters.hold_time)
            ending.trip(text, monotonic())
        h, within, voltage = self.parameters.sample_time, self._limits(), self.plant.voltage
        while ending.phase == RAMPING:
            voltage = ending.voltage(within, voltage, h)
            self.plant.advance(voltage, self.temperature, 0.0)
        self.sample.value = self.plant.measure()
        self._enter(phase, text)

    def _enter(self, phase: int, text: str = "") -> None:
        was_held = self.phase == FingerState.HOLDING
        self.phase = phase
        self.text = text
        # A busy machine holds now and then for a few samples, a hundred times a minute, which `state` tells.
        if phase in SAID and not was_held or phase == FingerState.WAITING and text:
            self.say(f"{PHASES[phase]}, at sample {self.number}" if phase in SAID else text)
        self._publish_state()

    def _publish_state(self) -> None:
        state = FingerState(phase=self.phase, samples=self.number, text=self.text)
        state.period = self.parameters.sample_time
        if self.without_temperature and not self.text:
            state.text = "'voltage' is by models whose temperature is missing or frozen"
        state.since = base.wall_time(self.guard.since)
        state.times = self.guard.times
        state.header.stamp = self.sample.header.stamp
        state.reference = self.followed[self.number] if self.follows else math.nan
        state.max_force = self.followed.max_force
        state.deflection = self.sample.value
        state.voltage = self.plant.voltage
        state.tip_force = self.plant.tip_force
        state.temperature = self.temperature
        state.clipped = self._clipped()
        state.asked_again = self.asked_again
        if len(self.ticks) > 1:
            late = np.abs(np.diff(self.ticks) - self.parameters.sample_time)
            state.jitter = float(np.quantile(late, 0.999))
        self.states.publish(state)


def main() -> int:
    return base.run(CantileverNode)
