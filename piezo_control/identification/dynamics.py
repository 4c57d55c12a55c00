# SPDX-License-Identifier: Apache-2.0
"""Identification of D(s) = 1 / (a2 s^2 + a1 s + 1), of higher modes beside it, and of the gain in front of them.

The model's output is compared, not its equation, so noise does not bias the damping::

    deflection = sum_i gain_i D_i(s) z^-delay drive + offset + slope t

`drive` is held from sample to sample (exact zero-order hold); natural frequencies, damping ratios and a delay of
whole samples are searched, the rest is linear least squares. With the tip force as drive the gain is the elastic
constant s_p, with the hysteresis operator's output it should be 1.

A mode is added as long as the evidence is for it: G. Schwarz's criterion n ln(sum of squares) + k ln n (Annals of
Statistics 6 (1978) 461), k = 3 numbers per mode, n the samples over the memory of what is left, falls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from piezo_control.dynamics import propagator
from piezo_control.identification.confidence import Values, intervals, memory
from piezo_control.identification.fit import column_norms
from piezo_control.identification.measurement import Measurement, MeasurementError

FREQUENCIES = 150  # tried before the search, from one cycle in the measurement to Nyquist
LONGEST_DELAY = 8  # samples
LARGEST_LEFT = 0.5  # of what was measured around the resonance
STEP = 1e-6  # relative, of a derivative
DAMPING_RATIOS = (0.005, 0.03, 0.2, 0.9)
LIGHT_DAMPING = (0.005, 0.03, 0.2)  # of higher modes
NUMBERS_PER_MODE = 3
HIGHER = 1.2  # times the first natural frequency: lower ones would take creep for a vibration


class Mode(NamedTuple):
    """A mode of the vibration."""

    natural_frequency: float  # rad/s
    damping_ratio: float
    share: float  # of the gain


@dataclass(frozen=True)
class DynamicsModel:
    """Second-order dynamics, and higher modes beside them, behind a static gain."""

    natural_frequency: float  # rad/s
    damping_ratio: float
    gain: float  # m per unit of the drive
    offset: float  # m
    slope: float  # m/s
    delay_samples: int  # from the drive to the deflection, beyond how they are paired
    modes: tuple[Mode, ...] = ()  # above the first
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name

    @property
    def denominator(self) -> tuple[float, float, float]:
        """Coefficients a2, a1, 1 of D(s), highest power first."""
        return _denominator(self.natural_frequency, self.damping_ratio)

    def deflection(self, time: ArrayLike, drive: ArrayLike) -> NDArray[np.float64]:
        """Return the deflection (m) at evenly spaced `time` (s) from rest at drive[0]."""
        time = np.asarray(time, float)
        delayed = _delayed(np.asarray(drive, float), self.delay_samples)
        first = 1.0 - sum(mode.share for mode in self.modes)
        modes = (Mode(self.natural_frequency, self.damping_ratio, first), *self.modes)
        response = sum(m.share * _respond(m[0], m[1], delayed, time[1] - time[0]) for m in modes)
        return self.gain * response + self.offset + self.slope * (time - time[0])


def _denominator(frequency: float, damping: float) -> tuple[float, float, float]:
    return 1.0 / frequency**2, 2.0 * damping / frequency, 1.0


def _respond(frequency: float, damping: float, drive: NDArray, sample_time: float) -> NDArray:
    """Return D(s) drive at the ends of the intervals over which the drive is held, from rest."""
    inertia, friction, stiffness = _denominator(frequency, damping)
    free = propagator(inertia, friction, stiffness, sample_time)
    towards = 1.0 - free.xx, -free.vx  # what a drive of 1 adds to position and speed
    numerator = towards[0], free.xv * towards[1] - free.vv * towards[0]
    denominator = 1.0, -free.xx - free.vv, free.xx * free.vv - free.xv * free.vx
    return drive[0] + lfilter(numerator, denominator, drive - drive[0])


def _delayed(drive: NDArray, samples: int) -> NDArray:
    """Return the drive `samples` later; before its beginning it was what it is there."""
    return np.concatenate((np.full(samples, drive[0]), drive[: len(drive) - samples]))


def identify_dynamics(
    measurement: Measurement, drive: ArrayLike, most_modes: int = 1
) -> DynamicsModel:
    """Identify natural frequencies, damping ratios, gain and delay from a step or a sweep of `drive`.

    Parameters
    ----------
    measurement : evenly sampled, well above twice the natural frequency
    drive : 1-D array as long as the measurement: tip force (N), static deflection (m), voltage (V)
    most_modes : so many are tried; those remain that the measurement is evidence for

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
    problem = _Problem(measurement, drive)
    # A delay looks like damping, so it is searched with the rest. Each search begins where the one
    # with a sample less ended.
    fits = [problem.refined(problem.begun([], DAMPING_RATIOS, 0), 0)]
    for delay in range(1, LONGEST_DELAY + 1):
        fits.append(problem.refined(fits[-1].modes, delay))
    best = min(fits, key=lambda fit: fit.squares)
    if best.modes[0][0] >= problem.nyquist:
        raise MeasurementError(
            f"{measurement.source}: no vibration below the Nyquist frequency of "
            f"{0.5 / measurement.sample_time:g} Hz; sample faster"
        )
    while len(best.modes) < most_modes:
        more = problem.begun(best.modes, LIGHT_DAMPING, best.delay)
        near = range(max(best.delay - 1, 0), best.delay + 2)
        found = min((problem.refined(more, delay) for delay in near), key=lambda fit: fit.squares)
        if not problem.is_evidence(best, found):
            break
        best = found
    return problem.model(best)


