# SPDX-License-Identifier: Apache-2.0
"""Identification of creep and thermal deflection from long recordings.

With the operator's static deflection H(U), the body's temperature theta behind the thermocouple's T,
and theta_0 the one at the start::

    y = offset + (h + k (theta - 22)) H(U) - m (theta - 22) (W U - H(U)) + s (theta - theta_0) + sum_i c_i
    time_constant theta' = T - theta
    times_i c_i' = share_i (gain + gain_per_degc (theta - 22)) U - c_i

W being the slope of the line that hysteresis lags behind. The lag of the body and how much of the creep is
there at the lowest temperature under a voltage are searched; the rest is linear least squares with creep of the voltage's sign only.
Relaxation times are on a grid, so that creep of any course is met, logarithmic too. Every recording has its
own offset. How the width of the loop changes, m, is told by the same loop recorded at two temperatures, how
creep and stroke do by voltages at two temperatures; from one alone, all creep counts as that at 22 degC.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear
from scipy.signal import lfilter

from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.checks import direction
from piezo_control.identification.confidence import Values, intervals
from piezo_control.identification.fit import column_norms, straight
from piezo_control.identification.hysteresis import settled
from piezo_control.identification.measurement import Measurement, MeasurementError
from piezo_control.thermal import REFERENCE_DEGC

ROWS = 3000  # per recording, of block means: vibration and noise average out
RELAXATIONS = 8  # from block to recording, two or so per decade
JUMP = 0.1  # of the static range, from block to block: such blocks ring and are not fitted
FEWEST_BLOCKS = 20
SMALLEST_WARMING = 1.0  # degC, to tell what depends on temperature
LEVELS = 10  # parts of a recording whose mean temperatures count: a thermocouple's noise does not


class Described(NamedTuple):
    """A recording as it was fitted; of the same loop at two temperatures their difference."""

    source: str
    curve: NDArray[np.float64]  # time (s), measured and modelled (m)
    without: NDArray[np.float64]  # the deflection (m) of a finger without creep and heat
    stroke: float  # m, of the recording: that of the loops, where it is their difference


@dataclass(frozen=True)
class DriftModel:
    """Creep and thermal deflection, named as the cantilever's parameters; 0 with an interval of 0: not told."""

    creep_gain: float  # m/V
    creep_gain_per_degc: float  # m/(V degC)
    creep_times: tuple[float, ...]  # s
    creep_shares: tuple[float, ...]
    sensitivity: float  # m/degC
    time_constant: float  # s
    gain_per_degc: float  # 1/degC, of the hysteresis
    lag_per_degc: float  # 1/degC, of its width
    creep_degc: float  # at which the creep was seen, on average; NaN: none
    fitted: tuple[Described, ...]
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name

    def cleared(self, measurement: Measurement) -> Measurement:
        """Return a recording of a finger that begins at rest, with creep and thermal deflection taken out."""
        temperature = measurement.temperature
        if temperature is None:
            raise MeasurementError(f"{measurement.source}: no column 'temperature'")
        first, step = float(temperature[0]), measurement.sample_time
        body = _relax(temperature, self.time_constant, first, step)
        gain = self.creep_gain + self.creep_gain_per_degc * (body - REFERENCE_DEGC)
        drive = np.maximum(gain, 0.0) * measurement.voltage
        drift = self.sensitivity * (body - first)
        for time, share in zip(self.creep_times, self.creep_shares):
            drift = drift + share * _relax(drive, time, 0.0, step)
        return replace(measurement, deflection=measurement.deflection - drift)

    def creep_after_step(self, time: NDArray, voltage: float, temperature_degc: float) -> NDArray:
        """Return the creep (m) at `time` (s) after a voltage step (V) at a constant temperature."""
        warmth = temperature_degc - REFERENCE_DEGC
        gain = max(0.0, self.creep_gain + self.creep_gain_per_degc * warmth)
        rise = 1.0 - np.exp(-np.asarray(time)[:, None] / np.array(self.creep_times))
        return gain * voltage * rise @ np.array(self.creep_shares)


def _relax(values: NDArray, time_constant: float, start: float, step: float) -> NDArray:
    """Return `values`, held for `step` (s) each, behind a first-order lag from `start`."""
    retained = np.exp(-step / time_constant) if time_constant > 0.0 else 0.0
    return start + lfilter([1.0 - retained], [1.0, -retained], values - start)


def is_loop(voltage: NDArray) -> bool:
    """Say whether a voltage goes from end to end and back."""
    return bool(np.sum(np.abs(np.diff(voltage))) >= 2.0 * np.ptp(voltage) > 0.0)


