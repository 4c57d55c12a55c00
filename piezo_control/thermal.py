# SPDX-License-Identifier: Apache-2.0
"""Temperature of the cantilever's body, and what it does: g(T) and the change of the hysteresis.

Source: paper eq. 2-4 with g(22 °C) = 0. Heat diffuses through the 0.3 mm thick cantilever, so the
body follows the thermocouple with a first-order lag, theta' = (T - theta) / time_constant, exact for
a temperature held within a sample. All thermal effects follow theta:

    g = sensitivity (theta - theta at the start)
    H_s(U, theta) = (1 + gain_per_degc (theta - 22 °C)) (H_s(U) - lag_per_degc (theta - 22 °C) lag)

where ``lag = slope U - H_s(U)`` is what hysteresis takes away from the straight line. Both
coefficients are small: the loop hardly moves (Fig. 5), while the line that the fixed inverse
makes of it gets a visibly different slope at 32 °C (Fig. 9).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter

REFERENCE_DEGC = 22.0


@dataclass(frozen=True)
class ThermalParameters:
    """Thermal deflection g(T) and temperature coefficients of the hysteresis."""

    sensitivity: float = parameter(
        1.5e-7, "thermal deflection per degree", unit="m/degC", low=-1e-4, high=1e-4
    )
    time_constant: float = parameter(
        0.3, "lag of the body behind the thermocouple", unit="s", low=0.0, high=1e4
    )
    gain_per_degc: float = parameter(
        0.006, "relative change of the stroke per degree", unit="1/degC", low=-0.02, high=0.02
    )
    lag_per_degc: float = parameter(
        0.005, "relative change of the loop width per degree", unit="1/degC", low=-0.02, high=0.02
    )


class Thermal(NamedTuple):
    """Thermal effects over one sample."""

    slope: float  # of the straight line that hysteresis departs from, m/V
    stroke: float  # factor on H_s; 1 for the nominal finger
    gain_per_degc: float
    lag_per_degc: float
    sensitivity: float  # m/°C
    retained: float  # part of the body's transient that is left


class Body(NamedTuple):
    """Temperature of the body (°C), changed in place: lists of one (or float64 arrays)."""

    degc: list[float]
    degc_at_start: list[float]


def discretize(parameters: ThermalParameters, slope: float, sample_time: float) -> Thermal:
    """Return the thermal effects for one sample time (s); `slope` (m/V) is that of the hysteresis."""
    p = parameters
    retained = math.exp(-sample_time / p.time_constant) if p.time_constant > 0.0 else 0.0
    return Thermal(slope, 1.0, p.gain_per_degc, p.lag_per_degc, p.sensitivity, retained)


def heated(thermal: Thermal, deflection: float, voltage: float, warmth: float) -> float:
    """Return H_s(U, theta) for the `deflection` H_s(U) (m) and `warmth` = theta - 22 °C."""
    scale, line = heated_operator(thermal, warmth)
    return scale * deflection + line * voltage


def heated_operator(thermal: Thermal, warmth: float) -> tuple[float, float]:
    """Return what H_s(U, theta) is made of: scale H_s(U) + line U (m/V), with `warmth` = theta - 22 °C."""
    stroke = thermal.stroke * (1.0 + thermal.gain_per_degc * warmth)
    widening = thermal.lag_per_degc * warmth
    return stroke * (1.0 + widening), -stroke * widening * thermal.slope


def warm(thermal: Thermal, body: Body, surface_degc: float) -> None:
    """Go on by one sample with the surface at `surface_degc` (°C)."""
    body.degc[0] = surface_degc + thermal.retained * (body.degc[0] - surface_degc)


def thermal_deflection(thermal: Thermal, body: Body) -> float:
    """Return g (m)."""
    return thermal.sensitivity * (body.degc[0] - body.degc_at_start[0])
