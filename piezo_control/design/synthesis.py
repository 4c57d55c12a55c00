# SPDX-License-Identifier: Apache-2.0
"""From a design problem to the coefficients of the feedback law.

H-infinity chain: sampled finger with its delay (linear_loop) → w-plane by the bilinear transform,
which keeps stability and every H-infinity norm, so delay and sampling are part of the design →
generalised plant

    e = r - G (u + Wd d),   z = (Ws e, Wu u),   controller sees e

→ smallest gamma by bisection over SLICOT's SB10AD (Glover and Doyle 1988, the routine behind
``control.hinfsyn``, which offers neither a bound nor a tolerance and can scan for hours) → balanced
realisation, truncated to the wanted order → back to discrete time → the slowest pole made an exact
integrator → prefilter and anti-windup.

The disturbance d at the finger's input keeps the optimum from cancelling the resonance; the effort
weight keeps the problem regular. Inside, time is in milliseconds.

The other methods make a transfer function discrete (Tustin). Whatever is not given is tuned: a
simplex search for the fastest response that keeps the specifications at the corners of the box.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.signal
import slycot
import slycot.exceptions

from piezo_control.design import certificate, linear_loop
from piezo_control.design.problem import (
    DesignProblem,
    FingerModel,
    Prefilter,
    TransferFunction,
    Weights,
)
from piezo_control.feedback import FeedbackParameters

TIME_UNIT = 1e-3
LARGEST_GAMMA = 1e4
GAMMA_TOLERANCE = 0.01
FASTEST_POLE = 1e5
"""Per sample, in the w-plane; what is faster comes from a singular problem."""
ANTI_WINDUP_NOISE = 1e-3
TUNING_EVALUATIONS = 250
TUNING_RESERVE = 0.95
"""Part of each specification that tuning uses: the certificate looks at more fingers than it does."""

IS_FREQUENCY = np.array([True, False, False, True, False, True, False, False, True, False])
DAMPED_STARTS = np.array(
    [
        (0.1298, 0.5102, 0.4643, 0.3698, 1.3723, 1.1682, 0.2553, 1.2835, 0.1979, 1.1027),
        (0.1407, 0.6101, 0.4455, 0.3939, 1.6508, 1.2262, 0.2588, 1.1817, 0.2128, 1.1241),
        (0.1535, 0.7372, 0.4213, 0.3284, 1.7570, 1.2410, 0.2949, 1.1985, 0.1932, 1.1001),
    ]
)
"""Arguments of `_damped_candidate` for one, two and three samples of delay, frequencies per resonance.

By differential evolution and simplex searches over the corners of params/synthesis_robust.yaml's box.
"""


class SynthesisError(ValueError):
    """A design problem without a solution; the message says why."""


class StateSpace(NamedTuple):
    """x' = a x + b u, y = c x + d u, or the same from sample to sample."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray


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
    is_open = not problem.weights if problem.method == "hinf" else problem.method != "given"
    if is_open:
        problem = tune(problem)
    if problem.method == "hinf":
        system, gamma = hinf_controller(problem)
    else:
        system, gamma = tustin(problem.controller, problem.finger.sample_time), math.nan
    return Design(run_time_controller(system, problem), problem, gamma)


# H-infinity -----------------------------------------------------------------------------------


def hinf_controller(problem: DesignProblem) -> tuple[StateSpace, float]:
    """Return the discrete controller (error to command) of the problem's weights, and its gamma."""
    step = problem.finger.sample_time / TIME_UNIT
    plant = generalised_plant(
        to_w_plane(delayed_finger(problem.finger), step), *realised_weights(problem.weights)
    )
    gamma = problem.gamma_margin * smallest_gamma(plant)
    controller = solve(plant, gamma)
    if controller is None:
        raise SynthesisError(f"the solver found no controller at gamma = {gamma:.4g}")
    fastest = math.inf
    if np.all(np.isfinite(controller.a)):
        fastest = np.abs(np.linalg.eigvals(controller.a)).max()
    if fastest > FASTEST_POLE / step:
        raise SynthesisError(
            f"the solver's controller has a pole of {fastest / TIME_UNIT:.3g} rad/s: the problem is "
            "nearly singular. Raise the effort weight at high frequency"
        )
    return from_w_plane(balanced(controller, problem.order), step), gamma


