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


def retention(time_constant: float, sample_time: float) -> float:
    """Return the part of a first-order transient that is left after `sample_time`."""
    return math.exp(-sample_time / time_constant) if time_constant > 0.0 else 0.0


def warm(body_degc: float, retained: float, temperature_degc: float) -> float:
    """Return the body's temperature one sample later at a held surface temperature (°C)."""
    return temperature_degc + retained * (body_degc - temperature_degc)
