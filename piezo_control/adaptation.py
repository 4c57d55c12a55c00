# SPDX-License-Identifier: Apache-2.0
"""Slow adaptation of the models while a sensor is there: gain, offset and resonance of what they expect.

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

The resonance is `ratio` times that of the models. In units of time of 1 / w the mode q'' + 2 zeta q' + q = A moves on
by the angle ratio w h a sample, and a relative change of the ratio changes q by sigma, which moves like the mode
towards 0 and is driven, per sample, by that angle times (q', q''). The ratio follows what is left of the error
when the mode is expected, too,

    R     = R + h / time_constant (sigma² - R)
    ratio = ratio (1 + h / time_constant sigma (y_k - (gain q_j + g_j + offset)) / (R + (scale / 100)²)),

the recursive prediction error method with a forgetting of `time_constant`. Only a finger that vibrates tells: at
rest and in slow motion sigma is 0 and the ratio stays. Bounded by `resonance_range`.

Sources: S. Haykin, *Adaptive Filter Theory*, ch. 7, for the normalised step, stable for h < 2 time_constant;
L. Ljung, T. Söderström, *Theory and Practice of Recursive Identification*, ch. 3, for the prediction error method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.dynamics import Motion, move, propagator
from piezo_control.parameters import parameter

VIBRATION = 0.01  # of `scale`: vibrations so much smaller tell little about the resonance


@dataclass(frozen=True)
class AdaptationParameters:
    """How fast and how far gain, offset and resonance of the models follow the sensor."""

    time_constant: float = parameter(
        0.0, "of the adaptation; 0: off. Slow against the loop, 1 s and more", unit="s", low=0.0,
        high=1e6,
    )  # fmt: skip
    gain_range: float = parameter(0.1, "largest change of the gain, relative", low=0.0, high=0.5)
    offset_range: float = parameter(1e-6, "largest offset", unit="m", low=0.0, high=1e-3)
    resonance_range: float = parameter(
        0.2, "largest change of the resonance, relative; 0: it stays", low=0.0, high=0.5
    )
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
    resonance_range: float
    scale: float  # m
    late: int  # samples from a voltage to the reading that shows it
    angle: float  # rad, of the mode in a sample
    damping: float


class AdaptationState(NamedTuple):
    """What is adapted, changed in place: lists (or float64 arrays), of one where one number."""

    gain: list[float]
    offset: list[float]  # m
    ratio: list[float]  # of the finger's resonance to that of the models
    actuated: list[float]  # m, what hysteresis and creep were expected to give, newest first
    heat: list[float]  # m, the thermal deflection at the same instants
    moving: list[float]  # m, q at the same instants
    sensitivity: list[float]  # m, sigma at the same instants
    mode: Motion  # q and sigma now, in units of time of 1 / w
    information: list[float]  # m², R


def discretize(
    parameters: AdaptationParameters, denominator: Sequence[float], sample_time: float
) -> Adaptation:
    """Return the adaptation for the mode 1 / (a2 s² + a1 s + 1) and one sample time (s).

    A mode that does not vibrate, or not below half the sampling rate, tells nothing about its resonance.
    """
    p = parameters
    a2, a1, _ = denominator
    angle, damping = sample_time / math.sqrt(a2), 0.5 * a1 / math.sqrt(a2)
    vibrates = damping < 1.0 and angle * (1.0 + p.resonance_range) < math.pi
    return Adaptation(
        rate=min(1.0, sample_time / p.time_constant) if p.time_constant > 0.0 else 0.0,
        gain_range=p.gain_range,
        offset_range=p.offset_range,
        resonance_range=p.resonance_range if vibrates and p.time_constant > 0.0 else 0.0,
        scale=p.scale,
        late=p.delay_samples + 1,
        angle=angle,
        damping=damping,
    )


def unadapted(a: Adaptation, deflection: float) -> AdaptationState:
    """Return the state of models that are right, of a finger that rests at `deflection` (m)."""
    return AdaptationState(
        gain=[1.0],
        offset=[0.0],
        ratio=[1.0],
        actuated=[deflection] * a.late,
        heat=[0.0] * a.late,
        moving=[deflection] * a.late,
        sensitivity=[0.0] * a.late,
        mode=Motion(x=[deflection, 0.0], v=[0.0, 0.0]),
        information=[0.0],
    )


def remember(a: Adaptation, state: AdaptationState, actuated: float, heat: float) -> None:
    """Take note of what hysteresis and creep (m), and heat (m), are expected to give after this sample."""
    for i in range(len(state.actuated) - 1, 0, -1):
        state.actuated[i] = state.actuated[i - 1]
        state.heat[i] = state.heat[i - 1]
        state.moving[i] = state.moving[i - 1]
        state.sensitivity[i] = state.sensitivity[i - 1]
    state.actuated[0] = actuated
    state.heat[0] = heat
    if a.resonance_range > 0.0:
        angle = state.ratio[0] * a.angle
        free = propagator(1.0, 2.0 * a.damping, 1.0, angle)
        mode = state.mode
        move(mode, free, actuated, 0)
        move(mode, free, 0.0, 1)
        mode.x[1] += angle * mode.v[0]
        mode.v[1] -= angle * (mode.x[0] - actuated + 2.0 * a.damping * mode.v[0])
        state.moving[0] = mode.x[0]
        state.sensitivity[0] = mode.x[1]


def adapt(a: Adaptation, state: AdaptationState, deflection: float) -> None:
    """Let gain, offset and resonance follow a reading (m); before this sample's voltage is chosen."""
    actuated = state.actuated[-1]
    sigma = state.gain[0] * state.sensitivity[-1]
    unexplained = deflection - state.gain[0] * state.moving[-1] - state.heat[-1] - state.offset[0]
    error = deflection - state.gain[0] * actuated - state.heat[-1] - state.offset[0]
    step = a.rate * error / (actuated * actuated + a.scale * a.scale)
    gain = state.gain[0] + step * actuated
    offset = state.offset[0] + step * a.scale * a.scale
    state.gain[0] = min(max(gain, 1.0 - a.gain_range), 1.0 + a.gain_range)
    state.offset[0] = min(max(offset, -a.offset_range), a.offset_range)
    least = VIBRATION * a.scale
    state.information[0] += a.rate * (sigma * sigma - state.information[0])
    turn = a.rate * sigma * unexplained / (state.information[0] + least * least)
    ratio = state.ratio[0] * (1.0 + turn)
    state.ratio[0] = min(max(ratio, 1.0 - a.resonance_range), 1.0 + a.resonance_range)
