# SPDX-License-Identifier: Apache-2.0
"""Preview: a reference that is known ahead is followed, not run after.

The loop answers a reference by T(z), late and above its bandwidth too little. A profile travels ahead, so
what comes is known, and the loop can be given

    r'_k = sum_j h_j r_{k+j},   j = -past ... future,

with taps of both directions for which T H is 1 up to `band`: weighted least squares on the unit circle,
with H small above the band, so that the resonance is left alone, and sum_j h_j = 1, so that a rest stays
where it is. The feedback law is the same as without: margins, certificate and file do not change.

Source: Tomizuka, ASME J. Dynamic Systems, Measurement, and Control 109 (1987) 65 (zero phase error tracking);
least squares in its place, because the sampled loop has zeros outside the unit circle.
"""

from __future__ import annotations

import numpy as np

from piezo_control.design.linear_loop import controller_response, finger_response, fingers
from piezo_control.design.problem import FingerModel
from piezo_control.feedback import FeedbackParameters
from piezo_control.profile import Profile

FUTURE = 120  # samples
PAST = 40
POINTS = 400  # on the unit circle, for the band and for the rest each
QUIET = 0.03  # weight of a small H above the band
RIDGE = 1e-6


def preview_taps(
    model: FingerModel, controller: FeedbackParameters, band_hz: float = 150.0
) -> np.ndarray:
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
    return taps / taps.sum()


def previewed(profile: Profile, taps: np.ndarray, sample_time: float, samples: int) -> Profile:
    """Return the profile to be sent instead: `samples` points of it, from time 0."""
    time = sample_time * np.arange(-PAST, samples + FUTURE)
    values = profile.at(np.maximum(time, 0.0))
    return Profile(sample_time * np.arange(samples), np.convolve(values, taps[::-1], "valid"))