class _Fit(NamedTuple):
    """Modes as pairs of natural frequency (rad/s) and damping ratio, and the squares that they leave."""

    modes: list[tuple[float, float]]
    delay: int
    squares: float


class _Problem:
    """Least squares over the modes of a measurement."""

    def __init__(self, measurement: Measurement, drive: NDArray) -> None:
        self.deflection, self.drive = measurement.deflection, drive
        self.sample_time = measurement.sample_time
        time = measurement.time - measurement.time[0]
        self.columns = np.column_stack((np.ones_like(time), time))
        self.lowest, self.nyquist = 2.0 * math.pi / time[-1], math.pi / self.sample_time

    def regressors(self, modes: Sequence[tuple[float, float]], delay: int) -> NDArray:
        """Return the responses of the modes, 1 and the time."""
        delayed = _delayed(self.drive, delay)
        responses = [_respond(w, d, delayed, self.sample_time) for w, d in modes]
        return np.column_stack((*responses, self.columns))

    def linear(self, modes: Sequence[tuple[float, float]], delay: int) -> tuple[NDArray, NDArray]:
        """Return the gains, offset and slope with the least squares, and what is left."""
        matrix = self.regressors(modes, delay)
        scale = column_norms(matrix)
        x = np.linalg.lstsq(matrix / scale, self.deflection, rcond=None)[0] / scale
        return x, self.deflection - matrix @ x

    def begun(
        self, modes: list[tuple[float, float]], damping: Sequence[float], delay: int
    ) -> list[tuple[float, float]]:
        """Return the modes with the best one of a grid beside them, above the first."""
        lowest = HIGHER * modes[0][0] if modes else self.lowest
        grid = np.geomspace(lowest, max(lowest, 0.98 * self.nyquist), FREQUENCIES)
        trials = [[*modes, (w, d)] for w in grid.tolist() for d in damping]
        return min(trials, key=lambda trial: float(np.sum(self.linear(trial, delay)[1] ** 2)))

    def refined(self, modes: Sequence[tuple[float, float]], delay: int) -> _Fit:
        """Return the best modes near these."""
        spread = float(np.std(self.deflection))

        def left(logs: NDArray) -> NDArray:
            return self.linear(np.exp(logs).reshape(-1, 2).tolist(), delay)[1] / spread

        bounds = np.log([(0.1 * self.lowest, 1e-6), (10.0 * self.nyquist, 1e2)])
        found = least_squares(
            left,
            np.log(modes).ravel(),
            bounds=np.tile(bounds, len(modes)),
            x_scale=np.tile((1e-3, 1e-1), len(modes)),
        )
        pairs = sorted(map(tuple, np.exp(found.x).reshape(-1, 2).tolist()))
        return _Fit(pairs, delay, 2.0 * found.cost * spread**2)

    def is_evidence(self, fewer: _Fit, more: _Fit) -> bool:
        """Tell whether a measurement is evidence for one mode more, one that vibrates, above the first."""
        left = self.linear(more.modes, more.delay)[1]
        samples = left.size / memory(left)
        gained = samples * math.log(fewer.squares / more.squares) if more.squares > 0.0 else 0.0
        first = more.modes[0][0] / fewer.modes[0][0]
        higher = all(d < 1.0 and w < self.nyquist for w, d in more.modes[1:])
        return (
            higher
            and 1.0 / HIGHER < first < HIGHER
            and gained > NUMBERS_PER_MODE * math.log(samples)
        )

    def model(self, fit: _Fit) -> DynamicsModel:
        """Return the model with its intervals."""
        modes, delay = fit.modes, fit.delay
        x, residual = self.linear(modes, delay)
        here = self.regressors(modes, delay)
        vibrations = np.array(modes).ravel()
        moved = []
        for i, value in enumerate(vibrations):
            after = vibrations * np.where(np.arange(vibrations.size) == i, 1.0 + STEP, 1.0)
            change = self.regressors(after.reshape(-1, 2).tolist(), delay) - here
            moved.append(change @ x / (STEP * value))
        count = len(modes)

        def values(numbers: NDArray) -> Values:
            pairs, gains = numbers[: 2 * count].reshape(-1, 2), numbers[2 * count : 3 * count]
            (frequency, damping), higher = pairs[0], pairs[1:]
            found: dict[str, float | tuple[float, ...]] = {
                "natural_frequency_hz": frequency / (2.0 * math.pi),
                "damping_ratio": damping,
                "denominator": _denominator(frequency, damping),
                "gain": gains.sum(),
            }
            if count > 1:
                found["modes.frequency_hz"] = tuple(higher[:, 0] / (2.0 * math.pi))
                found["modes.damping"] = tuple(higher[:, 1])
                found["modes.share"] = tuple(gains[1:] / gains.sum())
            return found

        fitted = np.concatenate((vibrations, x))
        confidence = intervals(values, fitted, np.column_stack((*moved, here)), residual)
        *gains, offset, slope = x.tolist()
        gain = sum(gains)
        higher = tuple(Mode(w, d, g / gain) for (w, d), g in zip(modes[1:], gains[1:]))
        return DynamicsModel(*modes[0], gain, offset, slope, delay, higher, confidence)


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
