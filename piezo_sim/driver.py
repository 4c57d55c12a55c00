# SPDX-License-Identifier: Apache-2.0
"""The simulated piezocantilever as a device of the servo: it moves on with the clock on the wall.

However late the loop reads it, the finger is where it is at that time: the voltage was held meanwhile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from piezo_control.compiled import as_arrays
from piezo_control.parameters import ParameterError, build, load
from piezo_control.thermal import REFERENCE_DEGC
from piezo_sim.plant import cantilever
from piezo_sim.plant.cantilever import (
    CantileverModel,
    CantileverParameters,
    CantileverState,
    advance,
    look,
)


class Device(NamedTuple):
    """The cantilever, and how far it is; one-element arrays change in place."""

    plant: CantileverModel
    state: CantileverState
    period: int  # ns, of the plant's samples
    begun: np.ndarray  # ns of the monotonic clock
    samples: np.ndarray
    demand: np.ndarray  # V, held
    written: np.ndarray  # V, and from when on it holds (ns)
    written_at: np.ndarray
    temperature: np.ndarray  # °C
    tip_force: np.ndarray  # N
    reading: np.ndarray  # deflection (m), age (s)


def device_of(plant: CantileverParameters, temperature_degc: float = REFERENCE_DEGC) -> Device:
    """Return the cantilever at rest, in equilibrium with its temperature."""
    sampled = cantilever.model(plant)
    state = cantilever.rest(sampled, plant.sensor.delay_samples, temperature_degc)
    return as_arrays(
        Device(
            sampled,
            state,
            round(plant.sample_time * 1e9),
            np.zeros(1, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
            np.full(1, sampled.amplifier.rest),
            np.full(1, sampled.amplifier.rest),
            np.zeros(1, dtype=np.int64),
            np.full(1, temperature_degc),
            np.zeros(1),
            np.zeros(2),
        )
    )


def read(device: Device, instant: int) -> int:
    """Let the time pass until `instant` (ns), and read the sensor there; a reading is always there."""
    if device.begun[0] == 0:
        # Half a period early: an edge that is a little late or early falls into the same sample.
        device.begun[0] = instant - device.period // 2
        look(device.plant, device.state, np.random.standard_normal(), np.random.random())
    if device.written_at[0] < instant:
        device.demand[0] = device.written[0]
    due = (instant - device.begun[0]) // device.period
    while device.samples[0] < due:
        advance(
            device.plant,
            device.state,
            device.demand[0],
            device.temperature[0],
            device.tip_force[0],
        )
        look(device.plant, device.state, np.random.standard_normal(), np.random.random())
        device.samples[0] += 1
    device.demand[0] = device.written[0]
    device.reading[0] = device.state.readings[0]
    return 0


def write(device: Device, voltage: float, instant: int) -> int:
    """Hold `voltage` (V) from `instant` (ns) on."""
    device.written[0] = voltage
    device.written_at[0] = instant
    return 0


class Simulation:
    """Driver of a simulated finger; `options` is the parameter file of a cantilever, or empty.

    Raises ParameterError for a file that cannot be used or a sample time that does not divide the loop's.
    """

    def __init__(self, options: str, sample_time: float) -> None:
        plant = CantileverParameters()
        if options:
            plant = build(CantileverParameters, load(options, "cantilever"), options)
        ratio = sample_time / plant.sample_time
        if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise ParameterError(
                f"the cantilever's 'sample_time' is {plant.sample_time:g} s, must divide that of the loop: "
                f"{sample_time:g} s"
            )
        self.device = device_of(plant)
        self.read = read
        self.write = write

    def error(self) -> str:
        """Return nothing: this device does not fail."""
        return ""

    def applied(self) -> float:
        """Return the voltage (V) that is held."""
        return float(self.device.written[0])

    def close(self) -> None:
        """Nothing to let go of."""
