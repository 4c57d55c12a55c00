# SPDX-License-Identifier: Apache-2.0
"""Voltage amplifier: clip, slew rate, bandwidth.

The demanded voltage is clipped to the limits, followed at the slew rate at most, and smoothed by a
first-order lag 1 / (1 + s / (2 pi bandwidth)). The output is constant within a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter


@dataclass(frozen=True)
class AmplifierParameters:
    """Limits of the voltage amplifier; the default is ideal up to ±40 V."""

    voltage_limit: float = parameter(
        40.0, "largest voltage of either sign", unit="V", low=1e-3, high=1e4
    )
    slew_rate: float = parameter(
        0.0, "fastest change of the output; 0: unlimited", unit="V/s", low=0.0, high=1e12
    )
    bandwidth_hz: float = parameter(
        0.0, "cut-off of the first-order lag; 0: unlimited", unit="Hz", low=0.0, high=1e9
    )


class Amplifier(NamedTuple):
    """Amplifier per sample: limit (V), largest change (V), part of a transient that is left."""

    limit: float
    change: float
    retained: float


def discretize(parameters: AmplifierParameters, sample_time: float) -> Amplifier:
    """Return the amplifier for one sample time (s)."""
    change = parameters.slew_rate * sample_time if parameters.slew_rate > 0.0 else math.inf
    bandwidth = parameters.bandwidth_hz
    retained = math.exp(-2.0 * math.pi * bandwidth * sample_time) if bandwidth > 0.0 else 0.0
    return Amplifier(parameters.voltage_limit, change, retained)


def amplify(output, amplifier: Amplifier, demand: float) -> float:
    """Return the applied voltage; `output` = [applied voltage, number of clipped demands]."""
    clipped = min(amplifier.limit, max(-amplifier.limit, demand))
    if clipped != demand:
        output[1] += 1.0
    before = output[0]
    followed = min(before + amplifier.change, max(before - amplifier.change, clipped))
    output[0] = followed + amplifier.retained * (before - followed)
    return output[0]