def delayed_finger(finger: FingerModel) -> StateSpace:
    """Return the nominal finger, sampled, from command to delayed reading."""
    way = linear_loop.open_loop(linear_loop.fingers(finger))
    return StateSpace(way.a[0], way.b[0][:, None], way.c[None, :], np.zeros((1, 1)))


def to_w_plane(system: StateSpace, step: float) -> StateSpace:
    """Map discrete to continuous by z = (1 + w step/2) / (1 - w step/2); `step` sets the time unit."""
    a, b, c, d = system
    inverse = np.linalg.inv(a + np.eye(len(a)))
    return StateSpace(
        2.0 / step * inverse @ (a - np.eye(len(a))),
        2.0 / math.sqrt(step) * inverse @ b,
        2.0 / math.sqrt(step) * c @ inverse,
        d - c @ inverse @ b,
    )


def from_w_plane(system: StateSpace, step: float) -> StateSpace:
    """Map continuous to discrete, the inverse of :func:`to_w_plane` (Tustin)."""
    a, b, c, d = system
    inverse = np.linalg.inv(2.0 / step * np.eye(len(a)) - a)
    return StateSpace(
        inverse @ (2.0 / step * np.eye(len(a)) + a),
        2.0 / math.sqrt(step) * inverse @ b,
        2.0 / math.sqrt(step) * c @ inverse,
        d + c @ inverse @ b,
    )


def realise(transfer: TransferFunction) -> StateSpace:
    """Return a realisation in the inner time unit."""

    def scaled(coefficients: Sequence[float]) -> np.ndarray:
        units = TIME_UNIT ** np.arange(len(coefficients))[::-1]
        trimmed = np.trim_zeros(np.array(coefficients) / units, "f")
        return trimmed if trimmed.size else np.zeros(1)

    order = len(transfer.denominator) - 1
    if order == 0:  # tf2ss would invent an integrator
        gain = np.array([[transfer.numerator[0] / transfer.denominator[0]]])
        return StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), gain)
    return StateSpace(*scipy.signal.tf2ss(scaled(transfer.numerator), scaled(transfer.denominator)))


def realised_weights(weights: Weights) -> tuple[StateSpace, StateSpace, StateSpace]:
    """Return performance, effort and disturbance weight; refuse what makes the problem singular."""
    systems = []
    for field in dataclasses.fields(weights):
        transfer = getattr(weights, field.name)
        system = realise(transfer)
        unstable = [p for p in np.roots(transfer.denominator) if p.real >= 0.0]
        if unstable:
            raise SynthesisError(
                f"weight '{field.name}' has the pole {unstable[0]:.4g} rad/s, must be stable: no "
                "controller can stabilise a weight. Write an integrator as a slow pole"
            )
        systems.append(system)
    performance, effort, disturbance = systems
    if effort.d[0, 0] == 0.0:
        raise SynthesisError(
            "weight 'effort' vanishes at high frequency, so the command costs nothing there "
            "(D12 = 0): the problem is singular and has no proper optimal controller. Give "
            "numerator and denominator the same degree"
        )
    return performance, effort, disturbance


