# SPDX-License-Identifier: Apache-2.0
"""State-space systems of one input and output: w-plane, realisation, balancing, Tustin.

The bilinear transform to the w-plane keeps stability and every H-infinity norm, so delay and sampling are
part of a design there. Inside, time is in milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

from piezo_control.design.problem import SynthesisError, TransferFunction

TIME_UNIT = 1e-3
WIDEST = 1e50  # ratio of coefficients: squares of it are squared again


class StateSpace(NamedTuple):
    """x' = a x + b u, y = c x + d u, or the same from sample to sample."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray


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
    numerator, denominator = scaled(transfer.numerator), scaled(transfer.denominator)
    sizes = np.abs(np.concatenate((numerator, denominator)))
    if sizes.max() > WIDEST * sizes[sizes > 0.0].min():
        raise SynthesisError(
            f"the coefficients of {transfer.numerator} / {transfer.denominator} are more than a factor of "
            f"{WIDEST:g} apart, in rad/ms: beyond what the design computes with"
        )
    return StateSpace(*scipy.signal.tf2ss(numerator, denominator))


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
    c_slow = system.c @ mode
    if (dual @ mode) * (dual @ system.b)[0] * c_slow[0] == 0.0:
        raise SynthesisError(
            f"the controller's slowest pole, {poles[slow].real / TIME_UNIT:.4g} rad/s, is double or cancelled by "
            "a zero, must be neither: it is the integrator"
        )
    b_slow = dual @ system.b / (dual @ mode)
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


def tustin(transfer: TransferFunction, sample_time: float) -> StateSpace:
    """Return the discrete, balanced realisation of a continuous transfer function."""
    return from_w_plane(balanced(realise(transfer)), sample_time / TIME_UNIT)
