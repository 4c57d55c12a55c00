# SPDX-License-Identifier: Apache-2.0
"""The loop without its nonlinearities: one discrete controller around a whole box of fingers.

    finger:  gain D(s), every mode of it sampled with a zero-order hold (exact)
    ahead:   the amplifier's lag, held from sample to sample like the voltage
    sensor:  `delay` whole samples
    control: the feedback law, within its limits

The inverse hysteresis makes the finger linear with a gain of one, up to what `gain` covers. All
functions take many fingers at once; arrays have the finger first: (nfingers, nfrequencies) or
(nfingers, nsamples). Responses are those the sensor reports.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from piezo_control.design.problem import FingerModel
from piezo_control.dynamics import ModesParameters
from piezo_control.feedback import FeedbackParameters

COVARIANCE_DOUBLINGS = 16
"""65536 samples: enough for a pole at a modulus of 1 - 1e-4 to forget."""


class Fingers(NamedTuple):
    """Sampled fingers; states (x, x'/omega) of every mode, the tip is the sum of all x.

    `a` has shape (nfingers, nmodes, 2, 2), `b` and `b_force` (nfingers, nmodes, 2), the factors
    (nfingers,). `lag` is the part of the amplifier's voltage that is left after a sample.
    """

    a: np.ndarray
    b: np.ndarray
    b_force: np.ndarray
    resonance: np.ndarray
    damping: np.ndarray
    gain: np.ndarray
    beside: tuple[ModesParameters, ...]
    sample_time: float
    delay: int
    lag: float


def fingers(
    model: FingerModel,
    resonance: Sequence[float] = (1.0,),
    damping: Sequence[float] = (1.0,),
    gain: Sequence[float] = (1.0,),
    beside: Sequence[ModesParameters] = (ModesParameters(),),
) -> Fingers:
    """Sample the fingers of a box, one for each combination of the factors.

    Parameters
    ----------
    model : FingerModel
        The nominal finger.
    resonance, damping, gain : sequence of float
        Factors on natural frequency and damping ratio of the first mode, and on the static gain.
    beside : sequence of ModesParameters
        Modes that nobody modelled, in addition to those of `model`; all equally many.
    """
    h = model.sample_time
    combinations = list(itertools.product(resonance, damping, gain, beside))
    factors = np.array([combination[:3] for combination in combinations])
    others = [
        (
            [2.0 * math.pi * f for f in (*model.modes.frequency_hz, *more.frequency_hz)],
            [*model.modes.damping, *more.damping],
            [*model.modes.share, *more.share],
        )
        for *_, more in combinations
    ]
    count = len(combinations)
    omega = np.column_stack(
        [
            factors[:, 0] / np.sqrt(model.denominator[0]),
            np.reshape([o[0] for o in others], (count, -1)),
        ]
    )
    zeta = np.column_stack(
        [
            factors[:, 1] * model.denominator[1] / (2.0 * np.sqrt(model.denominator[0])),
            np.reshape([o[1] for o in others], (count, -1)),
        ]
    )
    higher = np.reshape([o[2] for o in others], (count, -1))
    share = np.column_stack([1.0 - higher.sum(axis=1), higher])
    # Complex arithmetic covers overdamped fingers too.
    ringing = omega * np.emath.sqrt(1.0 - zeta**2)
    envelope = np.exp(-zeta * omega * h)
    even = np.cos(ringing * h).real
    odd = (omega * h * np.sinc(ringing * h / np.pi)).real
    a = envelope[..., None, None] * np.moveaxis(
        np.array([[even + zeta * odd, odd], [-odd, even - zeta * odd]]), (0, 1), (2, 3)
    )
    b_force = share[..., None] * (np.eye(2) - a)[..., 0]
    bandwidth = model.amplifier_bandwidth_hz
    return Fingers(
        a=a,
        b=factors[:, 2, None, None] * b_force,
        b_force=b_force,
        resonance=factors[:, 0],
        damping=factors[:, 1],
        gain=factors[:, 2],
        beside=tuple(combination[3] for combination in combinations),
        sample_time=h,
        delay=model.delay_samples,
        lag=math.exp(-2.0 * math.pi * bandwidth * h) if bandwidth else 0.0,
    )


def finger_response(box: Fingers, z: np.ndarray) -> np.ndarray:
    """Return the response from command to reading at `z`, shape (nfingers, len(z))."""
    trace = np.trace(box.a, axis1=2, axis2=3)[..., None]
    determinant = np.linalg.det(box.a)[..., None]
    constant = (box.a[..., 0, 1] * box.b[..., 1] - box.a[..., 1, 1] * box.b[..., 0])[..., None]
    modes = (box.b[..., :1] * z + constant) / (z * z - trace * z + determinant)
    amplifier = (1.0 - box.lag) / (1.0 - box.lag / z)
    return modes.sum(axis=1) * amplifier * z ** (-box.delay)


def controller_response(parameters: FeedbackParameters, z: np.ndarray) -> np.ndarray:
    """Return the responses from error and from reference to command at `z`, shape (2, len(z))."""
    p = parameters
    pencil = z[:, None, None] * np.eye(p.order) - p.matrix("a")
    b = np.column_stack([p.matrix("b"), p.matrix("reference_b")])
    states = np.linalg.solve(pencil, np.broadcast_to(b, (z.size, *b.shape)))
    return (p.matrix("c") @ states).T + np.array([[p.d], [p.reference_d]])


class OpenLoop(NamedTuple):
    """From command to reading: states (modes, amplifier, delayed readings), the finger's index first."""

    a: np.ndarray
    b: np.ndarray
    b_force: np.ndarray
    b_drift: np.ndarray
    c: np.ndarray


def open_loop(box: Fingers) -> OpenLoop:
    """Put amplifier and sensor to every finger of `box`."""
    number, modes = box.a.shape[:2]
    own = 2 * modes
    line = own + (box.lag > 0.0)  # the first of the delayed readings
    size = line + box.delay
    a = np.zeros((number, size, size))
    b, b_force, b_drift = (np.zeros((number, size)) for _ in range(3))
    tip, c = np.zeros(size), np.zeros(size)
    tip[0:own:2] = 1.0
    for i in range(modes):
        a[:, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = box.a[:, i]
    b[:, :own] = (1.0 - box.lag) * box.b.reshape(number, own)
    b_force[:, :own] = box.b_force.reshape(number, own)
    if box.lag:
        a[:, :own, own] = box.lag * box.b.reshape(number, own)
        a[:, own, own] = box.lag
        b[:, own] = 1.0 - box.lag
    if box.delay:
        a[:, line] = tip
        a[:, range(line + 1, size), range(line, size - 1)] = 1.0
        b_drift[:, line] = 1.0
        c[-1] = 1.0
    else:
        c = tip
    return OpenLoop(a, b, b_force, b_drift, c)


class ClosedLoop(NamedTuple):
    """Closed loops, states (open loop, controller), the finger's index first.

    The command is c_command times the states, and `d_reference` times the reference.
    """

    a: np.ndarray
    b_reference: np.ndarray
    b_force: np.ndarray
    b_drift: np.ndarray
    b_noise: np.ndarray
    c_reading: np.ndarray
    c_command: np.ndarray
    d: float
    d_reference: float
    delay: int


def closed_loop(box: Fingers, parameters: FeedbackParameters) -> ClosedLoop:
    """Close the loop around every finger of `box`."""
    p = parameters
    way = open_loop(box)
    number, first = way.b.shape
    size = first + p.order
    readings, states = slice(0, first), slice(first, size)
    c_reading = np.concatenate([way.c, np.zeros(p.order)])
    c_command = np.concatenate([-p.d * way.c, p.c])

    def padded(b: np.ndarray) -> np.ndarray:
        return np.hstack([b, np.zeros((number, p.order))])

    b_command = padded(way.b)
    a = np.zeros((number, size, size))
    a[:, readings, readings] = way.a
    a += b_command[:, :, None] * c_command
    a[:, states, states] = p.matrix("a")
    a[:, states, readings] = -p.matrix("b")[:, None] * way.c
    b_error = b_command * p.d
    b_error[:, states] = p.matrix("b")
    b_reference = b_error + b_command * p.reference_d
    b_reference[:, states] += p.matrix("reference_b")
    return ClosedLoop(
        a=a,
        b_reference=b_reference,
        b_force=padded(way.b_force),
        b_drift=padded(way.b_drift) if box.delay else -b_error,
        b_noise=-b_error,
        c_reading=c_reading,
        c_command=c_command,
        d=p.d,
        d_reference=p.d + p.reference_d,
        delay=box.delay,
    )


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
    states = _respond(loop, getattr(loop, f"b_{source}"), samples, lag, sample_time)
    readings = np.einsum("i,nik->nk", loop.c_reading, states[:, :-2])
    if source == "drift" and loop.delay == 0:
        readings = readings + states[:, -2] - states[:, -1]
    return readings


def held_voltage(box: Fingers, loop: ClosedLoop, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what the finger has at each sample after a unit step of the reference, from rest.

    Returns
    -------
    states, voltage : 3-D and 2-D array with shapes (nfingers, 2 nmodes, samples), (nfingers, samples)
        Of the modes at the sample, and behind the amplifier until the next one (as the deflection that it
        would hold).
    """
    states = _respond(loop, loop.b_reference, samples)
    own = 2 * box.a.shape[1]
    command = np.einsum("i,nik->nk", loop.c_command, states[:, :-2]) + loop.d_reference
    before = states[:, own] if box.lag else 0.0
    return states[:, :own], (1.0 - box.lag) * command + box.lag * before


def _respond(
    loop: ClosedLoop, b: np.ndarray, samples: int, lag: float = 0.0, sample_time: float = 1.0
) -> np.ndarray:
    """Return the loop's states after a step through `b`, with step and lag as the last two."""
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
    return states[:, :, :samples]


def noise_gain(loop: ClosedLoop) -> np.ndarray:
    """Return the standard deviation of the command per one of white noise on the readings.

    The H2 norm of K S, from the stationary covariance of the loop's states; infinite when unstable.
    Shape (nfingers,).
    """
    covariance = loop.b_noise[:, :, None] * loop.b_noise[:, None, :]
    power = loop.a
    with np.errstate(over="ignore", invalid="ignore"):
        # After n passes the covariance of 2^n samples of noise.
        for _ in range(COVARIANCE_DOUBLINGS):
            covariance = covariance + power @ covariance @ np.swapaxes(power, 1, 2)
            power = power @ power
        square = np.einsum("i,nij,j->n", loop.c_command, covariance, loop.c_command) + loop.d**2
        return np.where(spectral_radius(loop) < 1.0, np.sqrt(square), np.inf)


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


def static_gain(loop: ClosedLoop, source: str = "reference") -> np.ndarray:
    """Return the reading at rest per unit at `source` (see :func:`respond`), for each finger."""
    size = loop.a.shape[1]
    rest = np.linalg.solve(np.eye(size) - loop.a, getattr(loop, f"b_{source}")[:, :, None])
    direct = float(source == "drift" and loop.delay == 0)
    return rest[:, :, 0] @ loop.c_reading + direct


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
