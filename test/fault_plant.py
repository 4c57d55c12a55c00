# SPDX-License-Identifier: Apache-2.0
"""The cantilever node with a witness at the plant, who writes 'VIOLATED' into its log for what no finger may see."""

import math
import sys

from piezo_control.nodes import base
from piezo_control.safety import VoltageParameters
from piezo_sim.nodes.cantilever import CantileverNode
from piezo_sim.plant.cantilever import Cantilever

STANDS = VoltageParameters()
LED = 50.0  # V/s: slew limit of the feedforward that runs free
LATE = 0.05  # s that a busy machine adds
LEAP = "leap"  # a second publisher of voltages may ask for one
FARTHEST = 66e-6  # m: where a step over the whole reach of 44 µm overshoots to, undamped, from its end at 22 µm


class Witness(Cantilever):
    """A cantilever that looks at every sample: limits, slew in time, finite numbers.

    The amplifier keeps the slew in time, whoever asks. The voltage comes from a feedforward, limited to
    `STANDS.slew_limit`: in lock-step in each sample; running free, messages may come in a burst, and what it asks for
    may be no further away than it could lead the voltage while a message or a `state` was on its way.
    """

    def __init__(self, parameters):
        super().__init__(parameters)
        rounding = parameters.sample_time * (1 + 1e-9)
        self.largest_step = parameters.amplifier.slew_limit * rounding
        self.led_step = math.inf  # running free, what is asked for is looked at when it comes
        if parameters.mode == "lockstep":
            self.led_step = STANDS.slew_limit * rounding

    def advance(self, voltage, temperature_degc, tip_force=0.0):
        before = self.voltage
        super().advance(voltage, temperature_degc, tip_force)
        now = self.voltage
        if not STANDS.voltage_low <= now <= STANDS.voltage_high:
            self.say(f"{now} V")
        if not abs(now - before) <= self.largest_step:
            self.say(f"{before} V to {now} V in one sample, allowed are {self.largest_step} V")
        elif not abs(now - before) <= self.led_step:
            self.say(f"a {LEAP} of {before} V to {now} V in one sample, {self.led_step} V are led")
        if not (math.isfinite(self.deflection) and abs(self.deflection) <= FARTHEST):
            self.say(f"deflection {self.deflection} m")

    def say(self, text):
        print(f"VIOLATED at sample {self.samples}: {text}", file=sys.stderr, flush=True)


class WitnessedNode(CantileverNode):
    def _take(self, voltage):
        super()._take(voltage)
        leap = abs(voltage.value - self.plant.voltage)
        late = self.parameters.age_limit + self.parameters.state_period + LATE
        if self.parameters.mode == "free_running" and not leap <= LED * late:
            self.plant.say(f"a {LEAP} of {leap} V to {voltage.value} V was asked for")

    def _reset(self):
        super()._reset()
        self.plant = Witness(self.parameters)


if __name__ == "__main__":
    sys.exit(base.run(WitnessedNode))
