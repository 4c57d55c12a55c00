# SPDX-License-Identifier: Apache-2.0
"""Identification of D(s) = 1 / (a2 s^2 + a1 s + 1), of higher modes beside it, and of what is in front of them.

The model's output is compared, not its equation, so noise does not bias the damping::

    deflection = sum_i gain_i D_i(s) z^-delay H(A(z) drive) + offset + slope t,    A(z) = (1 - r) / (1 - r z^-1)

`drive` is held from sample to sample (exact zero-order hold). Natural frequencies, damping ratios and a delay of whole
samples are searched, the rest is linear least squares. With the tip force as drive the gain is the elastic constant
s_p. A voltage goes through the hysteresis operator H, where that is known, and the gain should be 1; only then is
the lag A of an amplifier searched, since hysteresis that is not known is a lag, too. Its output is held from sample to
sample, as the simulated amplifier and the certificate have it: r = exp(-2 pi bandwidth h).

A mode or the lag is added, whichever explains more, as long as the evidence is for it: G. Schwarz's criterion
n ln(sum of squares) + k ln n (Annals of Statistics 6 (1978) 461), k = 3 numbers per mode and 1 for the lag, n the
samples over the memory of what is left, falls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
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
BANDWIDTHS, COARSE_FREQUENCIES = (
    15,
    40,
)  # of the amplifier and, with it, of the finger, tried before the search
HIGHER = 1.2  # times the first natural frequency: lower ones would take creep for a vibration


Static = Callable[[NDArray[np.float64]], NDArray[np.float64]]


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
    bandwidth_hz: float = 0.0  # of the amplifier's lag; 0: none is seen
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name

    @property
    def denominator(self) -> tuple[float, float, float]:
        """Coefficients a2, a1, 1 of D(s), highest power first."""
        return _denominator(self.natural_frequency, self.damping_ratio)

    def deflection(
        self, time: ArrayLike, drive: ArrayLike, static: Static | None = None
    ) -> NDArray[np.float64]:
        """Return the deflection (m) at evenly spaced `time` (s) from rest at drive[0], through `static`."""
        time = np.asarray(time, float)
        sample_time = (time[-1] - time[0]) / (time.size - 1)
        rate = 2.0 * math.pi * self.bandwidth_hz * sample_time
        held = _delayed(_behind(np.asarray(drive, float), rate, static), self.delay_samples)
        first = 1.0 - sum(mode.share for mode in self.modes)
        modes = (Mode(self.natural_frequency, self.damping_ratio, first), *self.modes)
        response = sum(m.share * _respond(m[0], m[1], held, sample_time) for m in modes)
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


def _behind(drive: NDArray, rate: float, static: Static | None) -> NDArray:
    """Return the drive behind a lag, of which exp(-rate) is left after a sample (0: none), and behind `static`.

    Before its beginning the drive was what it is there.
    """
    if rate:
        left = math.exp(-rate)
        drive = drive[0] + lfilter([1.0 - left], [1.0, -left], drive - drive[0])
    return drive if static is None else static(drive)


def _delayed(drive: NDArray, samples: int) -> NDArray:
    """Return the drive `samples` later; before its beginning it was what it is there."""
    return np.concatenate((np.full(samples, drive[0]), drive[: len(drive) - samples]))


def identify_dynamics(
    measurement: Measurement, drive: ArrayLike, most_modes: int = 1, static: Static | None = None
) -> DynamicsModel:
    """Identify natural frequencies, damping ratios, gain and delay from a step or a sweep of `drive`.

    Parameters
    ----------
    measurement : evenly sampled, well above twice the natural frequency
    drive : 1-D array as long as the measurement: tip force (N), voltage (V)
    most_modes : so many are tried; those remain that the measurement is evidence for
    static : from voltages (V) to static deflections (m); with it the lag of an amplifier is tried

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
    problem = _Problem(measurement, drive, static)
    # A delay looks like damping, so it is searched with the rest. Each search begins where the one
    # with a sample less ended.
    fits = [problem.refined(problem.begun(_Chain([], 0), DAMPING_RATIOS))]
    for delay in range(1, LONGEST_DELAY + 1):
        fits.append(problem.refined(fits[-1].chain._replace(delay=delay)))
    best = min(fits, key=lambda fit: fit.squares)
    if best.chain.modes[0][0] >= problem.nyquist:
        raise MeasurementError(
            f"{measurement.source}: no vibration below the Nyquist frequency of "
            f"{0.5 / measurement.sample_time:g} Hz; sample faster"
        )
    while True:
        trials = []
        if len(best.chain.modes) < most_modes:
            trials.append(problem.near(problem.begun(best.chain, LIGHT_DAMPING)))
        if static and not best.chain.rate:
            trials.append(problem.near(problem.lagging(best.chain)))
        evident = [fit for fit in trials if problem.evidence(best, fit) > 0.0]
        if not evident:
            return problem.model(best.chain)
        fewer = best
        best = max(evident, key=lambda fit: problem.evidence(fewer, fit))


