# SPDX-License-Identifier: Apache-2.0
"""Input shaping: references that leave a lightly damped mode at rest.

A shaper is a moving sum of the reference, w_k = sum_j a_j r_{k-j} with sum a_j = 1, run sample by sample
for any reference. A vibration with the pole s = 2 pi f (-zeta + i sqrt(1 - zeta²)) that a step of r sets off
adds up, at the last tap n, to

    V = |sum_j a_j exp(s (n - j) h)|,

relative to the one without a shaper. The voltage is held within a sample, so this is exact at any ratio of
resonance and sample time.

* zero vibration: three taps, V = 0 at the nominal pole; half a period long
* robust: the same twice, V grows with the square of the deviation; one period long
* least time: the fewest samples for which V stays below a bound over a whole box of resonances and damping
  ratios, by linear programming, with no tap above a largest one, for the slew limit

No tap is negative: a shaped step rises without turning back, so that it leaves no minor loop behind in the
hysteresis (with taps of either sign it could be a fifth shorter, on a finger without hysteresis).

A profile that is known ahead is sent by the shaper's delay d too early, and with what the shaper rounds off on
top (one or two steps of van Cittert's iteration; h for the held sample): with t' = t + d + h and
m(t) = r(t) - sum_j a_j r(t + d - j h)

    r'(t) = r(t') + m(t') + (m(t') - sum_j a_j m(t' + d - j h)).

It is a reference as any other, so no vibration comes with it; the tip misses the profile by (1 - A)³ r, where it did
by (1 - A) r. A shaper of two taps does better with one step.

Sources: N. Singer, W. Seering, ASME J. Dynamic Systems, Measurement, and Control 112 (1990) 76 (zero
vibration, robust); W. Singhose et al., IEEE ICRA (1995) 3112 (bounded residual); P. H. van Cittert, Z. Phys. 69
(1931) 298 (iteration); M. Rakotondrabe, C. Clévy, P. Lutz, IEEE T-ASE 7 (2010) 440 (on piezocantilevers).
"""

from __future__ import annotations

import bisect
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog

from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile, Signal

LONGEST = 1000  # samples, a period of 10 Hz at 10 kHz: each tap costs the loop time in every sample
DIRECTIONS = 48  # of the polygon that stands for the circle |V| <= bound
MARGIN = math.cos(math.pi / DIRECTIONS)
STEPS = 2  # of van Cittert's iteration
Course = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""From time (s) to a reference."""
GRID = 25  # resonances across the box


@dataclass(frozen=True)
class ShapingParameters:
    """Kind of shaper and what it has to stand."""

    kind: str = parameter(
        "least_time",
        "none; zero_vibration: for the nominal mode; robust: the same twice; least_time: for the box",
        choices=("none", "zero_vibration", "robust", "least_time"),
    )
    spread: float = parameter(
        0.1, "relative spread of the resonance that least_time stands", low=0.0, high=0.5
    )
    damping_spread: float = parameter(
        0.5, "relative spread of the damping ratio that least_time stands", low=0.0, high=1.0
    )
    # Less than the 5 % that are asked for: what the inverse leaves of the hysteresis disturbs every tap, on the
    # truth plant by up to 2 % of the step.
    residual: float = parameter(
        0.03,
        "vibration that least_time may leave, relative to that without it",
        low=1e-4,
        high=1.0,
    )
    largest_tap: float = parameter(
        # 4 V a sample of 0.1 ms, the feedforward's slew limit, for the 37 V of a step of 20 µm.
        0.108, "largest change of the shaped unit step within a sample", low=1e-3, high=2.0
    )  # fmt: skip


@functools.lru_cache(maxsize=16)
def shaper(
    parameters: ShapingParameters, denominator: tuple[float, ...], sample_time: float
) -> tuple[float, ...]:
    """Return the taps a_j for the mode 1 / (a2 s² + a1 s + 1) and a sample time (s).

    Raises
    ------
    ParameterError
        If the mode does not vibrate below half the sampling rate, or no shaper up to LONGEST samples leaves
        so little.
    """
    a2, a1, _ = denominator
    frequency = 1.0 / (2.0 * math.pi * math.sqrt(a2))
    damping = 0.5 * a1 / math.sqrt(a2)
    if parameters.kind == "none":
        return (1.0,)
    if damping >= 1.0 or frequency * (1.0 + parameters.spread) >= 0.5 / sample_time:
        raise ParameterError(
            f"'denominator' has its mode at {frequency:g} Hz with damping ratio {damping:g}: must vibrate "
            f"below {0.5 / sample_time:g} Hz, half the sampling rate, to be shaped"
        )
    if parameters.kind == "least_time":
        return tuple(_least_time(parameters, frequency, damping, sample_time))
    taps = _zero_vibration(frequency, damping, sample_time)
    return tuple((np.convolve(taps, taps) if parameters.kind == "robust" else taps).tolist())


def residual_vibration(
    taps: ArrayLike, frequency_hz: ArrayLike, damping_ratio: ArrayLike, sample_time: float
) -> NDArray[np.float64]:
    """Return V at the last tap for modes of broadcast shapes; 1 is the vibration without a shaper."""
    taps = np.asarray(taps, float)
    return np.abs(_phasors(len(taps), frequency_hz, damping_ratio, sample_time) @ taps)


def delay(taps: Sequence[float], sample_time: float, ratio: float = 1.0) -> float:
    """Return the time (s) by which a shaped ramp comes late, for whoever plans ahead; `ratio` as in :func:`shape`."""
    return sample_time / ratio * sum(j * tap for j, tap in enumerate(taps))


def ahead(signal: Signal, begin: float, end: float, taps: Sequence[float], h: float) -> Profile:
    """Return what to ask for the tip to be at `signal` from `begin` to `end` (s), sample by sample of `h` (s).

    What the shaper rounds off is asked for on top, and what it rounds off of that, as long as the tip comes nearer
    to a corner by it.
    """
    late = delay(taps, h)
    span = (STEPS + 1) * len(taps) * h
    time = h * np.arange(math.floor((begin - late - span) / h), math.ceil((end + span) / h) + 1)

    def missed(course: Course) -> Course:
        """Return by what the tip misses a course that is sent by the shaper's delay ahead."""
        lags = [late - j * h for j in range(len(taps))]
        return lambda t: course(t) - sum(tap * course(t + lag) for tap, lag in zip(taps, lags))

    wanted: Course = signal.at
    asked, miss = wanted(time + late + h), wanted
    around = h * np.arange(-4 * len(taps), 4 * len(taps))
    corner = missed(lambda t: np.maximum(t, 0.0))
    for _ in range(STEPS):
        miss, before, corner = missed(miss), corner, missed(corner)
        if np.max(np.abs(corner(around))) > np.max(np.abs(before(around))):
            break
        asked = asked + miss(time + late + h)
    return Profile(time, asked, linear=True)


