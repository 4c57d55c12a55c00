# SPDX-License-Identifier: Apache-2.0
"""Identification of creep and thermal deflection from long recordings.

With the operator's static deflection H(U), the body's temperature theta behind the thermocouple's T,
and theta_0 the one at the start::

    y = offset + (h + k (theta - 22)) H(U) + s (theta - theta_0) + sum_i c_i
    time_constant theta' = T - theta
    times_i c_i' = share_i (gain + gain_per_degc (theta - 22)) U - c_i

The time constants and how much of the creep is there at 22 degC are searched; the rest is linear least
squares with creep of the voltage's sign only. Every recording has its own offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear
from scipy.signal import lfilter

from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.checks import direction
from piezo_control.identification.confidence import Values, intervals
from piezo_control.identification.fit import column_norms, straight
from piezo_control.identification.measurement import Measurement, MeasurementError
from piezo_control.thermal import REFERENCE_DEGC

ROWS = 3000  # per recording, of block means: vibration and noise average out
RELAXATIONS = 3
JUMP = 0.1  # of the static range, from block to block: such blocks ring and are not fitted
SMALLEST_WARMING = 1.0  # degC, to tell what depends on temperature


@dataclass(frozen=True)
class DriftModel:
    """Creep and thermal deflection, named as the cantilever's parameters."""

    creep_gain: float  # m/V
    creep_gain_per_degc: float  # m/(V degC)
    creep_times: tuple[float, ...]  # s
    creep_shares: tuple[float, ...]
    sensitivity: float  # m/degC
    time_constant: float  # s
    gain_per_degc: float  # 1/degC, of the hysteresis
    fitted: tuple[NDArray[np.float64], ...]  # per recording: time (s), measured and modelled (m)
    without: tuple[
        NDArray[np.float64], ...
    ]  # the deflection (m) of a finger without both, at those times
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name

    def creep_after_step(self, time: NDArray, voltage: float, temperature_degc: float) -> NDArray:
        """Return the creep (m) at `time` (s) after a voltage step (V) at a constant temperature."""
        warmth = temperature_degc - REFERENCE_DEGC
        gain = max(0.0, self.creep_gain + self.creep_gain_per_degc * warmth)
        rise = 1.0 - np.exp(-np.asarray(time)[:, None] / np.array(self.creep_times))
        return gain * voltage * rise @ np.array(self.creep_shares)


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
        self.temperature = means(measurement.temperature)
        jumps = np.abs(np.diff(self.static, prepend=self.static[0])) > JUMP * np.ptp(self.static)
        self.kept = ~(jumps | np.roll(jumps, 1))

    def relax(self, values: NDArray, time_constant: float, start: float) -> NDArray:
        """Return `values`, held over each block, behind a first-order lag from `start`."""
        retained = np.exp(-self.step / time_constant)
        return start + lfilter([1.0 - retained], [1.0, -retained], values - start)


