# SPDX-License-Identifier: Apache-2.0
"""Identification of D(s) = 1 / (a2 s^2 + a1 s + 1) and of the gain in front of it.

The model's output is compared, not its equation, so noise does not bias the damping::

    deflection = gain D(s) z^-delay drive + offset + slope t

`drive` is held from sample to sample (exact zero-order hold); natural frequency, damping ratio and a delay of
whole samples are searched, the rest is linear least squares. With the tip force as drive the gain is the elastic
constant s_p, with the hysteresis operator's output it should be 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

from piezo_control.identification.confidence import Values, intervals
from piezo_control.identification.fit import column_norms
from piezo_control.identification.measurement import Measurement, MeasurementError

FREQUENCIES = 150  # tried before the search, from one cycle in the measurement to Nyquist
LONGEST_DELAY = 8  # samples
LARGEST_LEFT = 0.5  # of what was measured around the resonance
STEP = 1e-6  # relative, of a derivative
DAMPING_RATIOS = (0.005, 0.03, 0.2, 0.9)


@dataclass(frozen=True)
class DynamicsModel:
    """Second-order dynamics behind a static gain."""

    natural_frequency: float  # rad/s
    damping_ratio: float
    gain: float  # m per unit of the drive
    offset: float  # m
    slope: float  # m/s
    delay_samples: int  # from the drive to the deflection, beyond how they are paired
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name

    @property
    def denominator(self) -> tuple[float, float, float]:
        """Coefficients a2, a1, 1 of D(s), highest power first."""
        return _denominator(self.natural_frequency, self.damping_ratio)

    def deflection(self, time: ArrayLike, drive: ArrayLike) -> NDArray[np.float64]:
        """Return the deflection (m) at evenly spaced `time` (s) from rest at drive[0]."""
        time = np.asarray(time, float)
        response = _respond(
            self.natural_frequency,
            self.damping_ratio,
            _delayed(np.asarray(drive, float), self.delay_samples),
            time[1] - time[0],
        )
        return self.gain * response + self.offset + self.slope * (time - time[0])


def _denominator(frequency: float, damping: float) -> tuple[float, float, float]:
    return 1.0 / frequency**2, 2.0 * damping / frequency, 1.0


def _respond(frequency: float, damping: float, drive: NDArray, sample_time: float) -> NDArray:
    """Return D(s) drive at the ends of the intervals over which the drive is held, from rest."""
    continuous = ([1.0], _denominator(frequency, damping))
    numerator, denominator, _ = cont2discrete(continuous, sample_time, method="zoh")
    # The drive of sample k is held before sample k: the delay that zoh puts in is not there.
    change = drive - drive[0]
    return drive[0] + lfilter(numerator.ravel()[1:], denominator, change)


def _delayed(drive: NDArray, samples: int) -> NDArray:
    """Return the drive `samples` later; before its beginning it was what it is there."""
    return np.concatenate((np.full(samples, drive[0]), drive[: len(drive) - samples]))


def identify_dynamics(measurement: Measurement, drive: ArrayLike) -> DynamicsModel:
    """Identify natural frequency, damping ratio, gain and delay from a step or a sweep of `drive`.

    Parameters
    ----------
    measurement : evenly sampled, well above twice the natural frequency
    drive : 1-D array as long as the measurement: tip force (N), static deflection (m), voltage (V)

    Raises
    ------
    MeasurementError
        If the deflection is constant, the sampling uneven, or no vibration is found below the
        Nyquist frequency.
    """
    measurement.need_varying("deflection")
    measurement.need_even_sampling()
    drive = np.asarray(drive, float)
    if np.ptp(drive) == 0.0:
        raise MeasurementError(f"{measurement.source}: the drive is constant")
    sample_time = measurement.sample_time
    time = measurement.time - measurement.time[0]
    columns = np.column_stack((np.ones_like(time), time))

    def regressors(frequency: float, damping: float, delay: int) -> NDArray:
        response = _respond(frequency, damping, _delayed(drive, delay), sample_time)
        return np.column_stack((response, columns))

    def linear(frequency: float, damping: float, delay: int) -> tuple[NDArray, NDArray]:
        matrix = regressors(frequency, damping, delay)
        scale = column_norms(matrix)
        x = np.linalg.lstsq(matrix / scale, measurement.deflection, rcond=None)[0] / scale
        return x, measurement.deflection - matrix @ x

    lowest, nyquist = 2.0 * math.pi / time[-1], math.pi / sample_time
    start = min(
        ((w, d) for w in np.geomspace(lowest, 0.98 * nyquist, FREQUENCIES)
         for d in DAMPING_RATIOS),
        key=lambda guess: float(np.sum(linear(guess[0], guess[1], 0)[1] ** 2)),
    )  # fmt: skip
    spread = float(np.std(measurement.deflection))
    # A delay looks like damping, so it is searched with the rest. Each search begins where the one
    # with a sample less ended.
    best, logs = None, np.log(start)
    for delay in range(LONGEST_DELAY + 1):
        found = least_squares(
            lambda x, delay=delay: linear(math.exp(x[0]), math.exp(x[1]), delay)[1] / spread,
            logs,
            bounds=np.log([(0.1 * lowest, 1e-6), (10.0 * nyquist, 1e2)]),
            x_scale=(1e-3, 1e-1),
        )
        logs = found.x
        if best is None or found.cost < best[0]:
            best = found.cost, delay, np.exp(found.x).tolist()
    assert best is not None
    _, delay, (frequency, damping) = best
    if frequency >= nyquist:
        raise MeasurementError(
            f"{measurement.source}: no vibration below the Nyquist frequency of "
            f"{0.5 / sample_time:g} Hz; sample faster"
        )
    x, residual = linear(frequency, damping, delay)
    fitted = np.concatenate(([frequency, damping], x))
    here = regressors(frequency, damping, delay)
    moved = (
        regressors((1.0 + STEP) * frequency, damping, delay),
        regressors(frequency, (1.0 + STEP) * damping, delay),
    )
    by_vibration = [(m - here) @ x / (STEP * v) for m, v in zip(moved, (frequency, damping))]
    jacobian = np.column_stack((*by_vibration, here))

    def values(numbers: NDArray) -> Values:
        return {
            "natural_frequency_hz": numbers[0] / (2.0 * math.pi),
            "damping_ratio": numbers[1],
            "denominator": _denominator(numbers[0], numbers[1]),
            "gain": numbers[2],
        }

    confidence = intervals(values, fitted, jacobian, residual)
    gain, offset, slope = x.tolist()
    return DynamicsModel(frequency, damping, gain, offset, slope, delay, confidence)


def need_vibration(measurement: Measurement, drive: ArrayLike, model: DynamicsModel) -> None:
    """Raise MeasurementError where a resonance is not seen, as in slow loops, whose width it takes for damping.

    Within half an octave of the natural frequency, the model has to explain what was measured.
    """
    modelled = model.deflection(measurement.time, drive)
    frequency = np.fft.rfftfreq(modelled.size - 1, measurement.sample_time)
    ratio = frequency / (model.natural_frequency / (2.0 * math.pi))
    around = np.abs(ratio - 1.0) <= max(np.sqrt(2.0) - 1.0, 2.0 * ratio[1])

    def rms(values: NDArray) -> float:
        return float(np.linalg.norm(np.fft.rfft(np.diff(values))[around]))

    left = rms(measurement.deflection - modelled) / rms(measurement.deflection)
    if left > LARGEST_LEFT:
        raise MeasurementError(
            f"{measurement.source}: the fit has its resonance at {model.natural_frequency / (2.0 * math.pi):.4g} Hz, and "
            f"leaves {100.0 * left:.0f} % of what was measured around it, must be at most {100.0 * LARGEST_LEFT:g} %: no "
            "vibration is seen; drive the finger with a step or a sweep"
        )