def longest(taps: Sequence[float], ratio: float) -> int:
    """Return how many past references :func:`shape` needs for ratios down to `ratio`."""
    return math.floor((len(taps) - 1) / ratio) + 2


def shape(taps: Sequence[float], past: list[float], reference: float, ratio: float) -> float:
    """Return the shaped reference of this sample; `past` is newest first, as many as :func:`longest` says.

    For a mode `ratio` times as fast as that of the taps they come in 1 / ratio of their time, between two
    samples on the straight line.
    """
    for j in range(len(past) - 1, 0, -1):
        past[j] = past[j - 1]
    past[0] = reference
    total = 0.0
    for j in range(len(taps)):
        place = j / ratio
        i = int(place)
        part = place - i
        total += taps[j] * ((1.0 - part) * past[i] + part * past[i + 1])
    return total


def _phasors(
    count: int, frequency_hz: ArrayLike, damping_ratio: ArrayLike, sample_time: float
) -> NDArray[np.complex128]:
    """Return exp(s (n - j) h), shape (..., count): what each tap adds to the vibration at the last one."""
    frequency, damping = np.broadcast_arrays(frequency_hz, damping_ratio)
    pole = 2.0 * np.pi * frequency * (-damping + 1j * np.sqrt(1.0 - damping**2))
    return np.exp(pole[..., None] * sample_time * np.arange(count - 1, -1, -1))


def _zero_vibration(frequency: float, damping: float, sample_time: float) -> NDArray[np.float64]:
    """Solve V = 0, sum a_j = 1 for taps now and at the two samples around half a period."""
    damped = frequency * math.sqrt(1.0 - damping**2)
    half = max(1, math.floor(0.5 / (damped * sample_time)))
    places = [0, half, half + 1]
    phasors = _phasors(half + 2, frequency, damping, sample_time)[places]
    taps = np.zeros(half + 2)
    taps[places] = np.linalg.solve([phasors.real, phasors.imag, np.ones(3)], [0.0, 0.0, 1.0])
    return taps


def _least_time(
    p: ShapingParameters, frequency: float, damping: float, sample_time: float
) -> list[float]:
    factors = np.linspace(1.0 - p.spread, 1.0 + p.spread, GRID)
    frequencies = np.repeat(frequency * factors, 3)
    dampings = damping * np.tile([1.0 - p.damping_spread, 1.0, 1.0 + p.damping_spread], GRID)
    turns = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)

    @functools.cache
    def best(count: int) -> list[float] | None:
        """Return so many taps that keep the bound, None where there are none."""
        phasors = _phasors(count, frequencies, np.minimum(dampings, 0.999), sample_time)
        vibration = (turns[:, None, None] * phasors).real.reshape(-1, count)
        # Unknowns: the taps, and the largest V, which is to be small.
        found = linprog(
            c=[*np.zeros(count), 1.0],
            A_ub=np.block([vibration, -np.ones((len(vibration), 1))]),
            b_ub=np.zeros(len(vibration)),
            A_eq=[[*np.ones(count), 0.0]],
            b_eq=[1.0],
            bounds=[(0.0, p.largest_tap)] * count + [(0.0, None)],
        )
        is_kept = found.success and found.fun <= p.residual * MARGIN
        return found.x[:-1].tolist() if is_kept else None

    # A shaper with a tap of 0 in front leaves the same: where a count suffices, every larger one does.
    enough = min(math.ceil(1.0 / (frequency * sample_time)), LONGEST)
    while best(enough) is None and enough < LONGEST:
        enough = min(2 * enough, LONGEST)
    fewest = bisect.bisect_left(range(enough), True, lo=2, key=lambda n: best(n) is not None)
    if taps := best(fewest):
        return taps
    raise ParameterError(
        f"'residual' is {p.residual}: no shaper up to {LONGEST} samples leaves so little for a spread of "
        f"{p.spread}"
    )