def generalised_plant(
    finger: StateSpace, performance: StateSpace, effort: StateSpace, disturbance: StateSpace
) -> StateSpace:
    """Return the plant from (r, d, u) to (Ws e, Wu u, e) with e = r - G (u + Wd d)."""
    ag, bg, cg, dg = finger
    blocks = [ag, performance.a, effort.a, disturbance.a]
    a = scipy.linalg.block_diag(*blocks)
    ends = np.cumsum([len(block) for block in blocks])
    g, s, u, d = (slice(end - len(block), end) for end, block in zip(ends, blocks))
    b = np.zeros((len(a), 3))
    error = np.zeros((1, len(a)))
    error[:, g] = -cg
    error[:, d] = -dg @ disturbance.c
    error_direct = np.array([[1.0, -(dg @ disturbance.d)[0, 0], -dg[0, 0]]])
    a[g, d] = bg @ disturbance.c
    b[g] = np.hstack([np.zeros_like(bg), bg @ disturbance.d, bg])
    a[s] += performance.b @ error
    b[s] = performance.b @ error_direct
    b[u, 2:] = effort.b
    b[d, 1:2] = disturbance.b
    c = np.zeros((3, len(a)))
    c[:1] = performance.d @ error
    c[:1, s] += performance.c
    c[1:2, u] = effort.c
    c[2:] = error
    direct = np.vstack([performance.d @ error_direct, [[0.0, 0.0, effort.d[0, 0]]], error_direct])
    return StateSpace(a, b, c, direct)


def solve(plant: StateSpace, gamma: float) -> StateSpace | None:
    """Return the central controller at `gamma`, or None where there is none.

    The last input of `plant` is the command, its last output what the controller sees. SB10AD wants
    no direct path between the two: the controller is found without it and then corrected.
    """
    direct = plant.d[-1, -1]
    d = plant.d.copy()
    d[-1, -1] = 0.0
    inputs, outputs = plant.b.shape[1], len(plant.c)
    try:
        result = slycot.sb10ad(
            len(plant.a), inputs, outputs, 1, 1, gamma, plant.a, plant.b, plant.c, d, job=4
        )
    except slycot.exceptions.SlycotArithmeticError as error:
        if error.info <= 4:
            raise SynthesisError(
                "the H-infinity problem is singular (SB10AD: "
                f"{' '.join(str(error).split())}). Weights must neither cancel the finger's poles "
                "nor vanish at high frequency"
            ) from None
        return None
    a, b, c, dk, closed_loop_a = (np.atleast_2d(matrix) for matrix in result[1:6])
    if not np.all(np.linalg.eigvals(closed_loop_a).real < 0.0):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (1.0 + dk[0, 0] * direct)
    return StateSpace(a - scale * direct * b @ c, scale * b, scale * c, scale * dk)


def smallest_gamma(plant: StateSpace) -> float:
    """Return the smallest gamma with a controller, to GAMMA_TOLERANCE, from above."""
    high = 1.0
    while solve(plant, high) is None:
        high *= 4.0
        if high > LARGEST_GAMMA:
            raise SynthesisError(
                f"no controller keeps the weighted norm below {LARGEST_GAMMA:g}: the finger cannot "
                "be stabilised, or the weights are many orders of magnitude apart"
            )
    low = high / 2.0
    while low > 1.0 / LARGEST_GAMMA and solve(plant, low) is not None:
        low, high = low / 2.0, low
    while high > (1.0 + GAMMA_TOLERANCE) * low:
        gamma = math.sqrt(high * low)
        if solve(plant, gamma) is None:
            low = gamma
        else:
            high = gamma
    return high


