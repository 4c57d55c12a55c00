# SPDX-License-Identifier: Apache-2.0
"""Identification of D(s) = 1 / (a2 s^2 + a1 s + 1), of higher modes beside it, and of what is in front of them.

The model's output is compared, not its equation, so noise does not bias the damping::

    deflection = sum_i gain_i D_i(s) z^-delay H(A(z) drive) + offset + slope t,    A(z) = (1 - r) / (1 - r z^-1)

`drive` is held from sample to sample (exact zero-order hold). Natural frequencies, damping ratios and the delay are
searched, the rest is linear least squares. A delay is of whole samples where the criterion below does not tell. With the tip force as drive the gain is the elastic constant
s_p. A voltage goes through the hysteresis operator H, where that is known, and the gain should be 1; only then is
the lag A of an amplifier searched, since hysteresis that is not known is a lag, too. Its output is held from sample to
sample, as the simulated amplifier and the certificate have it: r = exp(-2 pi bandwidth h).

A mode or the lag is added, whichever explains more, as long as the evidence is for it, a mode with a share that
its interval tells from none and well above the first, which has to vibrate, too: G. Schwarz's criterion
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
DELAYS = (0.125, 0.25, 0.5, 1.0)  # periods of the first mode, from which the delay is searched
WHOLE = 0.02  # samples: a delay so near to whole ones has them
ROUNDED_DOWN = 0.2  # samples, by which a delay may be longer than it counts
LARGEST_LEFT = 0.5  # of what was measured around the resonance
STEP = 1e-6  # relative, of a derivative
DAMPING_RATIOS = (0.005, 0.03, 0.2, 0.9)
LIGHT_DAMPING = (0.005, 0.03, 0.2)  # of higher modes
NUMBERS_PER_MODE = 3
MOST_DELAYS = 8  # tried together with a lag
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
    delay: float  # s, from the drive to the deflection, beyond how they are paired
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
        held = _behind(np.asarray(drive, float), rate, static)
        first = 1.0 - sum(mode.share for mode in self.modes)
        modes = (Mode(self.natural_frequency, self.damping_ratio, first), *self.modes)
        late = self.delay / sample_time
        response = sum(m.share * _respond(m[0], m[1], held, sample_time, late) for m in modes)
        return self.gain * response + self.offset + self.slope * (time - time[0])

    def delay_samples(self, sample_time: float) -> int:
        """Return the delay in samples of a loop, rounded up: a reading that is older than it counts is not expected."""
        return max(0, math.ceil(self.delay / sample_time - ROUNDED_DOWN))


def _denominator(frequency: float, damping: float) -> tuple[float, float, float]:
    return 1.0 / frequency**2, 2.0 * damping / frequency, 1.0


def _respond(
    frequency: float, damping: float, drive: NDArray, sample_time: float, delay: float
) -> NDArray:
    """Return D(s) drive, `delay` samples late, at the ends of the intervals over which the drive is held, from rest."""
    inertia, friction, stiffness = _denominator(frequency, damping)
    free = propagator(inertia, friction, stiffness, sample_time)
    towards = 1.0 - free.xx, -free.vx  # what a drive of 1 adds to position and speed
    position = towards[0], free.xv * towards[1] - free.vv * towards[0]
    denominator = 1.0, -free.xx - free.vv, free.xx * free.vv - free.xv * free.vx
    whole = math.floor(delay)
    part = delay - whole
    moved = _delayed(drive, whole) - drive[0]
    response = lfilter(position, denominator, moved)
    if part:
        # The reading falls between two samples: from the one before, on with the drive of this interval.
        speed = towards[1], free.vx * towards[0] - free.xx * towards[1]
        velocity = _delayed(lfilter(speed, denominator, moved), 1)
        short = propagator(inertia, friction, stiffness, (1.0 - part) * sample_time)
        response = moved + short.xx * (_delayed(response, 1) - moved) + short.xv * velocity
        response[0] = 0.0
    return drive[0] + response


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
    # A delay looks like damping, so it is searched with the rest. Each search begins with the mode that the
    # one before ended with.
    fits = [problem.refined(problem.begun(_Chain([], 0.0), DAMPING_RATIOS))]
    period = 2.0 * math.pi / fits[0].chain.modes[0][0] / measurement.sample_time
    for share in DELAYS:
        fits.append(problem.refined(fits[-1].chain._replace(delay=share * period)))
    best = problem.whole(min(fits, key=lambda fit: fit.squares))
    if best.chain.modes[0][0] >= problem.nyquist:
        raise MeasurementError(
            f"{measurement.source}: no vibration below the Nyquist frequency of "
            f"{0.5 / measurement.sample_time:g} Hz; sample faster"
        )
    while True:
        trials = []
        if len(best.chain.modes) < most_modes:
            trials.append(problem.begun(best.chain, LIGHT_DAMPING))
        if static and not best.chain.rate:
            trials.append(problem.lagging(best.chain))
        tried = [problem.whole(problem.refined(chain)) for chain in trials]
        evident = [fit for fit in tried if problem.evidence(best, fit) > 0.0]
        if not evident:
            return problem.model(best.chain)
        fewer = best
        best = max(evident, key=lambda fit: problem.evidence(fewer, fit))


class _Chain(NamedTuple):
    """What is searched: modes as pairs of natural frequency (rad/s) and damping ratio, delay and lag."""

    modes: list[tuple[float, float]]
    delay: float  # samples
    rate: float = 0.0  # of the amplifier's lag, per sample; 0: none

    @property
    def coordinates(self) -> NDArray[np.float64]:
        """What is searched: logarithms of the modes' numbers, the delay, the logarithm of the lag's rate if there is one."""
        lag = [math.log(self.rate)] if self.rate else []
        return np.array(
            [*(math.log(number) for mode in self.modes for number in mode), self.delay, *lag]
        )

    def at(self, coordinates: NDArray[np.float64]) -> _Chain:
        """Return the chain of its kind that has these coordinates."""
        count = 2 * len(self.modes)
        pairs = np.exp(coordinates[:count]).reshape(-1, 2).tolist()
        rate = math.exp(coordinates[-1]) if self.rate else 0.0
        return _Chain([(w, d) for w, d in pairs], float(coordinates[count]), rate)


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
        held = self.behind(chain.rate)
        responses = [_respond(w, d, held, self.sample_time, chain.delay) for w, d in chain.modes]
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
        delays = np.linspace(
            0.0, chain.delay, min(math.ceil(chain.delay), MOST_DELAYS) + 1
        ).tolist()
        modes = [chain.modes]
        if len(chain.modes) == 1:  # without the lag, even the natural frequency may be another one
            grid = np.geomspace(self.lowest, 0.98 * self.nyquist, COARSE_FREQUENCIES).tolist()
            modes += [[(w, LIGHT_DAMPING[1])] for w in grid]
        return self.best(
            [_Chain(pairs, d, rate) for pairs in modes for d in delays for rate in rates]
        )

    def whole(self, fit: _Fit) -> _Fit:
        """Return the fit with a delay of whole samples, unless the evidence is for the part of one."""
        delay = fit.chain.delay
        fits = [
            self.refined(fit.chain._replace(delay=float(n)), moves_delay=False)
            for n in sorted({math.floor(delay), math.ceil(delay)})
        ]
        best = min(fits, key=lambda fit: fit.squares)
        is_whole = abs(best.chain.delay - delay) < WHOLE
        return best if is_whole or self.evidence(best, fit) <= 0.0 else fit

    def refined(self, chain: _Chain, moves_delay: bool = True) -> _Fit:
        """Return the best fit near a chain."""
        spread = float(np.std(self.deflection))
        count = len(chain.modes)
        searched = np.ones(chain.coordinates.size, bool)
        searched[2 * count] = moves_delay

        def there(found: NDArray) -> _Chain:
            coordinates = chain.coordinates
            coordinates[searched] = found
            return chain.at(coordinates)

        low = np.log(
            (*(0.1 * self.lowest, 1e-6) * count, 1.0, 0.1 * self.lowest * self.sample_time)
        )
        high = np.log((*(10.0 * self.nyquist, 1e2) * count, 1.0, 10.0))
        high[2 * count] = 0.5 * self.deflection.size
        scale = np.array((*(1e-3, 1e-1) * count, 1e-1, 1e-1))
        low, high, scale = (values[: searched.size][searched] for values in (low, high, scale))
        found = least_squares(
            lambda coordinates: self.linear(there(coordinates))[1] / spread,
            chain.coordinates[searched],
            bounds=(low, high),
            x_scale=scale,
        )
        refined = there(found.x)
        return _Fit(refined._replace(modes=sorted(refined.modes)), 2.0 * found.cost * spread**2)

    def evidence(self, fewer: _Fit, more: _Fit) -> float:
        """Return by how much the criterion falls with more numbers; 0 if they are no higher mode and no lag."""
        left = self.linear(more.chain)[1]
        samples = left.size / memory(left)
        gained = samples * math.log(fewer.squares / more.squares) if more.squares > 0.0 else 0.0
        modes = len(more.chain.modes) - len(fewer.chain.modes)
        if more.chain.rate > math.pi or modes and not self.are_modes(fewer.chain, more.chain):
            return 0.0
        lags = bool(more.chain.rate) - bool(fewer.chain.rate)
        parts = bool(more.chain.delay % 1.0) - bool(fewer.chain.delay % 1.0)
        return gained - (NUMBERS_PER_MODE * modes + lags + parts) * math.log(samples)

    def are_modes(self, fewer: _Chain, more: _Chain) -> bool:
        """Say whether the modes of `more` are vibrations, the first that of `fewer`, the others above and not nothing."""
        first, *others = more.modes
        if not 1.0 / HIGHER < first[0] / fewer.modes[0][0] < HIGHER:
            return False
        if not all(d < 1.0 for _, d in more.modes):
            return False
        if not all(HIGHER * first[0] < w < self.nyquist for w, _ in others):
            return False
        model = self.model(more)
        half_widths = model.confidence["modes.share"]
        assert isinstance(half_widths, tuple)
        return all(abs(m.share) > half for m, half in zip(model.modes, half_widths))

    def model(self, chain: _Chain) -> DynamicsModel:
        """Return the model with its intervals."""
        x, residual = self.linear(chain)
        here = self.regressors(chain)
        searched = chain.coordinates
        steps = STEP * np.eye(searched.size)
        moved = [(self.regressors(chain.at(searched + step)) - here) @ x / STEP for step in steps]
        count = len(chain.modes)
        if not chain.delay % 1.0:  # a whole number is known
            moved[2 * count] = np.zeros_like(residual)

        def values(numbers: NDArray) -> Values:
            there = chain.at(numbers[: searched.size])
            gains = numbers[searched.size :][:count]
            (frequency, damping), higher = there.modes[0], np.array(there.modes[1:])
            found: dict[str, float | tuple[float, ...]] = {
                "natural_frequency_hz": frequency / (2.0 * math.pi),
                "damping_ratio": damping,
                "denominator": _denominator(frequency, damping),
                "gain": gains.sum(),
                "delay": there.delay * self.sample_time,
            }
            if count > 1:
                found["modes.frequency_hz"] = tuple(higher[:, 0] / (2.0 * math.pi))
                found["modes.damping"] = tuple(higher[:, 1])
                found["modes.share"] = tuple(gains[1:] / gains.sum())
            if chain.rate:
                found["amplifier.bandwidth_hz"] = there.rate / (2.0 * math.pi * self.sample_time)
            return found

        fitted = np.concatenate((searched, x))
        confidence = intervals(values, fitted, np.column_stack((*moved, here)), residual)
        *gains, offset, slope = x.tolist()
        gain = sum(gains)
        first, *others = chain.modes
        higher = tuple(Mode(w, d, g / gain) for (w, d), g in zip(others, gains[1:]))
        bandwidth_hz = chain.rate / (2.0 * math.pi * self.sample_time)
        late = chain.delay * self.sample_time
        return DynamicsModel(*first, gain, offset, slope, late, higher, bandwidth_hz, confidence)


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
