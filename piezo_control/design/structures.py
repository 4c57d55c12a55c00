# SPDX-License-Identifier: Apache-2.0
"""Structures to be tuned: a controller, or the weights of one, from a few positive numbers.

Every structure has starts, which follow from settling time and resonance, and turns its numbers into a problem
with nothing left open.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from piezo_control.design.problem import DesignProblem, Prefilter, TransferFunction, Weights

IS_FREQUENCY = np.array([True, False, False, True, False, True, False, False, True, False])
DAMPED_STARTS = np.array(
    [
        (0.1298, 0.5102, 0.4643, 0.3698, 1.3723, 1.1682, 0.2553, 1.2835, 0.1979, 1.1027),
        (0.1407, 0.6101, 0.4455, 0.3939, 1.6508, 1.2262, 0.2588, 1.1817, 0.2128, 1.1241),
        (0.1535, 0.7372, 0.4213, 0.3284, 1.7570, 1.2410, 0.2949, 1.1985, 0.1932, 1.1001),
    ]
)
"""Arguments of `_damped_candidate` for one, two and three samples of delay, frequencies per resonance.

A slower finger has them at more samples: what counts is the delay in periods of the resonance.

By differential evolution and simplex searches over the corners of params/synthesis_robust.yaml's box.
"""


FOLLOWING_STARTS = np.array(
    [
        (0.1695, 0.5848, 0.4618, 0.3772, 1.4006, 1.1622, 0.4349, 1.2457, 0.4410, 1.3828, 0.6699),
        (0.2029, 0.6964, 0.5735, 0.3180, 1.3602, 1.2214, 0.4328, 1.1456, 0.5744, 1.2179, 0.7672),
    ]
)
"""The same for `_following_candidate`, the last one a frequency too, over two boxes: params/synthesis_following.yaml
and params/synthesis_following_adapted.yaml."""


class Structure(NamedTuple):
    """Where to begin, the best of several places, and what the numbers mean."""

    starts: Callable[[DesignProblem], list[list[float]]]
    complete: Callable[[DesignProblem, np.ndarray], DesignProblem]


def _resonance(problem: DesignProblem) -> float:
    return 1.0 / math.sqrt(problem.finger.denominator[0])


def _hinf_starts(problem: DesignProblem) -> list[list[float]]:
    omega = _resonance(problem)
    rate = 3.0 / problem.specification.settling_time
    return [[rate, 3.0, 0.3, 1e-3, 7.0 * omega, 0.45 * omega, 0.6]]


def _hinf_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    bandwidth, peak, disturbance, effort, corner, frequency, damping = (float(v) for v in x)
    return dataclasses.replace(
        problem,
        weights=shaped_weights(
            bandwidth, peak, disturbance, effort, corner, 10.0 / problem.finger.sample_time
        ),
        prefilter=Prefilter(frequency, min(max(damping, 0.1), 10.0)),
    )


def shaped_weights(
    bandwidth: float, peak: float, disturbance: float, effort: float, corner: float, roll_off: float
) -> Weights:
    """Return weights from figures.

    1/Ws rises from nearly 0 through `bandwidth` (rad/s) to `peak`, Wd is constant, and Wu rises with
    the square of frequency from `effort` beyond `corner`, until `roll_off` (rad/s).
    """
    return Weights(
        performance=TransferFunction((1.0 / peak, bandwidth), (1.0, 1e-5 * bandwidth)),
        effort=TransferFunction(
            (effort / corner**2, 2.0 * effort / corner, effort),
            (1.0 / roll_off**2, 2.0 / roll_off, 1.0),
        ),
        disturbance=TransferFunction((disturbance,), (1.0,)),
    )


def _damped_starts(problem: DesignProblem) -> list[list[float]]:
    """Return what a long search found for the default finger, scaled to this one's resonance."""
    return (DAMPED_STARTS * np.where(IS_FREQUENCY, _resonance(problem), 1.0)).tolist()


def _damped_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    """Return an integrator less a resonant term that damps, with roll-off, and most of F r fed forward."""
    rate, position, speed, frequency, damping, roll_off, roll_damping = (float(v) for v in x[:7])
    feedforward, filter_frequency, filter_damping = (float(v) for v in x[7:])
    resonant = (1.0 / frequency**2, 2.0 * damping / frequency, 1.0)
    numerator = np.polysub(np.multiply(rate, resonant), (speed / frequency, position, 0.0))
    denominator = np.polymul(
        (*resonant, 0.0), (1.0 / roll_off**2, 2.0 * roll_damping / roll_off, 1.0)
    )
    return dataclasses.replace(
        _given(problem, numerator.tolist(), denominator.tolist()),
        prefilter=Prefilter(filter_frequency, min(max(filter_damping, 0.1), 10.0)),
        feedforward=feedforward,
    )


def _following_starts(problem: DesignProblem) -> list[list[float]]:
    omega = _resonance(problem)
    is_frequency = np.append(IS_FREQUENCY, True)
    return (FOLLOWING_STARTS * np.where(is_frequency, omega, 1.0)).tolist()


def _following_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    """Return the same behind a model of third order, which the finger follows."""
    controller = _damped_candidate(problem, x[:10])
    prefilter = dataclasses.replace(controller.prefilter, pole=float(x[10]))
    return dataclasses.replace(controller, prefilter=prefilter, follows=True)


def _pid_starts(problem: DesignProblem) -> list[list[float]]:
    rate = 3.0 / problem.specification.settling_time
    return [[rate, 1e-3, 1e-6, 0.5 * _resonance(problem)]]


def _pid_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    integral, proportional, derivative, roll_off = (float(v) for v in x)
    return _given(
        problem,
        (derivative, proportional, integral),
        (1.0 / roll_off**2, math.sqrt(2.0) / roll_off, 1.0, 0.0),
    )


def _notch_starts(problem: DesignProblem) -> list[list[float]]:
    rate = 3.0 / problem.specification.settling_time
    return [[rate, _resonance(problem), 0.1, 0.5 * _resonance(problem), 0.7]]


def _notch_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    rate, notch, depth, roll_off, damping = (float(v) for v in x)
    return _given(
        problem,
        (rate / notch**2, 2.0 * rate * depth / notch, rate),
        (1.0 / roll_off**2, 2.0 * damping / roll_off, 1.0, 0.0),
    )


def _given(
    problem: DesignProblem, numerator: Sequence[float], denominator: Sequence[float]
) -> DesignProblem:
    return dataclasses.replace(
        problem,
        method="given",
        controller=TransferFunction(tuple(numerator), tuple(denominator)),
    )


STRUCTURES = {
    "hinf": Structure(_hinf_starts, _hinf_candidate),
    "damped_integrator": Structure(_damped_starts, _damped_candidate),
    "model_following": Structure(_following_starts, _following_candidate),
    "pid": Structure(_pid_starts, _pid_candidate),
    "integrator_notch": Structure(_notch_starts, _notch_candidate),
}
"""By the method of the problem."""
