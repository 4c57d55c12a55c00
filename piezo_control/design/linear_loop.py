# SPDX-License-Identifier: Apache-2.0
"""The loop without its nonlinearities: one discrete controller around a whole box of fingers.

    finger:  gain D(s), D(s) = 1 / (a2 s² + a1 s + 1), sampled with a zero-order hold (exact)
    sensor:  `delay` whole samples
    control: the feedback law, within its limits

The inverse hysteresis makes the finger linear with a gain of one, up to what `gain` covers. All
functions take many fingers at once; arrays have the finger first: (nfingers, nfrequencies) or
(nfingers, nsamples). Responses are those the sensor reports.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from piezo_control.feedback import FeedbackParameters


class Fingers(NamedTuple):
    """Sampled fingers, states (x, x'/omega); every field has the finger first."""

    a: np.ndarray
    b: np.ndarray
    b_force: np.ndarray
    resonance: np.ndarray
    damping: np.ndarray
    gain: np.ndarray
    sample_time: float
    delay: int


def fingers(
    denominator: Sequence[float],
    sample_time: float,
    delay: int,
    resonance: Sequence[float] = (1.0,),
    damping: Sequence[float] = (1.0,),
    gain: Sequence[float] = (1.0,),
) -> Fingers:
    """Sample the fingers of a box, one for each combination of the factors.

    Parameters
    ----------
    denominator : sequence of float
        (a2, a1, 1) of the nominal D(s).
    sample_time : float
        In s.
    delay : int
        Samples between deflection and reading.
    resonance, damping, gain : sequence of float
        Factors on natural frequency, damping ratio and static gain.
    """
    factors = np.array(list(itertools.product(resonance, damping, gain)))
    omega = factors[:, 0] / np.sqrt(denominator[0])
    zeta = factors[:, 1] * denominator[1] / (2.0 * np.sqrt(denominator[0]))
    # Complex arithmetic covers overdamped fingers too.
    ringing = omega * np.emath.sqrt(1.0 - zeta**2)
    envelope = np.exp(-zeta * omega * sample_time)
    even = np.cos(ringing * sample_time).real
    odd = (omega * sample_time * np.sinc(ringing * sample_time / np.pi)).real
    a = envelope[:, None, None] * np.moveaxis(
        np.array([[even + zeta * odd, odd], [-odd, even - zeta * odd]]), 2, 0
    )
    b_force = (np.eye(2) - a)[:, :, 0]
    return Fingers(
        a=a,
        b=factors[:, 2:] * b_force,
        b_force=b_force,
        resonance=factors[:, 0],
        damping=factors[:, 1],
        gain=factors[:, 2],
        sample_time=sample_time,
        delay=delay,
    )


def finger_response(box: Fingers, z: np.ndarray) -> np.ndarray:
    """Return the response from command to reading at `z`, shape (nfingers, len(z))."""
    trace = np.trace(box.a, axis1=1, axis2=2)[:, None]
    determinant = np.linalg.det(box.a)[:, None]
    constant = (box.a[:, 0, 1] * box.b[:, 1] - box.a[:, 1, 1] * box.b[:, 0])[:, None]
    numerator = box.b[:, :1] * z + constant
    return numerator / (z * z - trace * z + determinant) * z ** (-box.delay)


def controller_response(parameters: FeedbackParameters, z: np.ndarray) -> np.ndarray:
    """Return the responses from error and from reference to command at `z`, shape (2, len(z))."""
    p = parameters
    pencil = z[:, None, None] * np.eye(p.order) - p.matrix("a")
    b = np.column_stack([p.matrix("b"), p.matrix("reference_b")])
    states = np.linalg.solve(pencil, np.broadcast_to(b, (z.size, *b.shape)))
    return (p.matrix("c") @ states).T + np.array([[p.d], [p.reference_d]])


class ClosedLoop(NamedTuple):
    """Closed loops, states (finger, delayed readings, controller); fields have the finger first."""

    a: np.ndarray
    b_reference: np.ndarray
    b_force: np.ndarray
    b_drift: np.ndarray
    reading: int
    delay: int


def closed_loop(box: Fingers, parameters: FeedbackParameters) -> ClosedLoop:
    """Close the loop around every finger of `box`."""
    p = parameters
    number, delay, order = len(box.a), box.delay, p.order
    size = 2 + delay + order
    controller = slice(2 + delay, size)
    reading = 0 if delay == 0 else 1 + delay
    a = np.zeros((number, size, size))
    a[:, :2, :2] = box.a
    if delay:
        a[:, 2, 0] = 1.0
        a[:, range(3, 2 + delay), range(2, 1 + delay)] = 1.0
    a[:, :2, controller] = box.b[:, :, None] * p.matrix("c")
    a[:, :2, reading] -= box.b * p.d
    a[:, controller, controller] = p.matrix("a")
    a[:, controller, reading] -= p.matrix("b")
    b_error = np.zeros((number, size))
    b_error[:, :2] = box.b * p.d
    b_error[:, controller] = p.matrix("b")
    b_reference = b_error.copy()
    b_reference[:, :2] += box.b * p.reference_d
    b_reference[:, controller] += p.matrix("reference_b")
    b_force = np.zeros((number, size))
    b_force[:, :2] = box.b_force
    b_drift = -b_error
    if delay:
        b_drift = np.zeros((number, size))
        b_drift[:, 2] = 1.0
    return ClosedLoop(a, b_reference, b_force, b_drift, reading, delay)


def spectral_radius(loop: ClosedLoop) -> np.ndarray:
    """Return the largest modulus of each closed loop's poles; stable below 1."""
    return np.abs(np.linalg.eigvals(loop.a)).max(axis=1)


def respond(
    loop: ClosedLoop, source: str, samples: int, lag: float = 0.0, sample_time: float = 1.0
) -> np.ndarray:
    """Return the readings after a unit step at `source`, from rest, shape (nfingers, samples).

    `source` is 'reference', 'force' (as the static deflection it would cause) or 'drift' (a
    deflection added to the tip's). With `lag` (s) the source is 1 - exp(-t / lag) instead of a step.
    """
    b = getattr(loop, f"b_{source}")
    number, size = b.shape
    # Step and lag become two more states; then powers of one matrix give the whole response, and
    # every pass doubles the number of known samples.
    power = np.zeros((number, size + 2, size + 2))
    power[:, :size, :size] = loop.a
    power[:, :size, size] = b
    power[:, :size, size + 1] = -b
    power[:, size, size] = 1.0
    power[:, size + 1, size + 1] = np.exp(-sample_time / lag) if lag else 0.0
    states = np.zeros((number, size + 2, 1))
    states[:, size] = 1.0
    states[:, size + 1] = 1.0 if lag else 0.0
    while states.shape[2] < samples:
        states = np.concatenate([states, power @ states], axis=2)
        power = power @ power
    readings = states[:, loop.reading, :samples]
    if source == "drift" and loop.delay == 0:
        readings = readings + states[:, size, :samples] - states[:, size + 1, :samples]
    return readings


def settling(readings: np.ndarray, sample_time: float, target: float, band: float) -> np.ndarray:
    """Return when each response enters ``|reading - target| <= band`` for good, in s.

    Interpolated between samples, so at most one sample earlier than metrics.settling_time; infinite
    when the last sample is outside. `readings` has shape (nfingers, nsamples).
    """
    distance = np.abs(readings - target) - band
    outside = ~(distance <= 0.0)
    samples = readings.shape[1]
    last = samples - 1 - np.argmax(outside[:, ::-1], axis=1)
    row = np.arange(len(readings))
    before, after = distance[row, last], distance[row, np.minimum(last + 1, samples - 1)]
    with np.errstate(invalid="ignore", divide="ignore"):
        time = (last + before / (before - after)) * sample_time
    time[last == samples - 1] = np.inf
    time[~outside.any(axis=1)] = 0.0
    return time


def static_gain(loop: ClosedLoop) -> np.ndarray:
    """Return the reading per reference at rest, for each finger."""
    size = loop.a.shape[1]
    rest = np.linalg.solve(np.eye(size) - loop.a, loop.b_reference[:, :, None])
    return rest[:, loop.reading, 0]


def frequency_grid(
    sample_time: float, resonance_low: float, resonance_high: float, points: int
) -> np.ndarray:
    """Return angular frequencies (rad/s) up to the Nyquist frequency, half of them at the resonance.

    Half of the `points` lie evenly between the two resonances (rad/s), the others logarithmically
    from a ten-thousandth of the Nyquist frequency below and above.
    """
    nyquist = np.pi / sample_time
    rest = np.geomspace(1e-4 * nyquist, nyquist, points // 2)
    dense = np.linspace(resonance_low, resonance_high, points - points // 2)
    return np.union1d(rest, dense[dense < nyquist])


class Margins(NamedTuple):
    """Margins of one loop: factors on the gain, phase in degrees, additional delay in s."""

    gain_up: float
    gain_down: float
    phase_deg: float
    delay_s: float


def margins(frequency: np.ndarray, loop: np.ndarray) -> Margins:
    """Return the margins of a stable loop from its open-loop response.

    Parameters
    ----------
    frequency : array_like
        Increasing, in rad/s, shape (n,).
    loop : array_like
        Complex open-loop response L(jw), shape (n,); crossings are interpolated between points.

    Returns
    -------
    Margins
        ``gain_up`` (> 1) and ``gain_down`` (< 1) are the nearest factors on the gain with L = -1,
        infinite or 0 without one; ``phase_deg`` is the smallest angle between L and -1 over all
        crossings of the unit circle, ``delay_s`` the smallest delay that turns one of them to -1.
    """
    magnitude = np.abs(loop)
    gain_up, gain_down = np.inf, 0.0
    for i in np.flatnonzero((loop.imag[:-1] < 0) != (loop.imag[1:] < 0)):
        share = loop.imag[i] / (loop.imag[i] - loop.imag[i + 1])
        crossing = loop.real[i] + share * (loop.real[i + 1] - loop.real[i])
        if -1.0 < crossing < 0.0:
            gain_up = min(gain_up, -1.0 / crossing)
        elif crossing <= -1.0:
            gain_down = max(gain_down, -1.0 / crossing)
    phase, delay = np.inf, np.inf
    for i in np.flatnonzero((magnitude[:-1] < 1) != (magnitude[1:] < 1)):
        share = (1.0 - magnitude[i]) / (magnitude[i + 1] - magnitude[i])
        crossing = loop[i] + share * (loop[i + 1] - loop[i])
        at = frequency[i] + share * (frequency[i + 1] - frequency[i])
        lead = float(np.angle(-crossing) % (2.0 * np.pi))
        phase = min(phase, lead, 2.0 * np.pi - lead)
        delay = min(delay, lead / at)
    return Margins(float(gain_up), float(gain_down), float(np.degrees(phase)), float(delay))
