# SPDX-License-Identifier: Apache-2.0
"""What a measurement cannot be used for, found before anything is fitted: named with column, rows and what to do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piezo_control.identification.fit import noise
from piezo_control.identification.measurement import Measurement, MeasurementError

FEWEST_PER_PERIOD = 20  # samples
FEWEST_VALUES = 20  # different ones of the deflection
LARGEST_NOISE = 0.05  # of the stroke, standard deviation
REVERSED = -0.5  # correlation of deflection and voltage
AT_THE_END = 5e-3  # of the stroke: no further from its end, a deflection stays there
VOLTAGE_AT_THE_END = 0.05  # of its range: a free finger does not stay at an end for so long
FEWEST_AT_THE_END = 5  # samples
HUMP = 0.03  # of the stroke, by which a deflection goes on and back while the voltage stays
SMALLEST_BRANCH = 0.1  # of the range of the voltage
LARGEST_DRIFT = 0.05  # of the stroke, where there is hardly a loop
MAINS = (50.0, 60.0, 100.0, 120.0)  # Hz
SMALLEST_HUM = 2e-3  # of the stroke, amplitude
HUM_OVER_NEIGHBOURS = 5.0
HIGHEST_HARMONIC = 20  # of the drive, that might be taken for the mains


def static(measurement: Measurement) -> None:
    """Raise MeasurementError for what no hysteresis can be identified from.

    That is a deflection that falls while the voltage rises, a sensor, an amplifier or a voltmeter at its end,
    too few samples in a period, an excursion that hardly leaves noise or resolution, and a drift that is larger
    than the loop.
    """
    measurement.need_varying("voltage", "deflection")
    direction(measurement)
    _period(measurement)
    _excursion(measurement)
    for side in (1.0, -1.0):
        _sensor_at_its_end(measurement, side)
        _voltmeter_at_its_end(measurement, side)
    _drift(measurement)


def _refuse(measurement: Measurement, text: str) -> MeasurementError:
    return MeasurementError(f"{measurement.source}: {text}")


def reversed_sensor(
    measurement: Measurement, seen: str, drive: str = "voltage"
) -> MeasurementError:
    """Return the error about a deflection that falls while its drive rises, to be raised."""
    return _refuse(
        measurement,
        f"column 'deflection' falls while '{drive}' rises ({seen}): the sign of the sensor is reversed; --reversed "
        "(or leaving it away) reads it the other way round",
    )


def _rows(measurement: Measurement, run: slice) -> str:
    return f"rows {measurement.rows[run.start]} to {measurement.rows[run.stop - 1]}"


def _runs(true: NDArray[np.bool_]) -> list[slice]:
    """Return where a condition holds for FEWEST_AT_THE_END samples in a row or longer."""
    edges = np.flatnonzero(np.diff(true.astype(int), prepend=0, append=0))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist())
    return [slice(a, b) for a, b in pairs if b - a >= FEWEST_AT_THE_END]


def direction(measurement: Measurement) -> None:
    """Raise MeasurementError for a deflection that falls while the voltage rises."""
    correlation = float(np.corrcoef(measurement.voltage, measurement.deflection)[0, 1])
    if correlation < REVERSED:
        raise reversed_sensor(measurement, f"correlation {correlation:.2f}")


def _crossings(measurement: Measurement) -> NDArray[np.int64]:
    """Return the samples before which the voltage passes the middle of its range for good."""
    voltage = measurement.voltage
    middle, margin = 0.5 * (voltage.max() + voltage.min()), 0.02 * np.ptp(voltage)
    beyond = np.flatnonzero(np.abs(voltage - middle) > margin)
    above = voltage[beyond] > middle
    return beyond[np.flatnonzero(np.diff(above)) + 1]


def _period(measurement: Measurement) -> None:
    passages = _crossings(measurement)
    if passages.size < 3:
        return
    samples = 2.0 * float(np.median(np.diff(passages)))
    if samples < FEWEST_PER_PERIOD:
        raise _refuse(
            measurement,
            f"column 'voltage' has {samples:.3g} samples in a period of {samples * measurement.sample_time:.3g} s, "
            f"must be at least {FEWEST_PER_PERIOD}: sample faster, or drive slower",
        )


def _excursion(measurement: Measurement) -> None:
    deflection = measurement.deflection
    stroke, deviation = float(np.ptp(deflection)), noise(deflection)
    if deviation > LARGEST_NOISE * stroke:
        raise _refuse(
            measurement,
            f"column 'deflection' moves by {stroke * 1e6:.3g} µm under noise of {deviation * 1e6:.3g} µm: too small "
            "an excursion; raise the voltage, or look for the right column",
        )
    different = np.unique(deflection).size
    if different < FEWEST_VALUES:
        raise _refuse(
            measurement,
            f"column 'deflection' has {different} different values over {stroke * 1e6:.3g} µm: too small an "
            "excursion for the resolution of the sensor, or written with too few digits",
        )


def _sensor_at_its_end(measurement: Measurement, side: float) -> None:
    voltage, deflection = measurement.voltage, side * measurement.deflection
    near = deflection >= deflection.max() - AT_THE_END * np.ptp(deflection)
    for run in _runs(near):
        if np.ptp(voltage[run]) > VOLTAGE_AT_THE_END * np.ptp(voltage):
            raise _refuse(
                measurement,
                f"column 'deflection', {_rows(measurement, run)} stay at {measurement.deflection[run].mean():.4g} m "
                f"while the voltage moves from {voltage[run].min():.4g} to {voltage[run].max():.4g} V: sensor or "
                "amplifier is at its end, or something is in the way; lower the voltage",
            )


def _voltmeter_at_its_end(measurement: Measurement, side: float) -> None:
    voltage, deflection = side * measurement.voltage, side * measurement.deflection
    stroke = float(np.ptp(deflection))
    margin = HUMP * stroke + 3.0 * noise(deflection)
    for run in _runs(voltage >= voltage.max() - 1e-6 * np.ptp(voltage)):
        ends = max(deflection[run.start], deflection[run.stop - 1])
        if (hump := float(deflection[run].max() - ends)) > margin:
            raise _refuse(
                measurement,
                f"column 'voltage', {_rows(measurement, run)} stay at {measurement.voltage[run.start]:.4g} V while the "
                f"deflection goes on by {hump * 1e6:.3g} µm and comes back: what was recorded of the voltage is "
                "clipped; record it with another range",
            )


def clipped(measurement: Measurement) -> None:
    """Raise MeasurementError for a vibration that stops at an end and stays there, as at the end of a sensor."""
    for side in (1.0, -1.0):
        deflection = side * measurement.deflection
        stroke = float(np.ptp(deflection))
        for run in _runs(deflection >= deflection.max() - AT_THE_END * stroke):
            if run.start == 0 or run.stop == deflection.size:
                continue
            inside = deflection[run]
            steps = inside[0] - deflection[run.start - 1], inside[-1] - deflection[run.stop]
            if min(steps) > 4.0 * AT_THE_END * stroke:
                raise _refuse(
                    measurement,
                    f"column 'deflection', {_rows(measurement, run)} stay at {side * inside.mean():.4g} m between steps "
                    f"of {min(steps) * 1e6:.3g} µm: the sensor is at its end, or something is in the way; drive less",
                )


def _drift(measurement: Measurement) -> None:
    """Compare the loop's centre from cycle to cycle with the loop's width, at the middle of the voltage."""
    passages = _crossings(measurement)
    if passages.size < 4:
        return
    first = passages[:-1] if passages.size % 2 else passages
    seen = measurement.deflection[first].reshape(-1, 2)
    width = float(np.median(np.abs(seen[:, 1] - seen[:, 0])))
    drift = float(np.ptp(seen.mean(axis=1)))
    if drift > max(width, LARGEST_DRIFT * float(np.ptp(measurement.deflection))):
        raise _refuse(
            measurement,
            f"column 'deflection' drifts by {drift * 1e6:.3g} µm from cycle to cycle, the loop is {width * 1e6:.3g} µm "
            "wide: wait until creep and heat are over, or use fewer cycles (--start, --end)",
        )


def one_branch(measurement: Measurement, fitted: slice) -> str:
    """Say that the voltage only rises or only falls in the part that is `fitted`; '' where it does both."""
    voltage = measurement.voltage[fitted]
    rise = float(np.max(voltage - np.minimum.accumulate(voltage)))
    fall = float(np.max(np.maximum.accumulate(voltage) - voltage))
    if min(rise, fall) > SMALLEST_BRANCH * np.ptp(measurement.voltage):
        return ""
    return (
        f"after the voltage has been to both ends it only {'rises' if rise > fall else 'falls'} in the "
        f"{_rows(measurement, fitted)} that are fitted, which say little of the other branch and of what comes after "
        "them: record two cycles or more"
    )


def hum(measurement: Measurement, deviation: NDArray[np.float64]) -> str:
    """Say what the mains leave in the deviation (m) of a deflection from its model; '' for nothing."""
    time, stroke = measurement.time - measurement.time[0], float(np.ptp(measurement.deflection))
    passages = _crossings(measurement)
    drive = 0.5 / np.median(np.diff(measurement.time[passages])) if passages.size > 2 else 0.0
    spacing = 1.0 / time[-1]
    found = []
    for line in MAINS:
        order = round(line / drive) if drive else 0
        harmonic = 0 < order <= HIGHEST_HARMONIC and abs(line - order * drive) < 2.0 * spacing
        if line > 0.45 / measurement.sample_time or time[-1] * line < 20.0 or harmonic:
            continue
        around = line + spacing * np.array([0, *range(-8, -2), *range(3, 9)])
        amplitude = 2.0 * np.abs(
            np.mean(deviation * np.exp(-2j * np.pi * around[:, None] * time), axis=1)
        )
        if amplitude[0] > max(
            SMALLEST_HUM * stroke, HUM_OVER_NEIGHBOURS * float(np.median(amplitude[1:]))
        ):
            found.append(f"{line:g} Hz of {amplitude[0] * 1e6:.3g} µm")
    if not found:
        return ""
    return (
        f"mains hum in column 'deflection': {', '.join(found)}, of a stroke of {stroke * 1e6:.4g} µm; shield and "
        "ground the sensor"
    )