def identify_drift(
    measurements: Sequence[Measurement], hysteresis: HysteresisParameters
) -> DriftModel:
    """Identify creep and thermal deflection from one or more long recordings.

    Parameters
    ----------
    measurements : recordings of one finger; a voltage step for the creep, a change of temperature for
        the thermal part, both temperatures for the creep's dependence on it
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
    creeping = any(np.ptp(r.voltage) > 0.0 for r in recordings)
    warming = any(np.ptp(r.temperature) >= SMALLEST_WARMING for r in recordings)
    if not (creeping or warming):
        raise MeasurementError(
            f"{source}: voltage and temperature are constant: nothing to identify"
        )
    warmest = max(float(r.temperature.max()) for r in recordings) - REFERENCE_DEGC
    coldest = min(float(r.temperature.min()) for r in recordings) - REFERENCE_DEGC
    spans_temperatures = warmest - coldest >= SMALLEST_WARMING and warmest > 0.0
    longest = max(float(r.time[-1]) for r in recordings)
    shortest = max(r.step for r in recordings)
    measured = np.concatenate([r.deflection[r.kept] for r in recordings])
    scale = float(np.std(measured))

    def regressors(logs: NDArray, cold_share: float) -> NDArray:
        time_constant, *times = np.exp(logs)
        blocks = []
        for number, r in enumerate(recordings):
            body = r.relax(r.temperature, time_constant, float(r.temperature[0]))
            warmth = body - REFERENCE_DEGC
            strength = np.ones_like(warmth)
            if spans_temperatures:
                strength = np.maximum(cold_share + (1.0 - cold_share) * warmth / warmest, 0.0)
            columns = [r.relax(r.voltage * strength, t, 0.0) for t in times]
            columns.append(body - body[0])
            columns.append(warmth * r.static)
            columns.append(r.static)
            offsets = np.zeros((len(body), len(recordings)))
            offsets[:, number] = 1.0
            blocks.append(np.column_stack((*columns, offsets))[r.kept])
        return np.concatenate(blocks)

    lowest = np.full(RELAXATIONS + 3 + len(recordings), -np.inf)
    lowest[:RELAXATIONS] = 0.0

    def linear(logs: NDArray, cold_share: float) -> tuple[NDArray, NDArray]:
        matrix = regressors(logs, cold_share)
        norms = column_norms(matrix)
        triangle = np.linalg.qr(np.column_stack((matrix / norms, measured)), mode="r")
        x = lsq_linear(triangle[:, :-1], triangle[:, -1], (lowest, np.inf), method="bvls").x / norms
        return x, measured - matrix @ x

    start = np.log([0.1 * longest * 1e-2, *(longest * np.array([0.006, 0.06, 0.4]))])
    start = np.maximum(start, np.log(2.0 * shortest))
    low = np.append(np.full(len(start), np.log(0.1 * shortest)), -0.5)
    high = np.append(np.full(len(start), np.log(3.0 * longest)), 1.0)
    found = least_squares(
        lambda p: linear(p[:-1], p[-1])[1] / scale, np.append(start, 0.3), bounds=(low, high)
    )
    if not spans_temperatures:
        warmest = 1.0

    def values(numbers: NDArray) -> dict[str, Any]:
        logs, (cold_share, *x) = numbers[: RELAXATIONS + 1], numbers[RELAXATIONS + 1 :]
        time_constant, *times = np.exp(logs).tolist()
        amounts = np.array(x[:RELAXATIONS])
        total = float(np.sum(amounts))
        cold_share = float(cold_share) if spans_temperatures else 1.0
        order = np.argsort(times)
        shares = amounts / total if total > 0.0 else np.full(RELAXATIONS, 1.0 / RELAXATIONS)
        return {
            "creep_gain": total * cold_share,
            "creep_gain_per_degc": total * (1.0 - cold_share) / warmest,
            "creep_times": tuple(float(times[i]) for i in order),
            "creep_shares": tuple(float(shares[i]) for i in order),
            "sensitivity": float(x[RELAXATIONS]) if warming else 0.0,
            "time_constant": time_constant if warming else 0.0,
            "gain_per_degc": float(x[RELAXATIONS + 1] / x[RELAXATIONS + 2])
            if warming and creeping
            else 0.0,
        }

    x, deviation = linear(found.x[:-1], float(found.x[-1]))
    numbers = np.append(found.x, x)
    matrix = regressors(found.x[:-1], float(found.x[-1]))
    free = np.append((found.x > low) & (found.x < high), x > lowest)
    searched = []
    for step in 1e-4 * np.eye(found.x.size):
        after, before = (regressors(p[:-1], p[-1]) for p in (found.x + step, found.x - step))
        searched.append((after - before) @ x / (2.0 * step.sum()))
    jacobian = np.column_stack((*searched, matrix)) * free
    ends = np.cumsum([np.sum(r.kept) for r in recordings])[:-1]
    modelled = np.split(measured - deviation, ends)
    return DriftModel(
        **values(numbers),
        fitted=tuple(
            np.column_stack((r.time[r.kept], r.deflection[r.kept], m))
            for r, m in zip(recordings, modelled)
        ),
        without=tuple(straight(r.deflection[r.kept], r.static[r.kept]) for r in recordings),
        confidence=intervals(values, numbers, jacobian, deviation),
    )
