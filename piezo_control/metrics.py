# SPDX-License-Identifier: Apache-2.0
"""Figures that describe a response: settling, overshoot, static error, loop width, band, rejection.

Every figure is defined in its docstring. Times of a step response are measured from the step, its
relative figures are fractions (0.05 is 5 %) of the step, that is of the change of the reference.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class StepMetrics(NamedTuple):
    """Figures of a step response, or arrays of them, see :func:`step_metrics`."""

    settling_5_reference_s: Any
    settling_2_reference_s: Any
    settling_5_final_s: Any
    settling_2_final_s: Any
    rise_s: Any
    overshoot: Any
    static_error: Any
    final: Any


def settling_time(time: ArrayLike, value: ArrayLike, target: ArrayLike, band: ArrayLike) -> Any:
    """Return the time from time[0] after which ``|value - target| <= band`` for good, in s.

    It is the instant of the first sample from which on all samples are inside the band; infinite
    when the last sample is outside. `time` is a 1-D array with shape (nsamples,), `value` one with shape
    (..., nsamples), `target` and `band`, in the unit of `value`, and the result have shape (...).
    """
    time = np.asarray(time, dtype=float)
    distance = np.abs(np.asarray(value, dtype=float) - np.expand_dims(target, -1))
    outside = ~(distance <= np.expand_dims(band, -1))
    settled = time.size - np.argmax(outside[..., ::-1], axis=-1)  # first sample inside for good
    settled = np.where(outside.any(axis=-1), settled, 0)
    late = outside[..., -1]
    return np.where(late, np.inf, time[np.where(late, 0, settled)] - time[0])[()]


def step_metrics(
    time: ArrayLike, value: ArrayLike, reference: float, initial: float = 0.0, tail: float = 0.1
) -> StepMetrics:
    """Return the figures of the response to a step of the reference.

    Parameters
    ----------
    time, value : array_like
        Arrays with shape (nsamples,) in s and (..., nsamples) in m; time[0] is the instant of the step.
    reference, initial : float
        Value of the reference after and before the step, in m. Their difference is the step.
    tail : float
        Fraction of the record, at its end, whose mean is the final value.

    Returns
    -------
    StepMetrics
        of shape (...):

        * ``settling_5_reference_s``, ``settling_2_reference_s``: settling into 5 % and 2 % of the
          step around the **reference**, so a static error above the band never settles;
        * ``settling_5_final_s``, ``settling_2_final_s``: the same around the **final value**, the
          band a fraction of the change from `initial` to it (the usual definition, and the one by
          which the paper's controller needs 13.3 ms);
        * ``rise_s``: from the first crossing of 10 % to that of 90 % of the change to the final
          value, between samples by linear interpolation; infinite when 90 % is never reached;
        * ``overshoot``: how far the response exceeds the **reference**, as a fraction of the step,
          0 when it never does;
        * ``static_error``: ``|reference - final| / |step|``;
        * ``final``: the final value in m.

    Raises ValueError when the step is zero or the arrays do not fit together.
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    step = reference - initial
    if time.ndim != 1 or time.shape != value.shape[-1:] or time.size < 2:
        raise ValueError(
            f"time {time.shape} must be 1-D, as long as the last axis of value {value.shape}, 2 or more"
        )
    if step == 0.0:
        raise ValueError("reference and initial are equal: there is no step")
    progress = (value - initial) / step
    final = np.mean(progress[..., -max(1, round(tail * time.size)) :], axis=-1)
    return StepMetrics(
        settling_5_reference_s=settling_time(time, progress, 1.0, 0.05),
        settling_2_reference_s=settling_time(time, progress, 1.0, 0.02),
        settling_5_final_s=settling_time(time, progress, final, 0.05 * abs(final)),
        settling_2_final_s=settling_time(time, progress, final, 0.02 * abs(final)),
        rise_s=_first_crossing(time, progress, 0.9 * final)
        - _first_crossing(time, progress, 0.1 * final),
        overshoot=np.maximum(0.0, np.max(progress, axis=-1) - 1.0),
        static_error=abs(1.0 - final),
        final=initial + step * final,
    )


def _first_crossing(time: np.ndarray, value: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return when `value`, shape (..., nsamples), first reaches `level`, shape (...); infinite if never."""
    above = value * np.sign(level)[..., None] >= abs(level)[..., None]
    after = np.argmax(above, axis=-1)
    before = np.maximum(after - 1, 0)
    low, high = (np.take_along_axis(value, i[..., None], axis=-1)[..., 0] for i in (before, after))
    rise = np.where(after > before, high - low, 1.0)
    crossing = time[before] + (level - low) / rise * (time[after] - time[before])
    return np.where(above.any(axis=-1), crossing, np.inf)


class Ringing(NamedTuple):
    """Free vibration, see :func:`ringing`."""

    frequency_hz: float
    damping_ratio: float


def ringing(time: ArrayLike, value: ArrayLike, least: float = 0.05) -> Ringing:
    """Return frequency and damping ratio of a vibration that dies away.

    The vibration is the difference from the mean of the last tenth of the record. Its frequency is that
    of its zero crossings, between samples by linear interpolation; its damping ratio follows from the
    slope of log(extreme) from half-wave to half-wave (logarithmic decrement), both over the half-waves
    whose extreme is at least `least` of the largest one. 1-D arrays with shape (nsamples,); `time` in s.

    Raises ValueError when there are fewer than four such half-waves.
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    swing = value - np.mean(value[-max(1, time.size // 10) :])
    before = np.flatnonzero(np.diff(np.signbit(swing)))
    part = swing[before] / (swing[before] - swing[before + 1])
    crossing = time[before] + part * (time[before + 1] - time[before])
    extreme = np.array([np.max(np.abs(swing[i + 1 : j + 1])) for i, j in zip(before, before[1:])])
    count = int(np.argmin(np.append(extreme >= least * np.max(extreme, initial=0.0), False)))
    if count < 4:
        raise ValueError(f"the record has {count} half-waves of a vibration, needs 4 or more")
    decrement = -np.polyfit(np.arange(count), np.log(extreme[:count]), 1)[0] / np.pi
    return Ringing(
        frequency_hz=float(count / (2.0 * (crossing[count] - crossing[0]))),
        damping_ratio=float(decrement / np.hypot(1.0, decrement)),
    )


def drift(time: ArrayLike, value: ArrayLike, begin: float, average: float) -> float:
    """Return the change of `value` from time[0] + `begin` to the end, in its unit: creep.

    Both are means over `average` seconds: the ones that follow `begin`, and the last ones.
    Raises ValueError when the record is not longer than that.
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    since = time - time[0]
    if since[-1] < begin + average:
        raise ValueError(
            f"{since[-1]:g} s follow the step, creep needs {begin + average:g} s or more"
        )
    first = value[(since >= begin) & (since < begin + average)]
    last = value[since > since[-1] - average]
    return float(np.mean(last) - np.mean(first))


class LoopMetrics(NamedTuple):
    """Figures of a loop, see :func:`loop_metrics`."""

    width: float
    relative_width: float
    slope: float
    peak_to_peak: float


def last_cycle(drive: ArrayLike) -> slice:
    """Return the samples of the last cycle of a periodic signal, from its maximum to its maximum.

    A maximum is the middle of the samples in a row that are within 0.1 % of the range below the highest
    value. Raises ValueError when there are fewer than two.
    """
    drive = np.asarray(drive, dtype=float)
    high = drive >= np.max(drive) - 1e-3 * np.ptp(drive)
    edges = np.flatnonzero(np.diff(high.astype(int), prepend=0, append=0))
    tops = (edges[::2] + edges[1::2] - 1) // 2
    if tops.size < 2:
        raise ValueError(f"the signal has {tops.size} maxima, a cycle needs two")
    return slice(int(tops[-2]), int(tops[-1]) + 1)


def loop_metrics(drive: ArrayLike, value: ArrayLike) -> LoopMetrics:
    """Return the figures of one cycle, `value` over `drive`, from maximum to maximum of `drive`.

    Parameters
    ----------
    drive, value : array_like
        1-D arrays with shape (nsamples,): voltage or reference, and deflection; `drive` has to fall to
        its minimum and to rise from there.

    Returns
    -------
    LoopMetrics
        * ``width``: largest difference of `value` between the two branches at equal `drive`;
        * ``relative_width``: the same as a fraction of ``peak_to_peak``;
        * ``slope``: of the straight line with the least squared error through all samples;
        * ``peak_to_peak``: range of `value`.
    """
    drive = np.asarray(drive, dtype=float)
    value = np.asarray(value, dtype=float)
    turn = int(np.argmin(drive))
    low, high = drive[turn], min(drive[0], drive[-1])
    grid = np.linspace(low, high, 2001)
    falling = np.interp(grid, drive[turn::-1], value[turn::-1])
    rising = np.interp(grid, drive[turn:], value[turn:])
    width = float(np.max(np.abs(falling - rising)))
    spread = float(np.ptp(value))
    slope = float(np.polyfit(drive, value, 1)[0])
    return LoopMetrics(width, width / spread, slope, spread)


class FrequencyResponse(NamedTuple):
    """Measured response: 1-D arrays of angular frequency (rad/s) and complex gain."""

    frequency: np.ndarray
    gain: np.ndarray

    @property
    def magnitude_db(self) -> np.ndarray:
        """Magnitude in dB."""
        return 20.0 * np.log10(np.abs(self.gain))


def frequency_response(
    time: ArrayLike, drive: ArrayLike, value: ArrayLike, least: float = 1e-2
) -> FrequencyResponse:
    """Return the response of `value` to `drive` at the frequencies that `drive` contains.

    When the second half of `drive` repeats the first (a multisine of two periods) the second halves are
    transformed: value(jw) / drive(jw) at the lines of `drive` that reach `least` of its highest one;
    nothing leaks between lines, and the first half lets the transient die away. Any other `drive` (a
    chirp, noise) gives the H1 estimate, cross spectrum by auto spectrum, of segments of a quarter of
    the record (Welch, Hann window, half overlapping), where the auto spectrum reaches ``least**2`` of
    its highest value. 1-D arrays with shape (nsamples,), evenly spaced in time (s).
    """
    time = np.asarray(time, dtype=float)
    drive = np.asarray(drive, dtype=float)
    value = np.asarray(value, dtype=float)
    spacing = float(time[-1] - time[0]) / (time.size - 1)
    half = time.size // 2
    repeats = np.allclose(drive[:half], drive[half : 2 * half], rtol=0.0, atol=1e-6 * np.ptp(drive))
    if repeats:
        frequency = np.fft.rfftfreq(half, spacing)
        given, got = (np.fft.rfft(signal[half : 2 * half]) for signal in (drive, value))
        strength = np.abs(given)
    else:
        from scipy.signal import csd, welch

        segments = {"fs": 1.0 / spacing, "nperseg": time.size // 4}
        frequency, given = welch(drive, **segments)
        got = csd(drive, value, **segments)[1]
        strength = np.sqrt(given)
    strong = strength >= least * np.max(strength[1:])
    strong[0] = False
    return FrequencyResponse(2.0 * np.pi * frequency[strong], got[strong] / given[strong])


def bandwidth(response: FrequencyResponse, level_db: float = -3.0) -> float:
    """Return the angular frequency (rad/s) at which the magnitude first falls below `level_db`.

    The level counts from the magnitude at the lowest frequency; between lines the magnitude in dB is a
    straight line over log(frequency). Infinite when the magnitude stays above.
    """
    magnitude = response.magnitude_db - response.magnitude_db[0] - level_db
    below = np.flatnonzero(magnitude < 0.0)
    if below.size == 0:
        return float("inf")
    i = below[0]
    part = magnitude[i - 1] / (magnitude[i - 1] - magnitude[i])
    low, high = np.log(response.frequency[i - 1 : i + 1])
    return float(np.exp(low + part * (high - low)))


class DisturbanceMetrics(NamedTuple):
    """Figures of a held value under a disturbance, see :func:`disturbance_metrics`."""

    change: float
    excursion: float
    rejection: float
    remaining: float
    recovery_s: float


def disturbance_metrics(
    time: ArrayLike,
    value: ArrayLike,
    disturbance: ArrayLike,
    average: float = 0.0,
    window: float = 0.02,
) -> DisturbanceMetrics:
    """Return what a disturbance (temperature, force) does to a value that is to be held.

    Parameters
    ----------
    time, value, disturbance : array_like
        1-D arrays with shape (nsamples,). The disturbance begins with its first change; the value held
        is the mean of the `window` seconds before.
    average : float
        Seconds of a moving average of `value`, against sensor noise where the disturbance is slow.

    Returns
    -------
    DisturbanceMetrics
        * ``change``: the change of the disturbance furthest from its first value;
        * ``excursion``: largest distance of `value` from the value held, from the beginning on;
        * ``rejection``: excursion per unit of the change (m/°C, m/N), so smaller is better;
        * ``remaining``: mean of the last `window` seconds minus the value held;
        * ``recovery_s``: time from the beginning until `value` stays within 5 % of the excursion around
          that last mean; infinite when it does not.

    Raises ValueError when the disturbance does not change, or at once.
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    departure = np.asarray(disturbance, dtype=float) - disturbance[0]
    begin = int(np.argmax(departure != 0.0))
    if begin == 0:
        raise ValueError("the disturbance does not change after the first sample")
    rate = (time.size - 1) / (time[-1] - time[0])
    steady = max(1, round(window * rate))
    held = np.mean(value[max(0, begin - steady) : begin])
    last = np.mean(value[-steady:])
    count = max(1, round(average * rate))
    after = np.convolve(value[begin:], np.full(count, 1.0 / count), mode="valid")
    excursion = float(np.max(np.abs(after - held)))
    change = float(departure[np.argmax(np.abs(departure))])
    late = time[begin + count - 1 :]
    recovery = late[0] - time[begin] + settling_time(late, after, last, 0.05 * excursion)
    return DisturbanceMetrics(
        change, excursion, excursion / abs(change), float(last - held), float(recovery)
    )


def rms(value: ArrayLike) -> float:
    """Return the root mean square of `value`, in its unit."""
    return float(np.sqrt(np.mean(np.square(np.asarray(value, dtype=float)))))