def balanced(system: StateSpace, order: int = 0) -> StateSpace:
    """Return a realisation with the slowest pole apart and the rest balanced, truncated to `order`.

    The first state is the slowest pole (real, the integrator to be), the others have equal, diagonal
    Gramians, which makes them well-conditioned; those of the smallest Hankel singular values go.
    `order` counts all states; 0 keeps every state that matters in double precision.

    Raises SynthesisError when another pole is unstable: such a controller must not be run.
    """
    poles, left, right = scipy.linalg.eig(system.a, left=True)
    slow = int(np.argmin(np.abs(poles)))
    if poles[slow].imag != 0.0:
        raise SynthesisError("the controller has no real slowest pole: weigh low frequencies more")
    others = np.delete(poles, slow)
    if others.real.max(initial=-1.0) >= 0.0:
        raise SynthesisError(
            f"the controller itself is unstable (pole {others.real.max() / TIME_UNIT:.4g} rad/s) and "
            "would run away at the command's limit: ask for less bandwidth"
        )
    mode, dual = right[:, slow].real, left[:, slow].real
    b_slow = dual @ system.b / (dual @ mode)
    c_slow = system.c @ mode
    ratio = math.sqrt(abs(b_slow[0] / c_slow[0]))
    # Coordinates of the other modes: an orthonormal basis of the invariant subspace dual'x = 0.
    basis = scipy.linalg.null_space(dual[None, :])
    rest = StateSpace(
        basis.T @ system.a @ basis,
        basis.T @ (system.b - np.outer(mode, b_slow)),
        system.c @ basis,
        system.d,
    )
    controllability = scipy.linalg.solve_continuous_lyapunov(rest.a, -rest.b @ rest.b.T)
    observability = scipy.linalg.solve_continuous_lyapunov(rest.a.T, -rest.c.T @ rest.c)
    reach, watch = _root(controllability), _root(observability)
    u, hankel, v = np.linalg.svd(watch.T @ reach)
    kept = int(np.sum(hankel > 1e-9 * hankel.max(initial=0.0)))
    if order:
        kept = min(kept, order - 1)
    scale = 1.0 / np.sqrt(hankel[:kept])
    to_rest = reach @ v[:kept].T * scale
    from_rest = (watch @ u[:, :kept] * scale).T
    a = scipy.linalg.block_diag([[poles[slow].real]], from_rest @ rest.a @ to_rest)
    b = np.vstack([b_slow / ratio, from_rest @ rest.b])
    c = np.hstack([c_slow[None, :] * ratio, rest.c @ to_rest])
    return StateSpace(a, b, c, system.d)


def _root(gramian: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))


# Discrete controller --------------------------------------------------------------------------


def tustin(transfer: TransferFunction, sample_time: float) -> StateSpace:
    """Return the discrete, balanced realisation of a continuous transfer function."""
    return from_w_plane(balanced(realise(transfer)), sample_time / TIME_UNIT)


def run_time_controller(system: StateSpace, problem: DesignProblem) -> FeedbackParameters:
    """Return the feedback law of a discrete controller from error to command.

    `system` has its slowest pole as the first state. Adds the prefilter F, so that the controller
    sees F r - y, the part of F r that goes straight to the command, and an anti-windup gain: the stationary Kalman gain of an observer of the controller,
    for noise on its error and, with a variance of ANTI_WINDUP_NOISE of that, on its command. The
    result does not count as certified: only :mod:`certificate` can say that.
    """
    a, b, c, d = system.a.copy(), system.b, system.c, system.d[0, 0]
    if problem.integrator:
        a[0, :] = 0.0
        a[:, 0] = 0.0
        a[0, 0] = 1.0
    spread = scipy.linalg.solve_discrete_are(a.T, c.T, b @ b.T, [[ANTI_WINDUP_NOISE]])
    anti_windup = a @ spread @ c.T / (ANTI_WINDUP_NOISE + c @ spread @ c.T)
    filtered = realise(prefilter_transfer(problem.prefilter))
    filtered = from_w_plane(filtered, problem.finger.sample_time / TIME_UNIT)
    # F r - y = e + (F - 1) r.
    direct = filtered.d[0, 0] - 1.0
    size = len(filtered.a)
    whole = np.block([[a, b @ filtered.c], [np.zeros((size, len(a))), filtered.a]])
    without = np.zeros((size, 1))

    def values(*parts: np.ndarray) -> tuple[float, ...]:
        return tuple(float(x) for x in np.concatenate([np.ravel(part) for part in parts]))

    return FeedbackParameters(
        controller="state_space",
        name=problem.name,
        delay_samples=problem.finger.delay_samples,
        denominator=problem.finger.denominator,
        sample_time=problem.finger.sample_time,
        command_low=problem.finger.command_low,
        command_high=problem.finger.command_high,
        a=values(whole),
        b=values(b, without),
        c=values(c, (d + problem.feedforward) * filtered.c),
        d=float(d),
        reference_b=values(b * direct, filtered.b) if size else (),
        reference_d=float(d * direct + problem.feedforward * filtered.d[0, 0]),
        anti_windup=values(anti_windup, without),
    )


