# SPDX-License-Identifier: Apache-2.0
"""From a design problem to the coefficients of the feedback law.

The controller comes from weights (hinf) or from a transfer function made discrete (Tustin). Whatever is not
given is tuned: a simplex search over a structure's numbers for the fastest response that keeps the
specifications at the corners of the box. Then the slowest pole is made an exact integrator, and prefilter,
feedforward and anti-windup are added.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from piezo_control.design import certificate
from piezo_control.design.hinf import hinf_controller, slicot
from piezo_control.design.linear_loop import fingers, open_loop
from piezo_control.design.problem import (
    DesignProblem,
    Prefilter,
    SynthesisError,
    TransferFunction,
)
from piezo_control.design.state_space import TIME_UNIT, StateSpace, from_w_plane, realise, tustin
from piezo_control.design.structures import STRUCTURES
from piezo_control.feedback import FeedbackParameters

ANTI_WINDUP_NOISE = 1e-3
TUNING_EVALUATIONS = 250
TUNING_RESERVE = 0.95
"""Part of each specification that tuning uses: the certificate looks at more fingers than it does."""


class Design(NamedTuple):
    """A controller, the problem it solves with nothing left open, and the solver's gamma.

    `gamma` is NaN where no H-infinity problem was solved.
    """

    controller: FeedbackParameters
    problem: DesignProblem
    gamma: float


def synthesize(problem: DesignProblem) -> Design:
    """Design the controller of `problem`.

    Raises SynthesisError, within seconds, for a problem that is singular or has no solution.
    """
    _need_resonance_below_nyquist(problem)
    if problem.method == "hinf":
        slicot()  # before a search that would take its absence for a problem without a solution
    is_open = not problem.weights if problem.method == "hinf" else problem.method != "given"
    if is_open:
        problem = tune(problem)
    if problem.method == "hinf":
        system, gamma = hinf_controller(problem)
    else:
        system, gamma = tustin(problem.controller, problem.finger.sample_time), math.nan
    return Design(run_time_controller(system, problem), problem, gamma)


def run_time_controller(system: StateSpace, problem: DesignProblem) -> FeedbackParameters:
    """Return the feedback law of a discrete controller from error to command.

    `system` has its slowest pole as the first state. Adds the path of the reference, and an anti-windup gain: the
    stationary Kalman gain of an observer of the controller, for noise on its error and, with a variance of
    ANTI_WINDUP_NOISE of that, on its command. The result does not count as certified: only :mod:`certificate` can
    say that.
    """
    a, b, c, d = system.a.copy(), system.b, system.c, system.d[0, 0]
    if problem.integrator:
        a[0, :] = 0.0
        a[:, 0] = 0.0
        a[0, 0] = 1.0
    try:
        spread = scipy.linalg.solve_discrete_are(a.T, c.T, b @ b.T, [[ANTI_WINDUP_NOISE]])
    except ValueError as error:  # LinAlgError, too
        raise SynthesisError(
            f"the controller has no anti-windup gain ({error}): a zero must neither cancel its slowest "
            "pole nor come so near that double precision does not tell them apart"
        ) from None
    anti_windup = a @ spread @ c.T / (ANTI_WINDUP_NOISE + c @ spread @ c.T)
    path = reference_path(problem)
    # The controller sees what is expected less the reading, which is the error plus (expected - r).
    direct = path.d_expected - 1.0
    size = len(path.a)
    whole = np.block([[a, b @ path.c_expected], [np.zeros((size, len(a))), path.a]])
    without = np.zeros((size, 1))

    def values(*parts: np.ndarray) -> tuple[float, ...]:
        return tuple(float(x) for x in np.concatenate([np.ravel(part) for part in parts]))

    return FeedbackParameters(
        controller="state_space",
        name=problem.name,
        delay_samples=problem.finger.delay_samples,
        denominator=problem.finger.denominator,
        temperature_undone=problem.uncertainty.temperature_undone,
        sample_time=problem.finger.sample_time,
        command_low=problem.finger.command_low,
        command_high=problem.finger.command_high,
        a=values(whole),
        b=values(b, without),
        c=values(c, d * path.c_expected + path.c_ahead),
        d=float(d),
        reference_b=values(b * direct, path.b) if size else (),
        reference_d=float(d * direct + path.d_ahead),
        anti_windup=values(anti_windup, without),
    )


class ReferencePath(NamedTuple):
    """From the reference to the reading that the controller expects, and to the command straight ahead."""

    a: np.ndarray
    b: np.ndarray
    c_expected: np.ndarray
    d_expected: float
    c_ahead: np.ndarray
    d_ahead: float


def reference_path(problem: DesignProblem) -> ReferencePath:
    """Return the path of the reference: the prefilter, or that and the nominal finger which follows it.

    A finger that is the nominal one then does what the prefilter says and leaves the controller nothing to
    mend, so that its bandwidth does not limit how quickly a reference is reached.
    """
    step = problem.finger.sample_time / TIME_UNIT
    if not problem.follows:
        f = from_w_plane(realise(prefilter_transfer(problem.prefilter)), step)
        ahead = problem.feedforward
        return ReferencePath(f.a, f.b, f.c, f.d[0, 0], ahead * f.c, ahead * f.d[0, 0])
    wished = prefilter_transfer(problem.prefilter)
    inverted = np.multiply(wished.numerator, problem.finger.denominator)
    inverse = TransferFunction(tuple(inverted.tolist()), wished.denominator)
    command = from_w_plane(realise(inverse), step)
    way = open_loop(fingers(problem.finger))
    a, b, c = way.a[0], way.b[0][:, None], way.c[None, :]
    order, size = len(command.a), len(a)
    return ReferencePath(
        a=np.block([[command.a, np.zeros((order, size))], [b @ command.c, a]]),
        b=np.vstack([command.b, b @ command.d]),
        c_expected=np.hstack([np.zeros((1, order)), c]),
        d_expected=0.0,
        c_ahead=problem.feedforward * np.hstack([command.c, np.zeros((1, size))]),
        d_ahead=problem.feedforward * command.d[0, 0],
    )


def prefilter_transfer(prefilter: Prefilter) -> TransferFunction:
    """Return the prefilter, 1 for the frequency 0."""
    omega = prefilter.frequency
    if omega == 0.0:
        return TransferFunction((1.0,), (1.0,))
    poles = np.array([1.0, 2.0 * prefilter.damping * omega, omega**2])
    if prefilter.pole:
        poles = np.polymul(poles, (1.0, prefilter.pole))
    return TransferFunction((float(poles[-1]),), tuple(poles.tolist()))


def tune(problem: DesignProblem) -> DesignProblem:
    """Return the problem with its weights, or its controller, found from the specifications.

    Deterministic. Minimises the worst settling time over the corners of the box, plus penalties for
    what exceeds a specification; the start follows from settling time and resonance.
    """
    starts, complete = STRUCTURES[problem.method]
    corners = certificate.Box(problem, resonance=5, damping=3, gain=3, points=240)

    def cost(logarithms: np.ndarray) -> float:
        candidate = complete(problem, np.exp(logarithms))
        try:
            controller = synthesize(candidate).controller
        except (SynthesisError, np.linalg.LinAlgError, ValueError):
            return 1e6
        return corners.cost(controller, TUNING_RESERVE)

    start_logarithms = min(np.log(starts(problem)), key=cost)
    simplex = np.vstack([start_logarithms, start_logarithms + 0.25 * np.eye(len(start_logarithms))])
    best = scipy.optimize.minimize(
        cost,
        start_logarithms,
        method="Nelder-Mead",
        options={"maxfev": TUNING_EVALUATIONS, "initial_simplex": simplex, "adaptive": True},
    )
    if best.fun >= 1e6:
        raise SynthesisError(f"tuning '{problem.method}' found no controller at all")
    found = complete(problem, np.exp(best.x))
    if best.fun >= certificate.UNSTABLE:
        spread = problem.uncertainty.resonance_stable
        raise SynthesisError(
            f"tuning '{problem.method}' found no controller that is stable over the box: poles up to "
            f"{best.fun / certificate.UNSTABLE:.4g}, must be below 1. The box has resonance "
            f"±{100.0 * spread:g} % and a delay of {problem.finger.delay_samples} samples; identify the finger "
            "more closely, or sample faster"
        )
    return found


def _need_resonance_below_nyquist(problem: DesignProblem) -> None:
    """Refuse a box whose highest first mode the samples cannot show."""
    highest = (1.0 + problem.uncertainty.resonance_stable) / math.sqrt(
        problem.finger.denominator[0]
    )
    if highest * problem.finger.sample_time >= math.pi:
        raise SynthesisError(
            f"the finger's resonance is up to {highest / 2.0 / math.pi:.4g} Hz (finger.denominator, "
            f"uncertainty.resonance_stable), must be below the Nyquist frequency of "
            f"{0.5 / problem.finger.sample_time:.4g} Hz (finger.sample_time): sample faster"
        )
