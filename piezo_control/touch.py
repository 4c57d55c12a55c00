# SPDX-License-Identifier: Apache-2.0
"""Force without a force sensor, and a finger that stops at a force and holds it, whatever it touches.

The models of hysteresis, heat and creep say where a tip that nobody pushes would be (paper eq. 3 with F = 0,
:mod:`piezo_control.sensorless`). What is missing of it, low-passed, is the push of the object:

    push = (lowpass(expected - deflection) - zero) / s_p.

The models are off by a share of the way that the tip has gone, so while less than `touch_force` is felt, `zero`
follows what is missing by up to `model_error` times the way, and slowly at rest. It follows at once where it
says that something pulls, which no object does here (an adhesive one would be felt late). From `touch_force`
on it stays. What the models are off by on the way in contact is the error of the push; an object so soft that
a tip loses less than `model_error` of its way on it is not felt.

The command integrates the slower of two wishes, to follow the reference and to push with `max_force`:

    command' = min(reference' + position_rate lowpass(reference - deflection),
                   force_rate s_p (max_force - push)).

There is one integrator, so one wish takes over from the other without a bump, and a finger comes no faster than
it can stop: a tip that closes at force_rate s_p max_force meets a wall and the push goes to the limit
exponentially. In contact with a stiffness k the static gain of the first is 1 / (1 + s_p k), that of the second
s_p k / (1 + s_p k), and the resonance of the tip is at sqrt(1 + s_p k) times its own, where an integrator behind a low-pass
has less gain than at its own: stable with every object because the loop is with none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter
from piezo_control.sensorless import (
    SensorlessCoefficients,
    SensorlessParameters,
    SensorlessState,
    expected,
    inverse_step,
    sensorless_coefficients,
    sensorless_rest,
)
from piezo_control.thermal import REFERENCE_DEGC

PULL_TIME = 2e-3
"""Time constant (s) with which a pull, which no object gives, is taken for an error of the models."""

PLAY = 1e-7
"""Half the width (m) of the play behind which the command counts as way, so that noise is none."""


@dataclass(frozen=True)
class TouchParameters(SensorlessParameters):
    """Models of the finger, how far they are trusted, and how fast the finger may answer."""

    position_rate: float = parameter(
        200.0, "rate of the loop that follows the reference", unit="1/s", low=1.0, high=1e4
    )
    force_rate: float = parameter(
        100.0, "rate of the loop that holds a force, against a wall", unit="1/s", low=1.0, high=1e4
    )
    filter_time: float = parameter(
        5e-4, "each of the two time constants of the low-pass", unit="s", low=0.0, high=1.0
    )
    model_error: float = parameter(
        0.03, "what the models are off by, as a share of the way", low=0.0, high=0.5
    )
    touch_force: float = parameter(
        5e-5, "below it a push may be drift of the models", unit="N", low=0.0, high=1.0
    )
    zero_time: float = parameter(
        10.0, "time constant with which such drift is learned", unit="s", low=1e-2, high=1e6
    )
    command_low: float = parameter(-22e-6, "lowest command", unit="m")
    command_high: float = parameter(22e-6, "highest command", unit="m")


class TouchCoefficients(NamedTuple):
    """What :func:`touch_step` needs of the parameters; rates are shares per sample."""

    models: SensorlessCoefficients
    elastic_constant: float  # m/N
    position_rate: float
    force_rate: float
    filter_rate: float
    model_error: float
    touch: float  # m
    zero_rate: float
    pull_rate: float
    command_low: float
    command_high: float


class TouchState(NamedTuple):
    """What :func:`touch_step` remembers, changed in place: lists (or float64 arrays)."""

    models: SensorlessState
    expected: list[float]  # m, of a tip that nobody pushes
    missing: list[float]  # expected - deflection (m), once and twice low-passed
    behind: list[float]  # reference - deflection (m), once and twice low-passed
    zero: list[float]  # m
    way: list[float]  # the command (m) behind a play
    reference: list[float]  # m, the last one
    command: list[float]  # m, the last one


def touch_coefficients(parameters: TouchParameters, sample_time: float) -> TouchCoefficients:
    """Return the coefficients for a sample time (s); ParameterError as of `sensorless_coefficients`."""
    p = parameters
    s_p = p.dynamics.elastic_constant
    return TouchCoefficients(
        sensorless_coefficients(p, sample_time),
        s_p,
        p.position_rate * sample_time,
        p.force_rate * sample_time,
        sample_time / (p.filter_time + sample_time),
        p.model_error,
        p.touch_force * s_p,
        sample_time / p.zero_time,
        sample_time / (PULL_TIME + sample_time),
        p.command_low,
        p.command_high,
    )


def touch_rest(c: TouchCoefficients, temperature_degc: float) -> TouchState:
    """Return the state of a homed finger at 0 V that touches nothing."""
    return TouchState(
        sensorless_rest(c.models, temperature_degc),
        expected=[0.0],
        missing=[0.0, 0.0],
        behind=[0.0, 0.0],
        zero=[0.0],
        way=[0.0],
        reference=[0.0],
        command=[0.0],
    )


# Step functions: plain scalars and indexables, so that numba can compile them as they are.


def low_pass(state: list[float], rate: float, value: float) -> None:
    """Let `state`, once and twice low-passed, follow `value`."""
    state[0] += rate * (value - state[0])
    state[1] += rate * (state[0] - state[1])


def push_of(c: TouchCoefficients, s: TouchState) -> float:
    """Return the force (N) that pushes the tip back, as estimated; positive against closing."""
    return (s.missing[1] - s.zero[0]) / c.elastic_constant


def feel(c: TouchCoefficients, s: TouchState, deflection: float) -> None:
    """Take a reading (m) into the estimate of the push."""
    low_pass(s.missing, c.filter_rate, s.expected[0] - deflection)
    way = min(max(s.way[0], s.command[0] - PLAY), s.command[0] + PLAY)
    trust = c.model_error * abs(way - s.way[0])
    s.way[0] = way
    push = s.missing[1] - s.zero[0]
    if push < 0.0:
        s.zero[0] += c.pull_rate * push
    elif push < c.touch:
        s.zero[0] += c.zero_rate * push + min(push, trust)


def follow(
    c: TouchCoefficients, s: TouchState, command: float, temperature_degc: float, share: float
) -> float:
    """Take note of the command (m) that is given; return the voltage (V) that it comes to."""
    warmth = s.models.body.degc[0] - REFERENCE_DEGC
    voltage = inverse_step(c.models, s.models, command, temperature_degc, share)
    s.expected[0] = expected(c.models, s.models, voltage, warmth)
    s.command[0] = command
    return voltage


def press(
    c: TouchCoefficients, s: TouchState, reference: float, deflection: float, max_force: float
) -> float:
    """Return the next command (m): towards the `reference` (m), pushing with `max_force` (N) at most."""
    low_pass(s.behind, c.filter_rate, reference - deflection)
    ahead = reference - s.reference[0] + c.position_rate * s.behind[1]
    s.reference[0] = reference
    push = c.force_rate * c.elastic_constant * (max_force - push_of(c, s))
    command = s.command[0] + min(ahead, push)
    return min(max(command, c.command_low), c.command_high)


class Touch:
    """The law of one finger at a fixed `sample_time` (s), homed and touching nothing at `temperature_degc`.

    >>> law = Touch(TouchParameters(), sample_time=1e-4, temperature_degc=22.0)
    >>> law.step(1e-6, 0.0, max_force=1e-3, temperature_degc=22.0) < 1e-6
    True
    """

    def __init__(
        self, parameters: TouchParameters, sample_time: float, temperature_degc: float
    ) -> None:
        self.coefficients = touch_coefficients(parameters, sample_time)
        self.state = touch_rest(self.coefficients, temperature_degc)

    def step(
        self, reference: float, deflection: float, max_force: float, temperature_degc: float
    ) -> float:
        """Return the command (m) for one sample; a temperature (°C) that is NaN is one that is missing.

        Raises ValueError for any other input (m, m, N) that is not finite, or a force below 0; nothing
        changes.
        """
        if not (math.isfinite(reference) and math.isfinite(deflection)):
            raise ValueError(
                f"reference {reference!r} m and deflection {deflection!r} m must be finite"
            )
        if not 0.0 <= max_force < math.inf or math.isinf(temperature_degc):
            raise ValueError(
                f"max_force is {max_force!r} N, temperature is {temperature_degc!r} °C; must be finite, "
                "the force 0 or more"
            )
        c, s = self.coefficients, self.state
        feel(c, s, deflection)
        command = press(c, s, reference, deflection, max_force)
        follow(c, s, command, temperature_degc, 1.0)
        return command

    @property
    def push(self) -> float:
        """Force (N) that pushes the tip back, as estimated."""
        return push_of(self.coefficients, self.state)
