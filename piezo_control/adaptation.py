# SPDX-License-Identifier: Apache-2.0
"""Slow adaptation of the models while a sensor is there: gain and offset of what they expect.

Without a tip force the models are right but for a gain and an offset,

    y = gain A + g + offset,

A being what hysteresis and creep are expected to give, g the thermal deflection. A reading that comes d
samples late belongs to what was expected d + 1 samples ago, so per sample

    e      = y_k - (gain A_j + g_j + offset),      j = k - d - 1
    gain   = gain + h / time_constant e A_j / (A_j² + scale²)
    offset = offset + h / time_constant e scale² / (A_j² + scale²),

normalised least mean squares with `scale`, the deflection at which both have an equal part in an error: at rest
both follow it, moving they part. Bounded by `gain_range` and `offset_range`; a gain above 0 changes nothing in
whether an inverse exists.

Source: S. Haykin, *Adaptive Filter Theory*, ch. 7, for the normalised step, stable for h < 2 time_constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter


@dataclass(frozen=True)
class AdaptationParameters:
    """How fast and how far gain and offset of the models follow the sensor."""

    time_constant: float = parameter(
        0.0, "of the adaptation; 0: off. Slow against the loop, 1 s and more", unit="s", low=0.0,
        high=1e6,
    )  # fmt: skip
    gain_range: float = parameter(0.1, "largest change of the gain, relative", low=0.0, high=0.5)
    offset_range: float = parameter(1e-6, "largest offset", unit="m", low=0.0, high=1e-3)
    scale: float = parameter(
        1e-5, "deflection at which gain and offset have an equal part in an error", unit="m", low=1e-9,
        high=1e-2,
    )  # fmt: skip
    delay_samples: int = parameter(1, "age of a reading when it comes", low=0, high=1000)


class Adaptation(NamedTuple):
    """What :func:`adapt` needs of the parameters."""

    rate: float  # h / time_constant; 0: off
    gain_range: float
    offset_range: float  # m
    scale: float  # m
    late: int  # samples from a voltage to the reading that shows it


class AdaptationState(NamedTuple):
    """What is adapted, changed in place: lists (or float64 arrays), of one where one number."""

    gain: list[float]
    offset: list[float]  # m
    actuated: list[float]  # m, what hysteresis and creep were expected to give, newest first
    heat: list[float]  # m, the thermal deflection at the same instants


def discretize(parameters: AdaptationParameters, sample_time: float) -> Adaptation:
    """Return the adaptation for one sample time (s)."""
    p = parameters
    rate = min(1.0, sample_time / p.time_constant) if p.time_constant > 0.0 else 0.0
    return Adaptation(rate, p.gain_range, p.offset_range, p.scale, p.delay_samples + 1)


def unadapted(a: Adaptation, deflection: float) -> AdaptationState:
    """Return the state of models that are right, of a finger that rests at `deflection` (m)."""
    return AdaptationState([1.0], [0.0], [deflection] * a.late, [0.0] * a.late)


def remember(state: AdaptationState, actuated: float, heat: float) -> None:
    """Take note of what hysteresis and creep (m), and heat (m), are expected to give after this sample."""
    for i in range(len(state.actuated) - 1, 0, -1):
        state.actuated[i] = state.actuated[i - 1]
        state.heat[i] = state.heat[i - 1]
    state.actuated[0] = actuated
    state.heat[0] = heat


def adapt(a: Adaptation, state: AdaptationState, deflection: float) -> None:
    """Let gain and offset follow a reading (m); before this sample's voltage is chosen."""
    actuated = state.actuated[-1]
    error = deflection - state.gain[0] * actuated - state.heat[-1] - state.offset[0]
    step = a.rate * error / (actuated * actuated + a.scale * a.scale)
    gain = state.gain[0] + step * actuated
    offset = state.offset[0] + step * a.scale * a.scale
    state.gain[0] = min(max(gain, 1.0 - a.gain_range), 1.0 + a.gain_range)
    state.offset[0] = min(max(offset, -a.offset_range), a.offset_range)
