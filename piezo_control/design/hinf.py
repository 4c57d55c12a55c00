# SPDX-License-Identifier: Apache-2.0
"""H-infinity synthesis: the controller of a problem's weights.

Sampled finger with its delay (linear_loop) → w-plane → generalised plant

    e = r - G (u + Wd d),   z = (Ws e, Wu u),   controller sees e

→ smallest gamma by bisection over SLICOT's SB10AD (Glover and Doyle 1988, the routine behind
``control.hinfsyn``, which offers neither a bound nor a tolerance and can scan for hours) → balanced
realisation, truncated to the wanted order → back to discrete time.

The disturbance d at the finger's input keeps the optimum from cancelling the resonance; the effort
weight keeps the problem regular.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from types import ModuleType

import numpy as np
import scipy.linalg

from piezo_control.design import linear_loop
from piezo_control.design.problem import DesignProblem, FingerModel, SynthesisError, Weights
from piezo_control.design.state_space import (
    TIME_UNIT,
    StateSpace,
    balanced,
    from_w_plane,
    realise,
    to_w_plane,
)

LARGEST_GAMMA = 1e4
GAMMA_TOLERANCE = 0.01
FASTEST_POLE = 1e5
"""Per sample, in the w-plane; what is faster comes from a singular problem."""


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


@functools.cache
def slicot() -> ModuleType:
    """Return slycot, whose licence is GPL-2.0: a controller from weights needs it, nothing else does."""
    try:
        import slycot.exceptions
    except ImportError:
        raise SynthesisError(
            "method 'hinf' needs slycot (GPL-2.0): pip install --no-deps slycot, "
            "or use a method without weights"
        ) from None
    return slycot


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
        result = slicot().sb10ad(
            len(plant.a), inputs, outputs, 1, 1, gamma, plant.a, plant.b, plant.c, d, job=4
        )
    except slicot().exceptions.SlycotArithmeticError as error:
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
