# SPDX-License-Identifier: Apache-2.0
"""Preview: a reference that is known ahead is followed, not run after.

The loop answers a reference by T(z), late and above its bandwidth too little. A profile travels ahead, so
what comes is known, and the loop can be given

    r'_k = sum_j h_j r_{k+j},   j = -past ... future,

with taps of both directions for which T H is 1 up to `band`: weighted least squares on the unit circle,
with H small above the band, so that the resonance is left alone, and sum_j h_j = 1, so that a rest stays
where it is. A set-point says nothing ahead: it is a constant, and asked for as it is. The feedback law is the
same as without: margins, certificate and coefficients do not change.

Source: Tomizuka, ASME J. Dynamic Systems, Measurement, and Control 109 (1987) 65 (zero phase error tracking);
least squares in its place, because the sampled loop has zeros outside the unit circle.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piezo_control.design.linear_loop import controller_response, finger_response, fingers
from piezo_control.design.problem import FingerModel
from piezo_control.feedback import FeedbackParameters
from piezo_control.profile import Signal

FUTURE = 120  # samples
PAST = 40
POINTS = 400  # on the unit circle, for the band and for the rest each
QUIET = 0.03  # weight of a small H above the band
RIDGE = 1e-6


@functools.lru_cache(maxsize=16)
def preview_taps(
    model: FingerModel, controller: FeedbackParameters, band_hz: float
) -> tuple[float, ...]:
    """Return h, from -PAST to FUTURE, for the nominal finger; followed is what is below `band_hz`."""
    step = model.sample_time
    lags = np.arange(-PAST, FUTURE + 1)
    band = 2.0 * np.pi * band_hz * step * np.linspace(0.0, 1.0, POINTS)
    z = np.exp(1j * np.maximum(band, 1e-6))
    feedback, reference = controller_response(controller, z)
    plant = finger_response(fingers(model), z)[0]
    # The tip, not its late reading, is to be where the reference is.
    tip = (feedback + reference) * plant * z**model.delay_samples / (1.0 + feedback * plant)
    rest = np.exp(1j * np.linspace(2.0 * band[-1], np.pi, POINTS))
    rows = np.vstack([tip[:, None] * z[:, None] ** lags, QUIET * rest[:, None] ** lags])
    wanted = np.concatenate([np.ones(POINTS), np.zeros(POINTS)])
    # Real taps, with their sum as one more row that counts for all others.
    a = np.vstack([rows.real, rows.imag, 1e3 * np.ones(lags.size), RIDGE * np.eye(lags.size)])
    b = np.concatenate([wanted.real, np.zeros(2 * POINTS), [1e3], np.zeros(lags.size)])
    taps = np.linalg.lstsq(a, b, rcond=None)[0]
    return tuple((taps / taps.sum()).tolist())


class Previewed:
    """What a controller is asked so that the tip follows `signal`; itself a signal, at its samples.

    Summed tap by tap, so that the values do not depend on how many are asked for at once.
    """

    def __init__(self, signal: Signal, taps: tuple[float, ...], sample_time: float) -> None:
        self.signal = signal
        self.taps = taps
        self.sample_time = sample_time

    @property
    def largest(self) -> float:
        """Size that no value exceeds."""
        return self.signal.largest * sum(map(abs, self.taps))

    def at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the values at the samples nearest to `time` (s, 1-D)."""
        numbers = np.rint(np.asarray(time) / self.sample_time).astype(np.int64)
        first = int(numbers.min()) - PAST
        known = np.arange(first, int(numbers.max()) + FUTURE + 1)
        # Before the run began the finger was where it begins.
        values = self.signal.at(np.maximum(known, 0) * self.sample_time)
        total = np.zeros(len(numbers))
        for j, tap in enumerate(self.taps):
            total += tap * values[numbers - first - PAST + j]
        return total


def asked(signal: Signal, controller: FeedbackParameters) -> Signal:
    """Return what `controller` has to be asked for the tip to be at `signal`, by its `preview_band`."""
    p = controller
    if not p.preview_band or p.controller == "none":
        return signal
    model = FingerModel(sample_time=p.sample_time, delay_samples=p.delay_samples)
    if p.denominator:
        model = replace(model, denominator=p.denominator)
    return Previewed(signal, preview_taps(model, p, p.preview_band), p.sample_time)
