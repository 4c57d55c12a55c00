# SPDX-License-Identifier: Apache-2.0
"""Voltage amplifier: clip, slew rate, bandwidth.

The demanded voltage is kept within the limits of voltage and slew, and smoothed by a first-order lag
1 / (1 + s / (2 pi bandwidth)). The output is constant within a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter
from piezo_control.safety import VoltageParameters, limited


@dataclass(frozen=True)
class AmplifierParameters(VoltageParameters):
    """Limits of the voltage amplifier, the last thing between a voltage and the finger."""

    slew_limit: float = parameter(
        # The paper's step of the voltage, 40 V, takes one sample of 0.1 ms.
        4e5, "fastest change of the output", unit="V/s", low=1e-3, high=1e12,
    )  # fmt: skip
    bandwidth_hz: float = parameter(
        0.0, "cut-off of the first-order lag; 0: unlimited", unit="Hz", low=0.0, high=1e9
    )


class Amplifier(NamedTuple):
    """Amplifier per sample: limits (V), largest change (V), part of a transient that is left, rest (V)."""

    low: float
    high: float
    change: float
    retained: float
    rest: float


def discretize(parameters: AmplifierParameters, sample_time: float) -> Amplifier:
    """Return the amplifier for one sample time (s)."""
    bandwidth = parameters.bandwidth_hz
    return Amplifier(
        low=parameters.voltage_low,
        high=parameters.voltage_high,
        change=parameters.slew_limit * sample_time,
        retained=math.exp(-2.0 * math.pi * bandwidth * sample_time) if bandwidth > 0.0 else 0.0,
        rest=parameters.rest,
    )


class AmplifierState(NamedTuple):
    """What the amplifier remembers, changed in place: lists of one (or float64 arrays)."""

    voltage: list[float]  # applied (V)
    clipped: list[float]  # number of demands that a limit changed


def amplify(state: AmplifierState, amplifier: Amplifier, demand: float) -> float:
    """Return the applied voltage (V) for a demanded one (V)."""
    before = state.voltage[0]
    followed = limited(amplifier.low, amplifier.high, amplifier.change, before, demand)
    if followed != demand:
        state.clipped[0] += 1.0
    state.voltage[0] = followed + amplifier.retained * (before - followed)
    return state.voltage[0]
