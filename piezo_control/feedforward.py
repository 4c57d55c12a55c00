# SPDX-License-Identifier: Apache-2.0
"""Feedforward: the voltage that leads a hysteretic finger to a commanded deflection.

The compensator is the inverse hysteresis of :mod:`piezo_control.hysteresis` or, to compare with, a
static gain (voltage = command / gain). The voltage is clipped and its slew limited here, at the last
place before the plant. Where a limit acts, the plays of the inverse follow the voltage that was
applied, so the inverse is exact again at the first sample that needs no limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.hysteresis import (
    Coefficients,
    HysteresisParameters,
    State,
    coefficients,
    inverse_follow,
    inverse_move,
    inverse_voltage,
    invert,
    reachable_range,
    remember_voltage,
)
from piezo_control.parameters import group, parameter


@dataclass(frozen=True)
class FeedforwardParameters:
    """Compensator, hysteresis and voltage limits of one finger."""

    compensator: str = parameter(
        "inverse",
        "inverse: analytic inverse of the hysteresis; static_gain: command / static_gain",
        choices=("inverse", "static_gain"),
    )
    static_gain: float = parameter(
        22.0e-6 / 40.0, "deflection per volt, end to end of the loop", unit="m/V", low=1e-12
    )
    voltage_limit: float = parameter(40.0, "largest voltage, either sign", unit="V", low=0.0)
    slew_limit: float = parameter(1.0e6, "largest rate of the voltage", unit="V/s", low=1e-3)
    hysteresis: HysteresisParameters = group(HysteresisParameters)


class FeedforwardCoefficients(NamedTuple):
    """What :func:`feedforward_step` needs of the parameters."""

    inverting: bool
    static_gain: float
    voltage_limit: float
    step_limit: float  # V per sample
    operator: Coefficients
    inverse: Coefficients


class FeedforwardState(NamedTuple):
    """What :func:`feedforward_step` remembers, changed in place."""

    hysteresis: State
    clipped: Sequence[float]  # one number: samples at which a limit acted


def feedforward_step(c: FeedforwardCoefficients, s: FeedforwardState, command: float) -> float:
    """Return the voltage (V) for the commanded deflection (m) of this sample."""
    if c.inverting:
        wanted = inverse_voltage(c.inverse, s.hysteresis, command)
    else:
        wanted = command / c.static_gain
    last = s.hysteresis.drive[0]
    low = max(-c.voltage_limit, last - c.step_limit)
    high = min(c.voltage_limit, last + c.step_limit)
    voltage = min(high, max(low, wanted))
    if voltage != wanted:
        s.clipped[0] += 1.0
    if not c.inverting:
        remember_voltage(s.hysteresis, voltage)
    elif voltage == wanted:
        inverse_move(c.inverse, s.hysteresis, command, voltage)
    else:
        inverse_follow(c.operator, c.inverse, s.hysteresis, voltage)
    return voltage


def toward_zero(voltage: float, step: float) -> float:
    """Return `voltage` (V) one `step` (V) closer to 0 V, or 0 V: one sample of a safe ramp."""
    return math.copysign(max(abs(voltage) - step, 0.0), voltage)


class Feedforward:
    """Feedforward law of one finger at a fixed `sample_time` (s), starting at 0 V and homed.

    >>> law = Feedforward(FeedforwardParameters(), sample_time=1e-4)
    >>> round(law.step(22e-6), 9)
    40.0
    """

    def __init__(self, parameters: FeedforwardParameters, sample_time: float) -> None:
        operator = coefficients(parameters.hysteresis, sample_time)
        self.coefficients = FeedforwardCoefficients(
            parameters.compensator == "inverse",
            parameters.static_gain,
            parameters.voltage_limit,
            parameters.slew_limit * sample_time,
            operator,
            invert(operator),
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything: 0 V, every play at 0 (a homed finger), no clipped sample."""
        plays = [0.0] * len(self.coefficients.operator.weights)
        self.state = FeedforwardState(State(plays, [0.0, 0.0]), [0.0])

    def step(self, command: float) -> float:
        """Return the voltage (V) for the commanded deflection (m) of this sample.

        Raises
        ------
        ValueError
            If the command is not finite; the state is left as it was.
        """
        if not math.isfinite(command):
            raise ValueError(f"command is {command!r}, must be a finite deflection in m")
        return feedforward_step(self.coefficients, self.state, command)

    def follow(self, voltage: float) -> None:
        """Take note of a `voltage` (V) applied by somebody else: a ramp to 0 V, a homing sweep."""
        c = self.coefficients
        inverse_follow(c.operator, c.inverse, self.state.hysteresis, voltage)

    @property
    def clipped(self) -> int:
        """Number of samples at which the voltage or slew limit acted."""
        return int(self.state.clipped[0])

    @property
    def reachable_range(self) -> tuple[float, float]:
        """Lowest and highest deflection (m) within the voltage limit, from the homed state."""
        c = self.coefficients
        if not c.inverting:
            high = c.static_gain * c.voltage_limit
            return -high, high
        return reachable_range(c.operator, c.voltage_limit)

    def snapshot(self) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
        """Return a copy of the state, for :meth:`restore`."""
        hysteresis, clipped = self.state
        return tuple(hysteresis.plays), tuple(hysteresis.drive), tuple(clipped)

    def restore(
        self, snapshot: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
    ) -> None:
        """Go back to the state of a snapshot."""
        plays, drive, clipped = snapshot
        self.state = FeedforwardState(State(list(plays), list(drive)), list(clipped))
