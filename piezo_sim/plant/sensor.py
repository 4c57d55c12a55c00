# SPDX-License-Identifier: Apache-2.0
"""Laser sensor: noise, resolution, delay and drop-outs.

A reading is the deflection plus white noise, rounded to the resolution. It comes out `delay_samples`
later. In a drop-out the sensor repeats its previous reading, as laser sensors do when the spot is
lost. The default resolution is that of the paper's sensor (10 nm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter


@dataclass(frozen=True)
class SensorParameters:
    """Imperfections of the displacement sensor."""

    resolution: float = parameter(
        10e-9, "step of the readings; 0: continuous", unit="m", low=0.0, high=1e-3
    )
    noise: float = parameter(
        5e-9, "standard deviation of the white noise", unit="m", low=0.0, high=1e-3
    )
    delay_samples: int = parameter(1, "age of a reading when it comes out", low=0, high=1000)
    dropout_rate: float = parameter(
        0.0, "probability that a reading repeats the one before", low=0.0, high=1.0
    )


class Sensor(NamedTuple):
    """Sensor in numbers: resolution (m), noise (m), drop-out probability."""

    resolution: float
    noise: float
    dropout_rate: float


def read(
    line: list[float], sensor: Sensor, deflection: float, normal: float, uniform: float
) -> None:
    """Take a reading of `deflection` (m) into the delay line.

    line[0] is the reading that comes out now, line[-1] the newest. `normal` and `uniform` are this
    reading's draws from the standard normal and the [0, 1) uniform distribution.
    """
    newest = len(line) - 1
    reading = line[newest]
    if uniform >= sensor.dropout_rate:
        reading = deflection + sensor.noise * normal
        if sensor.resolution > 0.0:
            reading = sensor.resolution * math.floor(reading / sensor.resolution + 0.5)
    for i in range(newest):
        line[i] = line[i + 1]
    line[newest] = reading