class _Chain(NamedTuple):
    """What is searched: modes as pairs of natural frequency (rad/s) and damping ratio, delay and lag."""

    modes: list[tuple[float, float]]
    delay: int  # samples
    rate: float = 0.0  # of the amplifier's lag, per sample; 0: none

    @property
    def numbers(self) -> NDArray[np.float64]:
        """Those that are searched by their derivatives."""
        return np.array([*(number for mode in self.modes for number in mode), self.rate])

    def moved(self, numbers: NDArray[np.float64]) -> _Chain:
        """Return the chain with other numbers."""
        *pairs, rate = numbers.tolist()
        return self._replace(modes=list(zip(pairs[::2], pairs[1::2])), rate=rate)


class _Fit(NamedTuple):
    """A chain and the squares that it leaves."""

    chain: _Chain
    squares: float


class _Problem:
    """Least squares over the chains that a measurement may have come through."""

    def __init__(self, measurement: Measurement, drive: NDArray, static: Static | None) -> None:
        self.deflection = measurement.deflection
        # The same lags come again and again, and hysteresis takes longer than all the rest.
        self.behind = lru_cache(2 * BANDWIDTHS)(lambda rate: _behind(drive, rate, static))
        self.sample_time = measurement.sample_time
        time = measurement.time - measurement.time[0]
        self.columns = np.column_stack((np.ones_like(time), time))
        self.lowest, self.nyquist = 2.0 * math.pi / time[-1], math.pi / self.sample_time

    def regressors(self, chain: _Chain) -> NDArray:
        """Return the responses of the modes, 1 and the time."""
        held = _delayed(self.behind(chain.rate), chain.delay)
        responses = [_respond(w, d, held, self.sample_time) for w, d in chain.modes]
        return np.column_stack((*responses, self.columns))

    def linear(self, chain: _Chain) -> tuple[NDArray, NDArray]:
        """Return the gains, offset and slope with the least squares, and what is left."""
        matrix = self.regressors(chain)
        scale = column_norms(matrix)
        x = np.linalg.lstsq(matrix / scale, self.deflection, rcond=None)[0] / scale
        return x, self.deflection - matrix @ x

    def best(self, chains: Sequence[_Chain]) -> _Chain:
        """Return the chain that leaves the least squares."""
        return min(chains, key=lambda chain: float(np.sum(self.linear(chain)[1] ** 2)))

    def begun(self, chain: _Chain, damping: Sequence[float]) -> _Chain:
        """Return a chain with the best mode of a grid beside its own, above the first."""
        lowest = HIGHER * chain.modes[0][0] if chain.modes else self.lowest
        grid = np.geomspace(lowest, max(lowest, 0.98 * self.nyquist), FREQUENCIES)
        pairs = [(w, d) for w in grid.tolist() for d in damping]
        return self.best([chain._replace(modes=[*chain.modes, pair]) for pair in pairs])

    def lagging(self, chain: _Chain) -> _Chain:
        """Return a chain with the best lag of a grid, which takes the place of some of the delay or the damping."""
        rates = np.geomspace(self.lowest * self.sample_time, math.pi, BANDWIDTHS).tolist()
        delays = range(chain.delay + 1)
        modes = [chain.modes]
        if len(chain.modes) == 1:  # without the lag, even the natural frequency may be another one
            grid = np.geomspace(self.lowest, 0.98 * self.nyquist, COARSE_FREQUENCIES).tolist()
            modes += [[(w, LIGHT_DAMPING[1])] for w in grid]
        return self.best(
            [_Chain(pairs, d, rate) for pairs in modes for d in delays for rate in rates]
        )

    def near(self, chain: _Chain) -> _Fit:
        """Return the best fit near a chain, whose delay may be a sample off."""
        delays = range(max(chain.delay - 1, 0), chain.delay + 2)
        fits = [self.refined(chain._replace(delay=delay)) for delay in delays]
        return min(fits, key=lambda fit: fit.squares)

    def refined(self, chain: _Chain) -> _Fit:
        """Return the best fit near a chain with its delay."""
        spread = float(np.std(self.deflection))
        count = len(chain.modes)
        searched = np.append(np.ones(2 * count, bool), chain.rate > 0.0)

        def there(logs: NDArray) -> _Chain:
            numbers = np.zeros(searched.size)
            numbers[searched] = np.exp(logs)
            return chain.moved(numbers)

        low, high = np.log(
            [
                (*(0.1 * self.lowest, 1e-6) * count, 0.1 * self.lowest * self.sample_time),
                (*(10.0 * self.nyquist, 1e2) * count, 10.0),
            ]
        )
        found = least_squares(
            lambda logs: self.linear(there(logs))[1] / spread,
            np.log(chain.numbers[searched]),
            bounds=(low[searched], high[searched]),
            x_scale=np.array((*(1e-3, 1e-1) * count, 1e-1))[searched],
        )
        refined = there(found.x)
        return _Fit(refined._replace(modes=sorted(refined.modes)), 2.0 * found.cost * spread**2)

    def evidence(self, fewer: _Fit, more: _Fit) -> float:
        """Return by how much the criterion falls with more numbers; 0 if they are no higher mode and no lag."""
        left = self.linear(more.chain)[1]
        samples = left.size / memory(left)
        gained = samples * math.log(fewer.squares / more.squares) if more.squares > 0.0 else 0.0
        first = more.chain.modes[0][0] / fewer.chain.modes[0][0]
        higher = all(d < 1.0 and w < self.nyquist for w, d in more.chain.modes[1:])
        modes = len(more.chain.modes) - len(fewer.chain.modes)
        another = modes and not 1.0 / HIGHER < first < HIGHER
        if not higher or another or more.chain.rate > math.pi:
            return 0.0
        lags = bool(more.chain.rate) - bool(fewer.chain.rate)
        return gained - (NUMBERS_PER_MODE * modes + lags) * math.log(samples)

    def model(self, chain: _Chain) -> DynamicsModel:
        """Return the model with its intervals."""
        x, residual = self.linear(chain)
        here = self.regressors(chain)
        searched = chain.numbers
        moved = []
        for i, value in enumerate(searched):
            after = searched * np.where(np.arange(searched.size) == i, 1.0 + STEP, 1.0)
            change = self.regressors(chain.moved(after)) - here
            moved.append(change @ x / (STEP * (value or 1.0)))
        count = len(chain.modes)

        def values(numbers: NDArray) -> Values:
            modes, rate = numbers[: 2 * count].reshape(-1, 2), numbers[2 * count]
            gains = numbers[2 * count + 1 :][:count]
            (frequency, damping), higher = modes[0], modes[1:]
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
            if chain.rate:
                found["amplifier.bandwidth_hz"] = rate / (2.0 * math.pi * self.sample_time)
            return found

        fitted = np.concatenate((searched, x))
        confidence = intervals(values, fitted, np.column_stack((*moved, here)), residual)
        *gains, offset, slope = x.tolist()
        gain = sum(gains)
        first, *others = chain.modes
        higher = tuple(Mode(w, d, g / gain) for (w, d), g in zip(others, gains[1:]))
        bandwidth_hz = chain.rate / (2.0 * math.pi * self.sample_time)
        return DynamicsModel(
            *first, gain, offset, slope, chain.delay, higher, bandwidth_hz, confidence
        )


def need_vibration(
    measurement: Measurement, drive: ArrayLike, model: DynamicsModel, static: Static | None = None
) -> None:
    """Raise MeasurementError where a resonance is not seen, as in slow loops, whose width it takes for damping.

    Within half an octave of the natural frequency, the model has to explain what was measured.
    """
    modelled = model.deflection(measurement.time, drive, static)
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
