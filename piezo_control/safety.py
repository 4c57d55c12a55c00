# SPDX-License-Identifier: Apache-2.0
"""What keeps a finger whole: limits of the voltage in time, hold, ramp to rest, faults that stay.

One law for every mode and every place that moves a voltage. The voltage stays within its limits and changes
by no more than the slew limit times the time that has passed. An input that stays away is bridged by holding
the voltage for `hold_time`; then, as at any other fault, the voltage goes to rest, at `rest_voltage`,
and stays there until somebody resets the fault. The cause, when it was seen first and how often are
kept for whoever asks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import ParameterError, parameter

RAMP_PERIOD = 1e-3  # s between two voltages of a ramp

# Beyond these no finger of this kind goes, so a value is a mistake: micrometres given as metres, a wild number.
LARGEST_DEFLECTION = 1e-3  # m
LARGEST_VOLTAGE = 1e3  # V
LARGEST_FORCE = 10.0  # N
LOWEST_DEGC, HIGHEST_DEGC = -100.0, 300.0


@dataclass(frozen=True)
class SafetyParameters:
    """How a finger is left alone."""

    hold_time: float = parameter(
        0.1, "how long the voltage is held without an input before it goes to rest", unit="s",
        low=1e-3, high=60.0,
    )  # fmt: skip
    ramp: float = parameter(
        1e4, "slope of the way to rest; the slew limit holds too", unit="V/s", low=1.0, high=1e6
    )


@dataclass(frozen=True)
class VoltageParameters:
    """What voltages the actuator stands."""

    voltage_low: float = parameter(
        -40.0, "lowest voltage", unit="V", low=-LARGEST_VOLTAGE, high=LARGEST_VOLTAGE
    )
    voltage_high: float = parameter(
        40.0, "highest voltage", unit="V", low=-LARGEST_VOLTAGE, high=LARGEST_VOLTAGE
    )
    slew_limit: float = parameter(
        # The fastest controller takes 1.4 V a sample of 0.1 ms for 20 µm, so 2.8 V for the whole stroke.
        4e4, "largest rate of the voltage", unit="V/s", low=1e-3, high=1e6,
    )  # fmt: skip
    rest_voltage: float = parameter(
        0.0, "where the finger is left alone, such as the middle of a unipolar actuator; 0: the voltage nearest "
        "to 0 V within the limits", unit="V", low=-LARGEST_VOLTAGE, high=LARGEST_VOLTAGE,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if not self.voltage_low < self.voltage_high:
            raise ParameterError(
                f"'voltage_low' is {self.voltage_low!r} V, must be below 'voltage_high' "
                f"({self.voltage_high!r} V)"
            )
        if self.rest_voltage and not self.voltage_low <= self.rest_voltage <= self.voltage_high:
            raise ParameterError(
                f"'rest_voltage' is {self.rest_voltage!r} V, must be within 'voltage_low' and 'voltage_high': "
                f"[{self.voltage_low:g}, {self.voltage_high:g}] V, or 0 for the one nearest to 0 V"
            )

    @property
    def rest(self) -> float:
        """The voltage (V) at which a finger that is left alone stands."""
        return min(max(self.rest_voltage, self.voltage_low), self.voltage_high)


class Limits(NamedTuple):
    """Limits of a voltage (V) and of its rate (V/s), and where it rests (V)."""

    low: float
    high: float
    slew: float
    ramp: float
    rest: float


def limits(voltage: VoltageParameters, ramp: float) -> Limits:
    """Return the limits; `ramp` (V/s) never exceeds the slew limit."""
    low, high, slew = voltage.voltage_low, voltage.voltage_high, voltage.slew_limit
    return Limits(low, high, slew, min(ramp, slew), voltage.rest)


# Step functions: plain scalars, so that numba can compile them as they are.


def limited(low: float, high: float, change: float, last: float, wanted: float) -> float:
    """Return `wanted` (V) within [low, high] and no further than `change` (V) from `last` (V).

    A `last` outside [low, high], as of limits that are narrower than where the finger was left, is led there by
    `change` at a time: a leap destroys sooner than a voltage that was there before.
    """
    return min(last + change, max(last - change, min(high, max(low, wanted))))


def toward(rest: float, step: float, voltage: float) -> float:
    """Return `voltage` (V) one `step` (V) closer to `rest` (V), or `rest` itself."""
    return rest + math.copysign(max(abs(voltage - rest) - step, 0.0), voltage - rest)


def is_physical(value: float, largest: float) -> bool:
    """Say whether `value` is a finite number within +-`largest`."""
    return -largest <= value <= largest  # false for NaN too


NORMAL, HOLDING, RAMPING, FAULT = range(4)
PHASES = ("normal", "holding", "ramping", "fault")


class Guard:
    """The state machine of one voltage: normal, holding, ramping, fault latched until reset.

    Times are in s on a clock that never stands still or jumps, such as ``time.monotonic``.

    Attributes
    ----------
    phase : int
        NORMAL, HOLDING (an input is late), RAMPING (on the way to rest) or FAULT (at rest, latched).
    cause, since, times
        Why it left NORMAL, when that was seen first, and how often since the last reset.
    """

    def __init__(self, hold_time: float) -> None:
        self.hold_time = hold_time
        self.reset()

    def reset(self) -> None:
        """Forget the fault; nothing is late before the first input."""
        self.phase = NORMAL
        self.cause = ""
        self.since = math.nan
        self.times = 0
        self.heard = math.inf

    @property
    def is_latched(self) -> bool:
        """Whether inputs are ignored until the next reset."""
        return self.phase in (RAMPING, FAULT)

    def hear(self, now: float) -> None:
        """Take note of an input: holding is over, a latched fault is not."""
        if not self.is_latched:
            self.heard = now
            self.phase = NORMAL
            self.cause = ""
            self.since = math.nan

    def trip(self, cause: str, now: float, at_rest: bool = False) -> None:
        """Latch a fault, `at_rest` where there is no voltage to lead there; the first cause is kept."""
        self.times += 1
        if not self.is_latched:
            self.phase = FAULT if at_rest else RAMPING
            self.cause = cause
            self.since = now

    def look(self, now: float, late: float, missing: str) -> None:
        """See whether the input called `missing` is late (s) or has been away for the hold time."""
        silence = now - self.heard
        if self.is_latched or silence <= late:
            return
        if silence > self.hold_time:
            self.trip(f"no {missing} for {self.hold_time:g} s", now)
        elif self.phase == NORMAL:
            self.phase = HOLDING
            self.cause = f"no {missing}: voltage held"
            self.since = now

    def voltage(self, limits: Limits, last: float, elapsed: float) -> float:
        """Return the voltage (V) `elapsed` s after `last` (V), without an input."""
        if not self.is_latched:
            return last
        voltage = toward(limits.rest, limits.ramp * elapsed, last)
        if voltage == limits.rest:
            self.phase = FAULT
        return voltage


class RateWatch:
    """Whether a loop runs at the sample time that its controller was made for.

    The mean period of the last `WINDOW` samples is compared with `sample_time` (s).
    """

    WINDOW = 20
    TOLERANCE = 0.2  # of the sample time

    def __init__(self, sample_time: float) -> None:
        self.sample_time = sample_time
        self._instants: list[float] = []

    def see(self, now: float) -> float:
        """Take note of a sample at `now` (s); return the mean period (s), 0 as long as it is unknown."""
        self._instants.append(now)
        if len(self._instants) <= self.WINDOW:
            return 0.0
        return (now - self._instants.pop(0)) / self.WINDOW

    def is_right(self, period: float) -> bool:
        """Say whether a mean period (s) is within the tolerance."""
        return abs(period - self.sample_time) <= self.TOLERANCE * self.sample_time