class _Means:
    """A recording as means over blocks of equal duration."""

    def __init__(self, measurement: Measurement, hysteresis: HysteresisParameters) -> None:
        measurement.need_varying("deflection")
        measurement.need_even_sampling()
        if measurement.temperature is None:
            raise MeasurementError(
                f"{measurement.source}: no column 'temperature', which is needed"
            )
        block = -(-len(measurement.time) // ROWS)
        self.step = block * measurement.sample_time

        def means(values: NDArray) -> NDArray:
            whole = len(values) // block * block
            return values[:whole].reshape(-1, block).mean(axis=1)

        self.time = means(measurement.time - measurement.time[0])
        self.deflection = means(measurement.deflection)
        self.voltage = means(measurement.voltage)
        self.static = means(deflection_history(hysteresis, measurement.voltage))
        self.lag = sum(hysteresis.weights) * self.voltage - self.static
        self.temperature = means(measurement.temperature)
        levels = [np.mean(part) for part in np.array_split(self.temperature, LEVELS)]
        self.coldest, self.warmest = float(min(levels)), float(max(levels))
        self.creeps = bool(np.ptp(self.voltage) > 0.0)
        jumps = np.abs(np.diff(self.static, prepend=self.static[0])) > JUMP * np.ptp(self.static)
        self.kept = ~(jumps | np.roll(jumps, 1))
        first = settled(measurement) if is_loop(measurement.voltage) else 0
        # Where the first rise from rest ends is where the operator was identified from.
        self.kept[: -(-first // block)] = False
        self.is_loop = is_loop(measurement.voltage[first:])
        seen = self.deflection[self.kept]
        if seen.size < FEWEST_BLOCKS or np.ptp(seen) == 0.0:
            moved = np.ptp(seen) if seen.size else 0.0
            raise MeasurementError(
                f"{measurement.source}: between the jumps of the voltage are {seen.size} blocks of {self.step:.3g} s, "
                f"must be at least {FEWEST_BLOCKS}, in which the deflection moves by {moved:.3g} m: hold the voltage, "
                "and record longer"
            )

    def is_same_loop(self, other: _Means) -> bool:
        """Say whether both are loops under one voltage, at temperatures that differ."""
        return (
            self.is_loop
            and self.voltage.shape == other.voltage.shape
            and np.ptp(self.voltage - other.voltage) <= 1e-3 * np.ptp(self.voltage)
            and abs(self.temperature[0] - other.temperature[0]) >= SMALLEST_WARMING
        )

    def relax(self, values: NDArray, time_constant: float, start: float) -> NDArray:
        """Return `values`, held over each block, behind a first-order lag from `start`."""
        return _relax(values, time_constant, start, self.step)


def identify_drift(
    measurements: Sequence[Measurement], hysteresis: HysteresisParameters
) -> DriftModel:
    """Identify creep and thermal deflection from one or more long recordings.

    Parameters
    ----------
    measurements : recordings of one finger; a voltage step for the creep, a change of temperature for
        the thermal part, voltages at two temperatures for the dependence of creep and stroke on it
    hysteresis : the finger's operator

    Raises
    ------
    MeasurementError
        If a recording has no temperature, its deflection falls while the voltage rises, or voltage and
        temperature are constant in all of them.
    """
    recordings = [_Means(m, hysteresis) for m in measurements]
    for measurement in measurements:
        if np.ptp(measurement.voltage) > 0.0:
            direction(measurement)
    source = ", ".join(m.source for m in measurements)
    creeping = [r for r in recordings if r.creeps]
    warming = any(r.warmest - r.coldest >= SMALLEST_WARMING for r in recordings)
    if not (creeping or warming):
        raise MeasurementError(
            f"{source}: voltage and temperature are constant: nothing to identify"
        )
    # Without a voltage there is neither creep nor stroke to depend on the temperature.
    coldest = min((r.coldest for r in creeping), default=REFERENCE_DEGC)
    warmest = max((r.warmest for r in creeping), default=REFERENCE_DEGC)
    spans_temperatures = warmest - coldest >= SMALLEST_WARMING
    longest = max(float(r.time[-1]) for r in recordings)
    slowest = max(r.step for r in recordings)
    times = np.geomspace(slowest, 0.5 * longest, RELAXATIONS)
    # What the operator leaves of a loop is the same at another temperature, and larger than what that
    # changes: two such loops count by their difference.
    twins = [
        (n, m)
        for n, m in itertools.combinations(range(len(recordings)), 2)
        if recordings[n].is_same_loop(recordings[m])
    ]
    single = [n for n in range(len(recordings)) if not any(n in twin for twin in twins)]
    deflections = [r.deflection[r.kept] for r in recordings]

    def rows(blocks: Sequence[NDArray]) -> NDArray:
        """Return the rows that are fitted, of those of every recording."""
        return np.concatenate(
            [*(blocks[n] for n in single), *(blocks[m] - blocks[n] for n, m in twins)]
        )

    measured = rows(deflections)
    scale = float(np.std(measured)) or 1.0

    def regressors(
        time_constant: float, cold_share: float, times: NDArray = times
    ) -> list[NDArray]:
        blocks = []
        for number, r in enumerate(recordings):
            body = r.relax(r.temperature, time_constant, float(r.temperature[0]))
            warmth = body - REFERENCE_DEGC
            strength = np.ones_like(warmth)
            if spans_temperatures:
                rise = (body - coldest) / (warmest - coldest)
                strength = np.maximum(cold_share + (1.0 - cold_share) * rise, 0.0)
            columns = [r.relax(r.voltage * strength, t, 0.0) for t in times]
            columns.append((body - body[0]) * warming)
            columns.append(warmth * r.static * spans_temperatures)
            columns.append(-warmth * r.lag * bool(twins))
            columns.append(r.static)
            offsets = np.zeros((len(body), len(recordings)))
            offsets[:, number] = number not in dict(twins)  # a difference has one offset
            blocks.append(np.column_stack((*columns, offsets))[r.kept])
        return blocks

    lowest = np.full(RELAXATIONS + 4 + len(recordings), -np.inf)
    lowest[:RELAXATIONS] = 0.0

    def linear(
        time_constant: float, cold_share: float, times: NDArray = times
    ) -> tuple[NDArray, NDArray]:
        matrix = rows(regressors(time_constant, cold_share, times))
        norms = column_norms(matrix)
        triangle = np.linalg.qr(np.column_stack((matrix / norms, measured)), mode="r")
        x = lsq_linear(triangle[:, :-1], triangle[:, -1], (lowest, np.inf), method="bvls").x / norms
        return x, measured - matrix @ x

    # No creep is less than none at 22 degC.
    least = max(0.0, coldest - REFERENCE_DEGC) / max(warmest - REFERENCE_DEGC, SMALLEST_WARMING)
    least *= spans_temperatures
    low = np.array([np.log(0.1 * slowest), least])
    high = np.array([np.log(3.0 * longest), 1.0])
    found = least_squares(
        lambda p: linear(np.exp(p[0]), p[1])[1] / scale,
        (np.log(1e-3 * longest + 2.0 * slowest), least + 0.3 * (1.0 - least)),
        bounds=(low, high),
    )

    def values(numbers: NDArray) -> dict[str, Any]:
        (log, cold_share), amounts = numbers[:2], numbers[2 : 2 + RELAXATIONS]
        shift, growth, widening, static = numbers[2 + RELAXATIONS : 6 + RELAXATIONS].tolist()
        inverse = (
            1.0 / static if static else 0.0
        )  # what does not answer a voltage has no stroke to change
        total = float(np.sum(amounts))
        per_degc = (
            total * (1.0 - float(cold_share)) / (warmest - coldest) if spans_temperatures else 0.0
        )
        shares = amounts / total if total > 0.0 else np.full(RELAXATIONS, 1.0 / RELAXATIONS)
        gain_per_degc = growth * inverse if (warming and spans_temperatures) or twins else 0.0
        return {
            "creep_gain": total - per_degc * (warmest - REFERENCE_DEGC),
            "creep_gain_per_degc": per_degc,
            "creep_shares": tuple(shares[there].tolist()),
            "sensitivity": shift if warming else 0.0,
            "time_constant": float(np.exp(log)) if warming else 0.0,
            "gain_per_degc": gain_per_degc,
            # The lag grows with the stroke, too, at the temperature at which it was seen.
            "lag_per_degc": widening * inverse / (1.0 + gain_per_degc * (warmest - REFERENCE_DEGC))
            if twins
            else 0.0,
        }

    def modelled(searched: NDArray) -> list[NDArray]:
        return regressors(np.exp(searched[0]), searched[1])

    x, deviation = linear(np.exp(found.x[0]), found.x[1])
    amounts = x[:RELAXATIONS]
    there = (amounts > 0.0) | (np.sum(amounts) == 0.0)
    numbers = np.append(found.x, x)
    free = np.append((found.x > low) & (found.x < high), x > lowest)
    searched = [
        rows(
            [after - before for after, before in zip(modelled(found.x + h), modelled(found.x - h))]
        )
        @ x
        / (2.0 * h.sum())
        for h in 1e-4 * np.eye(found.x.size)
    ]
    jacobian = np.column_stack((*searched, rows(modelled(found.x)))) * free
    half_step = (times[1] / times[0]) ** 0.5
    others = [
        np.append(found.x, linear(np.exp(found.x[0]), found.x[1], grid)[0])
        for grid in (times / half_step, times * half_step)
    ]
    curves = [block @ x for block in modelled(found.x)]

    def alone(number: int) -> Described:
        r, seen = recordings[number], deflections[number]
        shown = curves[number] + np.mean(seen) - np.mean(curves[number])
        less = straight(seen, r.static[r.kept])
        curve = np.column_stack((r.time[r.kept], seen, shown))
        return Described(measurements[number].source, curve, less, float(np.ptp(seen)))

    def compared(first: int, second: int) -> Described:
        seen = deflections[second] - deflections[first]
        shown = curves[second] - curves[first]
        time = recordings[first].time[recordings[first].kept]
        source = f"{measurements[second].source} less {Path(measurements[first].source).name}"
        curve = np.column_stack((time, seen, shown + np.mean(seen) - np.mean(shown)))
        without = np.full_like(seen, np.mean(seen))
        return Described(source, curve, without, float(np.ptp(deflections[first])))

    return DriftModel(
        **values(numbers),
        creep_times=tuple(times[there].tolist()),
        creep_degc=float(np.mean([np.mean(r.temperature) for r in creeping]))
        if creeping
        else np.nan,
        fitted=(*map(alone, single), *itertools.starmap(compared, twins)),
        confidence=intervals(values, numbers, jacobian, deviation, others=others),
    )