def prefilter_transfer(prefilter: Prefilter) -> TransferFunction:
    """Return the prefilter, 1 for the frequency 0."""
    omega = prefilter.frequency
    if omega == 0.0:
        return TransferFunction((1.0,), (1.0,))
    return TransferFunction((omega**2,), (1.0, 2.0 * prefilter.damping * omega, omega**2))


# Tuning ---------------------------------------------------------------------------------------


def tune(problem: DesignProblem) -> DesignProblem:
    """Return the problem with its weights, or its controller, found from the specifications.

    Deterministic. Minimises the worst settling time over the corners of the box, plus penalties for
    what exceeds a specification; the start follows from settling time and resonance.
    """
    complete, start = {
        "hinf": (_hinf_candidate, _hinf_start),
        "damped_integrator": (_damped_candidate, _damped_start),
        "pid": (_pid_candidate, _pid_start),
        "integrator_notch": (_notch_candidate, _notch_start),
    }[problem.method]
    corners = certificate.Box(problem, resonance=5, damping=3, gain=3, points=240)

    def cost(logarithms: np.ndarray) -> float:
        candidate = complete(problem, np.exp(logarithms))
        try:
            controller = synthesize(candidate).controller
        except (SynthesisError, np.linalg.LinAlgError, ValueError):
            return 1e6
        return corners.cost(controller, TUNING_RESERVE)

    start_logarithms = np.log(start(problem))
    simplex = np.vstack([start_logarithms, start_logarithms + 0.25 * np.eye(len(start_logarithms))])
    best = scipy.optimize.minimize(
        cost,
        start_logarithms,
        method="Nelder-Mead",
        options={"maxfev": TUNING_EVALUATIONS, "initial_simplex": simplex, "adaptive": True},
    )
    if best.fun >= 1e6:
        raise SynthesisError(f"tuning '{problem.method}' found no controller at all")
    return complete(problem, np.exp(best.x))


def _resonance(problem: DesignProblem) -> float:
    return 1.0 / math.sqrt(problem.finger.denominator[0])


def _hinf_start(problem: DesignProblem) -> list[float]:
    omega = _resonance(problem)
    return [
        3.0 / problem.specification.settling_time,
        3.0,
        0.3,
        1e-3,
        7.0 * omega,
        0.45 * omega,
        0.6,
    ]


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


def _damped_start(problem: DesignProblem) -> list[float]:
    """Return the best of a long search for the default finger, scaled to this one's resonance."""
    omega = _resonance(problem)
    delay = min(max(problem.finger.delay_samples, 1), len(DAMPED_STARTS))
    return (DAMPED_STARTS[delay - 1] * np.where(IS_FREQUENCY, omega, 1.0)).tolist()


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


def _pid_start(problem: DesignProblem) -> list[float]:
    rate = 3.0 / problem.specification.settling_time
    return [rate, 1e-3, 1e-6, 0.5 * _resonance(problem)]


def _pid_candidate(problem: DesignProblem, x: np.ndarray) -> DesignProblem:
    integral, proportional, derivative, roll_off = (float(v) for v in x)
    return _given(
        problem,
        (derivative, proportional, integral),
        (1.0 / roll_off**2, math.sqrt(2.0) / roll_off, 1.0, 0.0),
    )


def _notch_start(problem: DesignProblem) -> list[float]:
    rate = 3.0 / problem.specification.settling_time
    return [rate, _resonance(problem), 0.1, 0.5 * _resonance(problem), 0.7]


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
