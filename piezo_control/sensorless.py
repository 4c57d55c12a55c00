# SPDX-License-Identifier: Apache-2.0
"""Feedforward without a sensor: hysteresis, vibration, creep and heat undone by their models.

The finger is the paper's equation (3) without a tip force,

    delta = H_s(U, theta) D(s) + g(theta) + Creep(U, theta),

with the body's temperature theta behind the thermocouple's. Per sample the shaped reference w_k (no
vibration, :mod:`piezo_control.shaping`) has to be reached at the end of the sample,

    scale H(U_k) + line U_k = w_k - g(theta_k+1) - sum_i retained_i c_i,
    scale = (1 + gain_per_degc warmth) (1 + lag_per_degc warmth),
    line  = sum_i released_i gain(theta) - (1 + gain_per_degc warmth) lag_per_degc warmth slope,

where c_i are the relaxations of creep, warmth = theta_k - 22 °C. The left side is the Prandtl-Ishlinskii
operator with weights that follow the temperature. Its plays do not: they follow the voltage alone, so
whatever the temperature does, memory stays right and the voltage has no bump. Solved exactly, with creep's
part within the sample, so for a finger that is its model nothing is left but the vibration that shaping
leaves. Where a limit acts, the models follow the voltage applied.

While a controller leads the finger, its commands go through the inverse hysteresis of the same plays, and
creep and heat follow; gain, offset and resonance of the models may slowly follow the sensor
(:mod:`piezo_control.adaptation`), for when it is taken away. From one to the other the voltage has no bump:
what models and controller disagree on at that moment is added to the input from then on.

Source: M. Rakotondrabe, C. Clévy, P. Lutz, *Complete open loop control of hysteretic, creeped, and
oscillating piezoelectric cantilevers*, IEEE T-ASE 7 (2010) 440, for the structure; the inverse that follows
the temperature is solved play by play as in :mod:`piezo_control.hysteresis`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from piezo_control import adaptation, creep, shaping, thermal
from piezo_control.adaptation import (
    Adaptation,
    AdaptationParameters,
    AdaptationState,
    adapt,
    remember,
    unadapted,
)
from piezo_control.creep import Creep, CreepParameters, creep_step
from piezo_control.dynamics import DynamicsParameters
from piezo_control.hysteresis import (
    Coefficients,
    HysteresisParameters,
    State,
    at_rest,
    from_rest,
    operator_inverse,
    operator_step,
)
from piezo_control.parameters import ParameterError, group, parameter
from piezo_control.safety import VoltageParameters, limited
from piezo_control.shaping import ShapingParameters, shape
from piezo_control.thermal import (
    REFERENCE_DEGC,
    Body,
    Thermal,
    ThermalParameters,
    heated,
    heated_operator,
    thermal_deflection,
    warm,
)


@dataclass(frozen=True)
class SensorlessParameters(VoltageParameters):
    """Models of one finger, as `identify` writes them, and the voltage limits."""

    temperature_low: float = parameter(
        10.0,
        "lowest temperature it is for; colder counts as this",
        unit="degC",
        low=-50.0,
        high=22.0,
    )
    temperature_high: float = parameter(
        45.0,
        "highest temperature it is for; warmer counts as this",
        unit="degC",
        low=22.0,
        high=150.0,
    )
    hysteresis: HysteresisParameters = group(HysteresisParameters)
    dynamics: DynamicsParameters = group(DynamicsParameters)
    creep: CreepParameters = group(CreepParameters)
    thermal: ThermalParameters = group(ThermalParameters)
    shaping: ShapingParameters = group(ShapingParameters)
    adaptation: AdaptationParameters = group(AdaptationParameters)


class SensorlessCoefficients(NamedTuple):
    """What :func:`sensorless_step` needs of the parameters."""

    operator: Coefficients
    creep: Creep
    thermal: Thermal
    taps: Sequence[float]
    low: float  # V
    high: float  # V
    step_limit: float  # V per sample
    coldest: float  # °C
    warmest: float  # °C
    rest: float  # V
    adaptation: Adaptation


class SensorlessState(NamedTuple):
    """What :func:`sensorless_step` remembers, changed in place: lists (or float64 arrays)."""

    hysteresis: State
    relaxations: list[float]  # m
    body: Body
    past: list[float]  # references (m), newest first
    offset: list[float]  # m, added to the input since a hand-over
    clipped: list[float]  # number of samples at which a limit acted
    adapted: AdaptationState


def sensorless_coefficients(
    parameters: SensorlessParameters, sample_time: float
) -> SensorlessCoefficients:
    """Return the coefficients for a sample time (s).

    Raises
    ------
    ParameterError
        If the hysteresis is one that has no inverse here (dead zones, rate-dependent thresholds), or none at
        a temperature within the range; the message names which.
    """
    p = parameters
    h = p.hysteresis
    if h.upper_thresholds or h.lower_thresholds or h.rate_coefficient:
        raise ParameterError(
            "'hysteresis' has dead zones or rate-dependent thresholds: the sensorless inverse is for the "
            "classical operator, `identify hysteresis` without them"
        )
    slopes = list(accumulate(h.weights))
    for degc in (p.temperature_low, p.temperature_high):
        # Between the two the slopes of the inverse are on straight lines but for a positive factor.
        warmth = degc - REFERENCE_DEGC
        softening = p.thermal.lag_per_degc * warmth
        least = min((1.0 + softening) * slope - softening * slopes[-1] for slope in slopes)
        if not (least > 0.0 and 1.0 + p.thermal.gain_per_degc * warmth > 0.0):
            raise ParameterError(
                f"'thermal.gain_per_degc' {p.thermal.gain_per_degc} and 'thermal.lag_per_degc' "
                f"{p.thermal.lag_per_degc} leave no inverse at {degc:g} °C"
            )
    times, shares = np.array(p.creep.times), np.array(p.creep.shares)
    return SensorlessCoefficients(
        operator=from_rest(h, sample_time),
        creep=creep.discretize(p.creep.gain, p.creep.gain_per_degc, times, shares, sample_time),
        thermal=thermal.discretize(p.thermal, slopes[-1], sample_time),
        taps=list(shaping.shaper(p.shaping, p.dynamics.denominator, sample_time)),
        low=p.voltage_low,
        high=p.voltage_high,
        step_limit=p.slew_limit * sample_time,
        coldest=p.temperature_low,
        warmest=p.temperature_high,
        rest=p.rest,
        adaptation=adaptation.discretize(p.adaptation, p.dynamics.denominator, sample_time),
    )


def sensorless_rest(c: SensorlessCoefficients, temperature_degc: float) -> SensorlessState:
    """Return the state of a homed finger at its rest voltage, in equilibrium with `temperature_degc`."""
    start = min(max(temperature_degc, c.coldest), c.warmest)
    hysteresis = at_rest(c.operator)
    home = operator_step(c.operator, hysteresis, c.rest)
    return SensorlessState(
        hysteresis=hysteresis,
        relaxations=[0.0] * len(c.creep.retained),
        body=Body([start], degc_at_start=[start]),
        past=[home] * shaping.longest(c.taps, 1.0 - c.adaptation.resonance_range),
        offset=[0.0],
        clipped=[0.0],
        adapted=unadapted(c.adaptation, home),
    )


# Step functions: plain scalars and indexables, so that numba can compile them as they are.


def sensorless_step(
    c: SensorlessCoefficients,
    s: SensorlessState,
    reference: float,
    temperature_degc: float,
    share: float,
) -> float:
    """Return the voltage (V) for the reference (m) of this sample at a surface temperature (°C).

    `share` is the part of a sample time that has passed since the last one, for the slew limit. A temperature
    that is NaN is one that is missing: the body keeps the temperature it has.
    """
    wanted = shape(c.taps, s.past, reference, s.adapted.ratio[0]) + s.offset[0]
    warmth = s.body.degc[0] - REFERENCE_DEGC
    heat(c, s, temperature_degc)
    left = 0.0
    released = 0.0
    for i in range(len(s.relaxations)):
        left += c.creep.retained[i] * s.relaxations[i]
        released += c.creep.released[i]
    released *= max(0.0, c.creep.gain + c.creep.gain_per_degc * warmth)
    rest = wanted - thermal_deflection(c.thermal, s.body) - s.adapted.offset[0]
    scale, line = heated_operator(c.thermal, warmth)
    value = rest / s.adapted.gain[0] - left
    ideal = operator_inverse(c.operator, s.hysteresis, value, scale, released + line)
    return apply(c, s, ideal, warmth, share)


def inverse_step(
    c: SensorlessCoefficients,
    s: SensorlessState,
    command: float,
    temperature_degc: float,
    share: float,
) -> float:
    """Return the voltage (V) for a controller's command (m): the inverse hysteresis; the models follow.

    It is that of the body's temperature and of the adapted gain, so that the controller meets the same finger at
    any temperature. Creep and thermal deflection are left to the controller.
    """
    warmth = s.body.degc[0] - REFERENCE_DEGC
    heat(c, s, temperature_degc)
    scale, line = heated_operator(c.thermal, warmth)
    value = (command + s.offset[0]) / s.adapted.gain[0]
    ideal = operator_inverse(c.operator, s.hysteresis, value, scale, line)
    return apply(c, s, ideal, warmth, share)


def heat(c: SensorlessCoefficients, s: SensorlessState, temperature_degc: float) -> None:
    """Let the body follow the surface by one sample, or keep its temperature where there is none."""
    if temperature_degc == temperature_degc:  # not NaN
        warm(c.thermal, s.body, min(max(temperature_degc, c.coldest), c.warmest))


def apply(
    c: SensorlessCoefficients, s: SensorlessState, ideal: float, warmth: float, share: float
) -> float:
    """Return the voltage (V) that the limits allow; hysteresis and creep follow it."""
    voltage = limited(c.low, c.high, c.step_limit * share, s.hysteresis.voltage[0], ideal)
    if voltage != ideal:
        s.clipped[0] += 1.0
    note(c, s, voltage, warmth)
    return voltage


def note(c: SensorlessCoefficients, s: SensorlessState, voltage: float, warmth: float) -> None:
    """Let hysteresis, creep and what will be compared with a reading follow a `voltage` (V)."""
    operator_step(c.operator, s.hysteresis, voltage)
    creep_step(c.creep, s.relaxations, voltage, warmth)
    if c.adaptation.rate > 0.0:
        heat = thermal_deflection(c.thermal, s.body)
        remember(c.adaptation, s.adapted, actuated(c, s, voltage, warmth), heat)


def actuated(c: SensorlessCoefficients, s: SensorlessState, voltage: float, warmth: float) -> float:
    """Return what hysteresis and creep (m) are expected to give at the end of a sample at `voltage` (V)."""
    total = hysteretic(c, s, voltage, warmth)
    for i in range(len(s.relaxations)):
        total += s.relaxations[i]
    return total


def follow_step(
    c: SensorlessCoefficients, s: SensorlessState, voltage: float, temperature_degc: float
) -> float:
    """Let the models follow a `voltage` (V) that somebody else chose; return what they expect (m) at its end."""
    warmth = s.body.degc[0] - REFERENCE_DEGC
    heat(c, s, temperature_degc)
    note(c, s, voltage, warmth)
    return expected(c, s, voltage, warmth)


def settle(c: SensorlessCoefficients, s: SensorlessState, temperature_degc: float) -> None:
    """Learn the temperature that the finger has been in equilibrium with since its start."""
    s.body.degc[0] = min(max(temperature_degc, c.coldest), c.warmest)
    s.body.degc_at_start[0] = s.body.degc[0]


def expected(c: SensorlessCoefficients, s: SensorlessState, voltage: float, warmth: float) -> float:
    """Return the static deflection (m) that the models expect at the end of a sample at `voltage` (V)."""
    of_voltage = s.adapted.gain[0] * actuated(c, s, voltage, warmth)
    return of_voltage + thermal_deflection(c.thermal, s.body) + s.adapted.offset[0]


def take_over(s: SensorlessState, predicted: float, reference: float) -> None:
    """Go on without a bump from a controller, by references (m), at the deflection that is `predicted` (m)."""
    for i in range(len(s.past)):
        s.past[i] = reference
    s.offset[0] = predicted - reference


def hysteretic(
    c: SensorlessCoefficients, s: SensorlessState, voltage: float, warmth: float
) -> float:
    """Return the deflection (m) of the hysteresis alone, `warmth` (°C) above 22 °C."""
    total = 0.0
    for i in range(len(c.operator.weights)):
        total += c.operator.weights[i] * s.hysteresis.plays[i]
    return heated(c.thermal, total, voltage, warmth)


FROM_REST, BY_REFERENCE, BY_CONTROLLER = range(3)


class Sensorless:
    """The law of one finger at a fixed `sample_time` (s), from rest at `temperature_degc`.

    >>> law = Sensorless(SensorlessParameters(), sample_time=1e-4, temperature_degc=22.0)
    >>> for _ in range(40):
    ...     voltage = law.step(10e-6, 22.0)
    >>> abs(law.predicted - 10e-6) < 1e-18
    True
    """

    def __init__(
        self, parameters: SensorlessParameters, sample_time: float, temperature_degc: float
    ) -> None:
        self.coefficients = sensorless_coefficients(parameters, sample_time)
        self.sample_time = sample_time
        self.state = sensorless_rest(self.coefficients, temperature_degc)
        start = self.state.body.degc[0] - REFERENCE_DEGC
        self.predicted = expected(self.coefficients, self.state, self.voltage, start)
        """Static deflection (m) that the models expect at the end of the last sample."""
        self._led = FROM_REST

    def step(self, reference: float, temperature_degc: float, share: float = 1.0) -> float:
        """Return the voltage (V) for the reference (m) of this sample; NaN is a missing temperature.

        After a controller's commands it goes on from the deflection that the models expect. `share` (0 to
        1) is the part of a sample time that has passed since the last sample. Raises ValueError when the
        reference is not finite or the temperature infinite; nothing changes.
        """
        self._check("reference", reference, temperature_degc)
        s = self.state
        if self._led == BY_CONTROLLER:
            take_over(s, self.predicted, reference)
        self._led = BY_REFERENCE
        warmth = s.body.degc[0] - REFERENCE_DEGC
        voltage = sensorless_step(self.coefficients, s, reference, temperature_degc, share)
        self._predict(voltage, warmth)
        return voltage

    def lead(
        self,
        command: float,
        temperature_degc: float,
        share: float = 1.0,
        deflection: float = math.nan,
    ) -> float:
        """Return the voltage (V) for the command (m) of a controller, through the inverse hysteresis.

        After references of :meth:`step` it goes on from the voltage that is applied. To the `deflection` (m)
        that the sensor reads at this sample gain, offset and resonance are adapted, unless it is NaN. Otherwise
        as there.
        """
        self._check("command", command, temperature_degc)
        s = self.state
        if not math.isnan(deflection):
            adapt(self.coefficients.adaptation, s.adapted, deflection)
        warmth = s.body.degc[0] - REFERENCE_DEGC
        if self._led == BY_REFERENCE:
            reached = hysteretic(self.coefficients, s, self.voltage, warmth)
            s.offset[0] = s.adapted.gain[0] * reached - command
        self._led = BY_CONTROLLER
        voltage = inverse_step(self.coefficients, s, command, temperature_degc, share)
        self._predict(voltage, warmth)
        return voltage

    def follow(self, voltage: float, temperature_degc: float = math.nan) -> None:
        """Take note of a sample whose `voltage` (V) somebody else chose: a ramp to rest."""
        self.predicted = follow_step(self.coefficients, self.state, voltage, temperature_degc)

    def pause(self, samples: int) -> None:
        """Let creep go on for `samples` that nobody asked for, with voltage and temperature held."""
        c, s = self.coefficients, self.state
        warmth = s.body.degc[0] - REFERENCE_DEGC
        drive = max(0.0, c.creep.gain + c.creep.gain_per_degc * warmth) * self.voltage
        for i, retained in enumerate(c.creep.retained):
            final = c.creep.released[i] / (1.0 - retained) * drive
            s.relaxations[i] = final + retained**samples * (s.relaxations[i] - final)
        self._predict(self.voltage, warmth)

    def settle(self, temperature_degc: float) -> None:
        """Learn the temperature that the finger has been in equilibrium with since its start."""
        settle(self.coefficients, self.state, temperature_degc)

    @property
    def delay(self) -> float:
        """Time (s) by which a shaped ramp comes late, for whoever plans ahead."""
        c, adapted = self.coefficients, self.state.adapted
        return shaping.delay(c.taps, self.sample_time, adapted.ratio[0])

    @property
    def body_degc(self) -> float:
        """Temperature (°C) of the body."""
        return self.state.body.degc[0]

    @property
    def voltage(self) -> float:
        """The last voltage (V)."""
        return self.state.hysteresis.voltage[0]

    @property
    def clipped(self) -> int:
        """Number of samples at which the voltage or slew limit acted."""
        return int(self.state.clipped[0])

    def _check(self, name: str, value: float, temperature_degc: float) -> None:
        if not math.isfinite(value) or math.isinf(temperature_degc):
            raise ValueError(
                f"{name} is {value!r} m, temperature is {temperature_degc!r} °C; must be finite"
            )

    def _predict(self, voltage: float, warmth: float) -> None:
        self.predicted = expected(self.coefficients, self.state, voltage, warmth)
