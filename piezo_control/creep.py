# SPDX-License-Identifier: Apache-2.0
"""Creep: slow deflection after a voltage, amplified by temperature.

Source: paper eq. 4 and Fig. 4. A sum of relaxations driven by the voltage,

    Creep = sum c_i,      times_i c_i' = share_i gain(T) U - c_i,
    gain(T) = max(0, gain + gain_per_degc (T - 22 °C)),

each exact for a voltage and a temperature held within a sample. The gain is a straight line because
the paper gives two temperatures; outside 22 to 32 °C it is an extrapolation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from piezo_control.parameters import ParameterError, parameter


@dataclass(frozen=True)
class CreepParameters:
    """Relaxation times, their shares and the gain: 0.3 µm at 22 °C, 5 µm at 32 °C after 40 V."""

    gain: float = parameter(
        7.5e-9, "final creep per volt at 22 degC", unit="m/V", low=0.0, high=1e-5
    )
    gain_per_degc: float = parameter(
        1.2e-8, "increase of the gain per degree", unit="m/(V degC)", low=0.0, high=1e-6
    )
    times: tuple[float, ...] = parameter(
        (2.0, 15.0, 110.0), "relaxation times", unit="s", low=1e-6, high=1e9
    )
    shares: tuple[float, ...] = parameter(
        (0.2, 0.3, 0.5), "shares of the relaxations; they sum to 1", low=0.0, high=1.0
    )

    def __post_init__(self) -> None:
        if not self.times or len(self.shares) != len(self.times):
            raise ParameterError(
                f"'shares' has {len(self.shares)} values, 'times' {len(self.times)}; "
                "must be as many, one or more"
            )
        if abs(sum(self.shares) - 1.0) > 1e-9:
            raise ParameterError(f"'shares' sums to {sum(self.shares)!r}, must sum to 1")


def logarithmic(onset: float, last: float) -> tuple[np.ndarray, np.ndarray]:
    """Return relaxation (times, weights) whose step response is ln(1 + t / onset) up to `last` (s).

    Trapezoidal rule on 1 / (t + onset) = ∫ exp(-s (t + onset)) ds in log s, two relaxations per
    decade; the response deviates by less than 0.01 from `onset` / 10 to `last`.
    """
    ratio = math.sqrt(10.0)
    count = math.ceil(math.log(1e3 * last / onset, ratio))
    times = 0.1 * onset * ratio ** np.arange(count + 1)
    return times, math.log(ratio) * np.exp(-onset / times)


class Creep(NamedTuple):
    """Creep over one sample; the sequences have one entry for each relaxation."""

    gain: float  # m/V at 22 °C
    gain_per_degc: float  # m/(V °C)
    retained: Sequence[float]  # exp(-h / times), the part of a relaxation that is left
    released: Sequence[float]  # share (1 - retained)


def discretize(
    gain: float, gain_per_degc: float, times: np.ndarray, shares: np.ndarray, sample_time: float
) -> Creep:
    """Return creep with relaxation `times` (s) and `shares` for one sample time (s)."""
    return Creep(
        gain,
        gain_per_degc,
        retained=np.exp(-sample_time / times).tolist(),
        released=(shares * -np.expm1(-sample_time / times)).tolist(),
    )


def creep_step(creep: Creep, relaxations: list[float], voltage: float, warmth: float) -> float:
    """Advance the `relaxations` (m) by one sample and return their sum (m).

    `voltage` (V) and `warmth`, the body's temperature above 22 °C, are held within the sample.
    """
    drive = max(0.0, creep.gain + creep.gain_per_degc * warmth) * voltage
    total = 0.0
    for i in range(len(relaxations)):
        relaxations[i] = creep.retained[i] * relaxations[i] + creep.released[i] * drive
        total += relaxations[i]
    return total
