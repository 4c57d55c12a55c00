# SPDX-License-Identifier: Apache-2.0
"""The loop in real time: K and H_s⁻¹ between a deflection sensor and a voltage amplifier.

in:  reference (Sample, m: one value), reference_profile (Profile, m over s since sample 0),
     reference_waveform (Waveform, m), temperature (sensor_msgs/Temperature, °C) with `force_control`
out: samples (SampleBlock: every sample), deflection (Sample, m), command (Sample, m), voltage (Sample, V): one
     in a hundred or so, state (FingerState), reference_followed_profile (Profile, m), reference_followed_waveform
     (Waveform, m), push (Sample, N) with `force_control`: the force of an object

One compiled loop in a thread under the real-time scheduler, at the sample time of its controller; ROS
runs beside it and can be late without the finger noticing. What the certificate of the controller does not
cover ends with the voltage at rest and a fault that stays until `~/reset`: a silent, old, frozen or saturated
sensor, a deflection that the model cannot explain, an oscillation, late or missed periods, a lost device.
With `force_control` the loop pushes with no more than the profile's `max_force` and its own `touch.force_limit`
(:mod:`piezo_control.touch`).
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from std_msgs.msg import Header

from piezo_control.feedback import FeedbackParameters, controller_file, is_limited, successor
from piezo_control.nodes import base
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.block import command_range
from piezo_control.nodes.parameters import (
    ServoNodeParameters,
    check_delay,
    check_force,
    check_sensor,
    read_feedforward,
)
from piezo_control.nodes.phases import PHASES
from piezo_control.nodes.profile_input import ProfileInput
from piezo_control.nodes.qos import LATCHED, SAMPLE
from piezo_control.nodes.temperature_input import TemperatureInput
from piezo_control.parameters import ParameterError
from piezo_control.safety import (
    FAULT,
    HOLDING,
    LARGEST_DEFLECTION,
    NORMAL,
    RAMPING,
    VoltageParameters,
)
from piezo_control.servo.clock import lateness_quantile
from piezo_control.servo.driver import DriverError, open_driver
from piezo_control.servo.law import feeling_of, objections
from piezo_control.servo.loop import Samples, Servo
from piezo_control.thermometer import Thermometer
from piezo_gripper_msgs.msg import FingerState, Sample, SampleBlock

TARGET_TIME = 0.1  # s that the error stays small before a finger is on target
STEADY = 0.2  # s that a phase lasts before the log says it
PHASE_OF = {
    NORMAL: FingerState.RUNNING,
    HOLDING: FingerState.HOLDING,
    RAMPING: FingerState.RAMPING,
    FAULT: FingerState.FAULT,
}
LATCHED_PHASES = (FingerState.RAMPING, FingerState.FAULT)


class ServoNode(FingerNode):
    NAME = "servo"
    PARAMETERS = ServoNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.servo: Servo | None = None
        self.blocks = self.create_publisher(SampleBlock, "samples", SAMPLE)
        self.singles = {
            name: self.create_publisher(Sample, name, SAMPLE)
            for name in ("deflection", "command", "voltage")
        }
        self.states = self.create_publisher(FingerState, "state", LATCHED)
        self.thermometer = Thermometer(self.parameters.thermometer, time.monotonic())
        self._temperature_input: TemperatureInput | None = None
        self.reference = ProfileInput(
            self, "reference", 1.0, LARGEST_DEFLECTION, self._refer, says=True
        )
        self.drain = self.create_steady_timer(
            self.parameters.block_period, self._drain, autostart=False
        )
        self.teller = self.create_steady_timer(self.parameters.state_period, self._tell)
        self.phase = FingerState.IDLE
        self._entered = time.monotonic()
        self._last: Samples | None = None
        self._voltage, self._left = 0.0, ""  # of the loop before: V, and why that is not at rest
        self._rested = "", "", math.nan  # driver, its options, and what its card puts out at rest
        self._held = 0  # samples whose command was at an end of its range
        self._told = 0.0
        self._errors: list[tuple[float, float]] = []

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names - {"controller_file", "preview_band", "tolerance", "sample_period"}

    def check(self, parameters: ServoNodeParameters) -> None:
        before = self.parameters
        names = "controller_file", "preview_band"
        if self.active and all(getattr(before, n) == getattr(parameters, n) for n in names):
            return
        controller = self._controller(parameters)
        check_delay(controller, parameters)
        if not self.servo:
            return
        if parameters.force_control:
            raise ParameterError(
                "'controller_file': with 'force_control' no controller runs, which could change"
            )
        if controller.sample_time != self.servo.sample_time:
            raise ParameterError(
                f"'controller_file' is '{parameters.controller_file}', made for "
                f"{controller.sample_time:g} s, the loop runs at {self.servo.sample_time:g} s: deactivate "
                f"'{self.NAME}' first"
            )
        check_sensor(controller, self._feedforward, parameters)
        self.servo.check_controller(controller)

    def _controller(self, parameters: ServoNodeParameters) -> FeedbackParameters:
        present = self.servo.feedback if self.servo else FeedbackParameters()
        controller = successor(parameters.controller_file, present)
        band = parameters.preview_band or controller.preview_band
        return replace(controller, preview_band=band)

    def _object(self, controller: FeedbackParameters) -> None:
        """Say what the certificate of a controller that is to run does not cover."""
        finger = self._feedforward
        self._objections = (
            []
            if self.parameters.force_control
            else objections(controller, finger, finger.dynamics.denominator)
        )
        for objection in self._objections:
            self.get_logger().warning(
                f"controller '{controller.name}' ({self.parameters.controller_file}): {objection}: nothing says "
                "that the loop is stable with this finger"
            )

    def start(self) -> None:
        if self.servo:
            raise ParameterError(
                f"the loop of before still has the card: {self._wrong(self.servo)}"
            )
        p = self.parameters
        controller = self._controller(p)
        check_delay(controller, p)
        feedforward = self._feedforward = read_feedforward(p)
        check_sensor(controller, feedforward, p)
        self._object(controller)
        feeling = None
        if p.force_control:
            check_force(p, feedforward, controller.sample_time)
            feeling = feeling_of(p.touch, feedforward, controller, p.thermometer.degc_at_start)
        *card, stands_at = self._rested
        is_same = card == [p.driver, p.driver_options]
        was_left = self._left if is_same else ""
        if was_left or not is_same:
            stands_at = math.nan
        try:
            driver = open_driver(p.driver, p.driver_options, controller.sample_time)
        except DriverError as error:
            raise ValueError(str(error)) from None
        try:
            servo = Servo(
                driver, p, controller, feedforward, p.priority, p.cpu, p.spin, feeling, stands_at
            )
            if was_left and math.isnan(servo.begins_at):
                raise ParameterError(
                    f"{was_left}; the driver does not say where it is now: bring the card to rest, then reset this"
                )
        except (ParameterError, DriverError) as error:
            driver.close()
            raise ValueError(str(error)) from None
        self.servo, self._left = servo, ""
        self._say_limits(feedforward)
        self._say_where_it_begins(self.servo.begins_at, feedforward.rest)
        if p.force_control:
            self.thermometer = Thermometer(p.thermometer, time.monotonic())
            self._temperature_input = TemperatureInput(self, self._on_temperature)
            # A finger that has this topic is taken for one that feels.
            self.singles["push"] = self.create_publisher(Sample, "push", SAMPLE)
        self.reference.restart(controller.sample_time)
        self._refer()
        self._told = time.monotonic()
        self._held = 0
        self._since = math.nan
        self._rates = [(self._told, 0)]
        self._errors.clear()
        self._complained = False
        self._say_origins()
        self.get_logger().info("the loop is compiled, if it was not before: half a minute or so")
        self.servo.start()
        # There the loop leaves it, or the hardware, which goes to rest by itself when voltages stop coming.
        self._rested = p.driver, p.driver_options, p.output(feedforward.rest)
        # Sample 0 on the clock on the wall; the monotonic clock does not follow its corrections.
        self._to_wall = time.time() - time.monotonic()
        self.teller.timer_period_ns = round(p.state_period * 1e9)
        self.drain.timer_period_ns = round(p.block_period * 1e9)
        self.drain.reset()
        law = "force control" if p.force_control else f"controller '{controller.name}'"
        self.get_logger().info(
            f"loop at {1.0 / controller.sample_time:g} Hz on driver '{p.driver}' with {law}"
        )
        self._follow_phase()

    def _say_limits(self, voltage: VoltageParameters) -> None:
        """Say what the card is going to put out, which nobody but people can compare with a data sheet."""
        p = self.parameters
        words = f"the finger gets {p.span(voltage)}"
        if p.driver == "simulated" or p.feedforward_file:
            self.get_logger().info(words)
        else:
            self.get_logger().warning(
                f"{words}; the limits are those of the paper's finger: what yours stands belongs into a 'feedforward_file'"
            )

    def _say_where_it_begins(self, voltage: float, rest: float) -> None:
        if math.isnan(voltage):
            self.get_logger().info(
                f"the driver does not say what the card puts out: it has to be at rest, {rest:g} V"
            )
        elif voltage != rest:
            self.get_logger().info(f"the finger is at {voltage:g} V: led to rest, {rest:g} V")

    def _say_origins(self) -> None:
        p = self.parameters
        is_led = p.controller_file != "none" and not p.force_control
        self.comes_from("controller", controller_file(p.controller_file) if is_led else "")
        self.comes_from("feedforward", p.feedforward_file)

    def stop(self) -> None:
        self.drain.cancel()
        if self._temperature_input:
            self._temperature_input.close()
            self._temperature_input = None
            self.destroy_publisher(self.singles.pop("push"))
        self.phase = FingerState.IDLE
        self._let_go()
        self._publish_state()

    def _let_go(self) -> None:
        """End the loop; say where its voltage is if that is not at rest."""
        if not self.servo:
            return
        self._left = self.servo.stop()
        if self._left:
            self.get_logger().error(self._left)
        self._publish_samples()
        self._voltage = self.servo.voltage
        if not self.servo.is_running:
            self.servo = None

    def apply(self) -> None:
        """Let the controller of a changed `controller_file` take over."""
        if self.servo:
            controller = self._controller(self.parameters)
            if controller != self.servo.feedback:
                self.servo.change_controller(controller)
                self._object(controller)
                self.get_logger().info(f"controller '{controller.name}' takes over")
                self._say_origins()

    def reset(self) -> None:
        if self._temperature_input:
            self.thermometer.check()  # it would move the finger until the fault comes back
        if self.servo:
            self.servo.reset()
        else:
            self._left = ""  # somebody has looked after the card

    def report(self) -> tuple[str, dict[str, Any]]:
        s = self.servo
        if s is None:
            return self._left, {}
        lateness = s.lateness
        figures: dict[str, Any] = {
            "controller": s.feedback.name,
            "certified": s.feedback.certified,
            **command_range(s.feedback),
            "not covered": "; ".join(self._objections),
            "sample": s.number,
            "rate (Hz)": f"{self._rate():.1f}",
            "missed periods": s.missed,
            "samples not published": s.lost,
            "clipped": s.clipped + self._held,
            "faults": s.faults,
        }
        for share in (0.5, 0.9, 0.99, 0.999):
            figures[f"late, {share:.1%} (us)"] = f"{lateness_quantile(lateness, share) * 1e6:.0f}"
        if self.parameters.force_control:
            figures |= {"controller": "force control", "certified": False}
            figures |= {"push": s.push, "temperature": self.thermometer.degc}
        return self._wrong(s), figures

    def _wrong(self, servo: Servo) -> str:
        """Return what is not as it should be, the gravest of it."""
        missing = self.thermometer.wrong if self._temperature_input else ""
        return servo.stuck or servo.cause or servo.complaint or missing

    def _refer(self) -> None:
        if self.servo:
            self.servo.refer(self.reference.signal, self.reference.max_force or math.inf)
            self.reference.say(Header(stamp=base.system_time()))

    def _on_temperature(self, degc: float, _: float) -> None:
        self.thermometer.hear(degc, time.monotonic())

    def _pass_temperature_on(self, servo: Servo) -> None:
        """Tell the loop the temperature, or that there is none to believe, and say that once."""
        complaint = self.thermometer.wrong
        servo.feel(self.thermometer.read(time.monotonic()))
        wrong = self.thermometer.wrong
        if self.thermometer.ends:
            servo.give_up_without_temperature()
        if wrong == complaint:
            return
        if wrong:
            then = "the models go on with the temperature that they have"
            if self.thermometer.ends:
                then = "that ends at rest"
            self.get_logger().error(f"{wrong}; {then}")
        else:
            self.get_logger().info(f"temperature is back: {self.thermometer.degc:g} °C")
        self.publish_diagnostics()

    def _rate(self) -> float:
        """Return how many samples a second were served lately."""
        (begin, served), (end, now_served) = self._rates[0], self._rates[-1]
        return (now_served - served) / (end - begin) if end > begin else 0.0

    def _drain(self) -> None:
        """Keep the loop supplied with references, and say what it does."""
        if self.servo:
            self.servo.look_ahead()
            if self._temperature_input:
                self._pass_temperature_on(self.servo)
            if self.servo.complaint and not self._complained:
                self.get_logger().warning(self.servo.complaint)
                self._complained = True
            self._follow_phase()
            self._publish_samples()

    def _publish_samples(self) -> None:
        """Publish what the loop has written since this was done last."""
        s = self.servo
        assert s is not None
        samples = s.samples()
        if not len(samples):
            return
        self._last = samples
        ends = np.flatnonzero(np.diff(samples.number) != 1) + 1
        for part in np.split(np.arange(len(samples)), ends):
            self.blocks.publish(self._block(samples, part))
        error = np.abs(samples.reference - samples.deflection)
        by_controller = s.feedback.controller != "none" or self.parameters.force_control
        held = is_limited(s.feedback, samples.command, samples.reference, by_controller)
        self._held += int(np.count_nonzero(held))
        self._errors.append(
            (samples.instant[-1], float(np.max(error, where=error >= 0, initial=0)))
        )
        while self._errors[0][0] < samples.instant[-1] - TARGET_TIME:
            self._errors.pop(0)
        if samples.instant[-1] - self._told >= self.parameters.sample_period:
            self._told = samples.instant[-1]
            for name, publisher in self.singles.items():
                message = Sample(number=int(samples.number[-1]), period=s.sample_time)
                message.header.stamp = self._stamp(samples.instant[-1])
                message.value = float(getattr(samples, name)[-1])
                publisher.publish(message)

    def _block(self, samples: Samples, rows: np.ndarray) -> SampleBlock:
        assert self.servo is not None
        block = SampleBlock(number=int(samples.number[rows[0]]), period=self.servo.sample_time)
        block.header.stamp = self._stamp(samples.instant[rows[0]])
        for name in ("reference", "deflection", "command", "voltage", "late"):
            setattr(block, name, getattr(samples, name)[rows])
        return block

    def _stamp(self, instant: float) -> Any:
        nanoseconds = round((instant + self._to_wall) * 1e9)
        stamp = base.system_time()
        stamp.sec, stamp.nanosec = divmod(nanoseconds, 10**9)
        return stamp

    def _follow_phase(self) -> None:
        """Say in `state` and the log what the loop's guard does."""
        s = self.servo
        assert s is not None
        # While the driver does not come back the loop's own phase is that of before.
        stuck = s.stuck
        phase = FingerState.HOLDING if stuck else PHASE_OF[s.phase]
        if phase == FingerState.RAMPING and not s.cause:
            phase = FingerState.WAITING  # until the card, which was elsewhere, is at rest
        now = time.monotonic()
        if phase == self.phase:
            # A busy machine holds now and then for a few samples, which `state` counts and the log need not say.
            if phase not in LATCHED_PHASES and now - self._entered > STEADY:
                self.say(PHASES[phase])
            return
        before, self.phase, self._entered = self.phase, phase, now
        if phase == FingerState.RUNNING:
            self._since = math.nan
        elif math.isnan(self._since):
            self._since = now
        if stuck:
            self.get_logger().error(stuck)
            self.publish_diagnostics()
        elif phase in LATCHED_PHASES and before not in LATCHED_PHASES:
            self.get_logger().error(
                f"{s.cause}; voltage goes to rest and stays there; {self.way_on()}"
            )
            self.publish_diagnostics()
        self._publish_state()

    def _tell(self) -> None:
        if self.active and self.servo:
            self._follow_phase()  # the text is of the phase that is told with it
        self._publish_state()

    def _publish_state(self) -> None:
        # What no thermometer and no model of a contact says is not known.
        if (
            self.servo
            and not self.active
            and self.phase == FingerState.IDLE
            and not self.servo.is_running
        ):
            self._let_go()  # its driver has come back
        state = FingerState(phase=self.phase, temperature=self.thermometer.degc, tip_force=math.nan)
        state.voltage, state.text = self._voltage, self._left
        state.header.stamp = base.system_time()
        if s := self.servo:
            if self.parameters.force_control:
                state.tip_force = s.push
            self._rates.append((time.monotonic(), s.number + 1 - s.missed))
            self._rates = self._rates[-11:]
            state.samples = max(0, s.number + 1)
            state.period = s.sample_time
            state.voltage = s.voltage
            state.clipped = s.clipped + self._held
            state.overruns = s.missed
            state.rate = self._rate()
            state.jitter = lateness_quantile(s.lateness, 0.999)
            state.text = self._wrong(s)
            state.reference = self.reference[state.samples]
            state.max_force = self.reference.max_force
            state.since = base.wall_time(self._since)
            state.times = s.faults
            if self._last:
                state.deflection = float(self._last.deflection[-1])
            worst = max((error for _, error in self._errors), default=np.inf)
            state.on_target = bool(
                self.phase == FingerState.RUNNING and worst <= self.parameters.tolerance
            )
        self.states.publish(state)


def main() -> int:
    return base.run(ServoNode)
