# SPDX-License-Identifier: Apache-2.0
"""Feedforward: the voltage that leads a hysteretic finger to a commanded deflection.

The compensator is the inverse hysteresis of :mod:`piezo_control.hysteresis` or, to compare with, a
static gain (voltage = command / gain). The voltage is clipped and its slew limited here, at the last
place before the plant. Where a limit acts, the plays of the inverse follow the voltage that was
applied, so the inverse is exact again at the first sample that needs no limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.hysteresis import (
    REACH,
    Coefficients,
    HysteresisParameters,
    State,
    coefficients,
    dead_zones,
    inverse_follow,
    inverse_move,
    inverse_voltage,
    invert,
    reachable_range,
    remember_voltage,
)
from piezo_control.parameters import group, parameter
from piezo_control.safety import VoltageParameters, limited


@dataclass(frozen=True)
class FeedforwardParameters(VoltageParameters):
    """Compensator, hysteresis and voltage limits of one finger."""

    compensator: str = parameter(
        "inverse",
        "inverse: analytic inverse of the hysteresis; static_gain: command / static_gain",
        choices=("inverse", "static_gain"),
    )
    static_gain: float = parameter(
        (REACH[1] - REACH[0]) / (VoltageParameters.voltage_high - VoltageParameters.voltage_low),
        "deflection per volt, end to end of the loop",
        unit="m/V",
        low=1e-12,
    )
    hysteresis: HysteresisParameters = group(HysteresisParameters)


class FeedforwardCoefficients(NamedTuple):
    """What :func:`feedforward_step` needs of the parameters."""

    inverting: bool
    static_gain: float
    low: float  # V
    high: float  # V
    step_limit: float  # V per sample
    operator: Coefficients
    inverse: Coefficients


class FeedforwardState(NamedTuple):
    """What :func:`feedforward_step` remembers, changed in place."""

    hysteresis: State
    clipped: list[float]  # number of samples at which a limit acted


def feedforward_step(
    c: FeedforwardCoefficients, s: FeedforwardState, command: float, share: float
) -> float:
    """Return the voltage (V) for the commanded deflection (m) of this sample.

    `share` is the part of a sample time that has passed since the last one: 1 in a loop that keeps time,
    less where samples come in a burst, so that the slew limit holds in time.
    """
    if c.inverting:
        wanted = inverse_voltage(c.inverse, s.hysteresis, command)
    else:
        wanted = command / c.static_gain
    voltage = limited(c.low, c.high, c.step_limit * share, s.hysteresis.voltage[0], wanted)
    if voltage != wanted:
        s.clipped[0] += 1.0
    if not c.inverting:
        remember_voltage(s.hysteresis, voltage)
    elif voltage == wanted:
        inverse_move(c.inverse, s.hysteresis, command, voltage)
    else:
        inverse_follow(c.operator, c.inverse, s.hysteresis, voltage)
    return voltage


def modelled_deflection(c: FeedforwardCoefficients, s: FeedforwardState) -> float:
    """Return the deflection (m) at rest that the model gives to the last voltage and its history."""
    if not c.inverting:
        return c.static_gain * s.hysteresis.voltage[0]
    return dead_zones(c.operator, s.hysteresis.plays[0])  # z'_0 of the inverse is H of the operator


class Feedforward:
    """Feedforward law of one finger at a fixed `sample_time` (s), starting at rest and homed.

    >>> law = Feedforward(FeedforwardParameters(slew_limit=1e6), sample_time=1e-4)
    >>> round(law.step(22e-6), 9)
    40.0
    """

    def __init__(self, parameters: FeedforwardParameters, sample_time: float) -> None:
        self._rest = parameters.rest
        operator = coefficients(parameters.hysteresis, sample_time)
        self.coefficients = FeedforwardCoefficients(
            inverting=parameters.compensator != "static_gain",
            static_gain=parameters.static_gain,
            low=parameters.voltage_low,
            high=parameters.voltage_high,
            step_limit=parameters.slew_limit * sample_time,
            operator=operator,
            inverse=invert(operator),
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything: a homed finger at its rest voltage, no clipped sample."""
        plays = [0.0] * len(self.coefficients.operator.weights)
        self.state = FeedforwardState(State(plays, voltage=[0.0], voltage_step=[0.0]), [0.0])
        if self._rest:
            self.follow(self._rest)

    def step(self, command: float, share: float = 1.0) -> float:
        """Return the voltage (V) for the commanded deflection (m) of this sample.

        `share` (0 to 1) is the part of a sample time that has passed since the last one.

        Raises
        ------
        ValueError
            If the command is not finite; the state is left as it was.
        """
        if not math.isfinite(command):
            raise ValueError(f"command is {command!r}, must be a finite deflection in m")
        return feedforward_step(self.coefficients, self.state, command, share)

    def follow(self, voltage: float) -> None:
        """Take note of a `voltage` (V) applied by somebody else: a ramp to rest, a homing sweep."""
        c = self.coefficients
        inverse_follow(c.operator, c.inverse, self.state.hysteresis, voltage)

    @property
    def voltage(self) -> float:
        """The last voltage (V)."""
        return self.state.hysteresis.voltage[0]

    @property
    def clipped(self) -> int:
        """Number of samples at which the voltage or slew limit acted."""
        return int(self.state.clipped[0])

    @property
    def reachable_range(self) -> tuple[float, float]:
        """Lowest and highest deflection (m) within the voltage limits, from the homed state."""
        c = self.coefficients
        if not c.inverting:
            return c.static_gain * c.low, c.static_gain * c.high
        return reachable_range(c.operator, c.low, c.high)
