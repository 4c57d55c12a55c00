# SPDX-License-Identifier: Apache-2.0
"""Truth plant of another class: Bouc-Wen hysteresis, for judging models that are not it.

Source: T. S. Low and W. Guo, Journal of MEMS 4 (1995), ref. 10 of the paper: deflection
y = slope U - h, with the lag

    dh = alpha dU - beta |dU| h - gamma dU |h|.

Along a monotone voltage this is linear in h on either side of h = 0, so every step is exact and the
hysteresis rate-independent. Unlike Prandtl-Ishlinskii, minor loops depend on where they start, do
not close exactly and follow exponentials. Its creep is logarithmic in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import ParameterError, parameter


@dataclass(frozen=True)
class TruthParameters:
    """Bouc-Wen coefficients; the defaults give ±22 µm at ±40 V and a loop width of 17 %."""

    slope: float = parameter(
        7.1e-7, "deflection per volt without hysteresis", unit="m/V", low=1e-12, high=1e-3
    )
    alpha: float = parameter(
        2.3e-7, "growth of the lag with the voltage", unit="m/V", low=1e-15, high=1e-3
    )
    beta: float = parameter(0.04, "decay of the lag", unit="1/V", low=0.0, high=1e3)
    gamma: float = parameter(
        -0.01,
        "decay of the lag while it grows minus while it shrinks",
        unit="1/V",
        low=-1e3,
        high=1e3,
    )
    creep_onset: float = parameter(
        0.1, "time after a voltage step at which creep sets in", unit="s", low=1e-6, high=1e6
    )
    creep_last: float = parameter(
        1e4, "time up to which creep is logarithmic", unit="s", low=1e-5, high=1e9
    )
    creep_per_decade: float = parameter(
        0.01, "creep per decade of time, relative to the deflection", low=0.0, high=1.0
    )
    creep_per_decade_degc: float = parameter(
        0.005, "increase of the creep per decade, per degree", unit="1/degC", low=0.0, high=1.0
    )

    def __post_init__(self) -> None:
        if abs(self.gamma) > self.beta:
            raise ParameterError(
                f"'gamma' is {self.gamma}, must be in [-beta, beta] = ±{self.beta} 1/V: "
                "the lag would grow without bound"
            )
        if self.creep_last <= self.creep_onset:
            raise ParameterError(
                f"'creep_last' is {self.creep_last} s, must be above 'creep_onset' = "
                f"{self.creep_onset} s"
            )


class BoucWen(NamedTuple):
    """Coefficients of the Bouc-Wen hysteresis."""

    slope: float
    alpha: float
    beta: float
    gamma: float


class BoucWenState(NamedTuple):
    """What Bouc-Wen hysteresis remembers, changed in place: lists of one (or float64 arrays)."""

    lag: list[float]  # m
    voltage: list[float]  # V


def bouc_wen_step(model: BoucWen, state: BoucWenState, voltage: float) -> float:
    """Apply `voltage` (V) and return the static deflection (m)."""
    change = voltage - state.voltage[0]
    if change != 0.0:
        direction = 1.0 if change > 0.0 else -1.0
        rest = abs(change)
        lag = direction * state.lag[0]
        shrinking = model.beta - model.gamma
        if lag < 0.0:
            # Rate alpha - shrinking lag: the lag of the other sign reaches 0 after this much voltage.
            free = -lag / model.alpha
            if shrinking > 0.0:
                free = math.log1p(-shrinking * lag / model.alpha) / shrinking
            if rest <= free:
                lag = approach(lag, model.alpha, shrinking, rest)
                rest = 0.0
            else:
                lag = 0.0
                rest -= free
        if rest > 0.0:
            lag = approach(lag, model.alpha, model.beta + model.gamma, rest)
        state.lag[0] = direction * lag
        state.voltage[0] = voltage
    return model.slope * voltage - state.lag[0]


def approach(lag: float, alpha: float, rate: float, distance: float) -> float:
    """Solve d lag = alpha - rate lag over `distance` (V)."""
    if rate == 0.0:
        return lag + alpha * distance
    left = math.exp(-rate * distance)
    return lag * left + alpha * (1.0 - left) / rate
