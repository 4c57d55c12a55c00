# SPDX-License-Identifier: Apache-2.0
"""Prove a loop's robustness over a whole box of fingers, not at samples of it.

Zero exclusion: the poles of a loop move continuously with its finger, so where one finger of a connected
family is stable and

    1 + K(z) (g G(z) + Delta(z)) != 0    for every z on the unit circle, every finger, every Delta,

all of them are. G has resonance and damping ratio of the box, g its gain, and Delta is any stable dynamics
with |Delta| <= W, the weight of what nobody modelled behind the largest gain. Its static share is taken from the
first mode, so G is that of the box times 1 ± share / first; what that is too much for the other modes is in W. That follows from, and the sensitivity is at most Ms by,

    |1 + g K G| > |K| W        and        |1 + g K G| >= 1 / Ms.

Frequency, resonance and damping ratio are cut into cells (interval analysis). In a cell G is known to

    |dT| <= (|dp| |1 - zc| + |dz| |1 - pc|) / (|zc - pc| (|zc - pc| - |dz| - |dp|)),    T = (1 - p) / (z - p),

for each pole p of the sampled finger, K by the same rule for its residues, and the gain's interval is
exact: a line in the complex plane. Where poles of the finger meet, because it may hardly ring, its resolvent is
bounded instead: |dR| <= |R|² d / (1 - |R| d), d the change of z - A. A cell that proves nothing is cut in two. Unlike the upper bound of the
structured singular value this leaves no gap: it ends with a proof, or with a finger that violates.

Sources: Ackermann, Robust Control (Springer 2002), ch. 4 (zero exclusion); Moore, Kearfott, Cloud,
Introduction to Interval Analysis (SIAM 2009), ch. 6.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np

from piezo_control.design.problem import DesignProblem, FingerModel
from piezo_control.feedback import FeedbackParameters

RINGING = 0.9  # damping ratio up to which the poles are far enough apart
MOST_CELLS = 4_000_000
INTEGRATOR = 1e-9  # a pole so near to 1 is one
RESIDUES = 1e-7  # relative; more than that is lost when poles coincide
BINS = 4096  # of the weight, evenly up to the Nyquist frequency
COARSEST = 8  # bins of the cells at the beginning


class Proof(NamedTuple):
    """What came out: `holds`, after `cells` cells; if not, `why`."""

    holds: bool
    cells: int
    why: str


def unmodelled_weight(problem: DesignProblem, angle: np.ndarray) -> np.ndarray:
    """Return W at `angle` (rad per sample): what the worst mode that nobody modelled can add.

    Over all modes from `unmodelled_from_hz` on, those beyond the Nyquist frequency too, which the hold
    attenuates and the sampling folds down: their largest response to a held command, times the share and the
    largest gain.
    """
    u, sample_time = problem.uncertainty, problem.finger.sample_time
    if u.unmodelled_share == 0.0:
        return np.zeros_like(angle)
    lowest = 2.0 * math.pi * u.unmodelled_from_hz * sample_time
    z = np.exp(1j * angle)

    def response(pole: complex, damping: float) -> np.ndarray:
        part = 0.5 - 0.5j * damping / math.sqrt(1.0 - damping**2)
        alone = part * (1.0 - pole) / (z - pole)
        other = np.conj(pole)
        return alone + np.conj(part) * (1.0 - other) / (z - other)

    # A quarter of a mode's half width per step, up to where the hold has made it harmless.
    steps = np.exp(np.arange(0.0, math.log(20.0), 0.25 * u.unmodelled_damping))
    largest = np.zeros_like(angle)
    for omega in lowest * steps:
        pole = _pole(omega, u.unmodelled_damping)
        np.maximum(largest, np.abs(response(pole, u.unmodelled_damping)), out=largest)
    modelled = np.zeros_like(z)
    modes = problem.finger.modes
    for hertz, damping, share in zip(modes.frequency_hz, modes.damping, modes.share):
        pole = _pole(2.0 * math.pi * hertz * sample_time, damping)
        modelled += share * response(pole, damping)
    beside = np.abs(modelled) / (1.0 - sum(modes.share))
    return u.gain_high * u.unmodelled_share * (largest + beside)


def _pole(angle: float, damping: float) -> complex:
    """Return the sampled pole of a mode whose natural frequency is `angle` (rad per sample)."""
    return cmath.exp(angle * complex(-damping, math.sqrt(1.0 - damping**2)))


class Loop(NamedTuple):
    """The loop's fixed numbers: controller in partial fractions, finger, delay and lag."""

    poles: np.ndarray
    residues: np.ndarray
    direct: float
    integral: float  # residue of the integrator; NaN: has none
    model: FingerModel


def prove(
    problem: DesignProblem,
    controller: FeedbackParameters,
    spread: float,
    smallest: float = 0.0,
    unmodelled: float = 0.0,
) -> Proof:
    """Prove |1 + g K G| > smallest + unmodelled |K| W over the continuous box.

    Parameters
    ----------
    spread : float
        Relative range of the resonance, to both sides.
    smallest : float
        1 / Ms to be proven; 0 for stability.
    unmodelled : float
        Factor on W: 1 for the problem's own, 0 for the fingers of the box themselves.

    A proof of stability needs one stable finger besides: the certificate's rows have it.
    """
    model, u = problem.finger, problem.uncertainty
    a2, a1, _ = model.denominator
    natural, ratio = 1.0 / math.sqrt(a2), 0.5 * a1 / math.sqrt(a2)
    loop = _partial_fractions(controller, model)
    if loop is None:
        return Proof(False, 0, "poles of the controller coincide; there is no proof for it")
    share = u.unmodelled_share if unmodelled else 0.0
    change = share / (1.0 - sum(model.modes.share))
    gain = u.gain_low * (1.0 - change), u.gain_high * (1.0 + change)
    edges = np.linspace(0.0, math.pi, BINS + 1)
    first = BINS // COARSEST
    weight = np.zeros(BINS)
    if share:
        # The weight between two points, from the finer ones in between.
        fine = unmodelled_weight(problem, np.linspace(0.0, math.pi, 8 * BINS + 1))
        weight = 1.01 * np.maximum.reduceat(fine[:-1], np.arange(0, 8 * BINS, 8))
        weight = unmodelled * np.maximum(weight, 1.01 * fine[8::8])
    start = np.array(
        [
            edges[:-1:COARSEST], edges[COARSEST::COARSEST],
            np.full(first, (1.0 - spread) * natural), np.full(first, (1.0 + spread) * natural),
            np.full(first, u.damping_low * ratio), np.full(first, u.damping_high * ratio),
        ]
    )  # fmt: skip
    cells, count = start, 0
    while cells.shape[1]:
        count += cells.shape[1]
        if count > MOST_CELLS:
            return Proof(False, count, f"no end after {MOST_CELLS} cells")
        bound, centre, parts = _bounds(loop, cells, gain, weight, smallest)
        if np.any(centre < 0.0):
            worst = int(np.argmin(centre))
            middle = 0.5 * (cells[::2, worst] + cells[1::2, worst])
            return Proof(
                False,
                count,
                f"violated at {middle[0] / model.sample_time / 2.0 / math.pi:.0f} Hz by the finger with "
                f"resonance {100.0 * (middle[1] / natural - 1.0):+.3g} %, damping "
                f"x{middle[2] / ratio:.3g}",
            )
        cells = _cut(cells[:, bound <= 0.0], parts[:, bound <= 0.0])
    return Proof(True, count, "")


def _partial_fractions(p: FeedbackParameters, model: FingerModel) -> Loop | None:
    poles, vectors = np.linalg.eig(p.matrix("a"))
    try:
        residues = (p.matrix("c") @ vectors) * np.linalg.solve(vectors, p.matrix("b") + 0j)
    except np.linalg.LinAlgError:
        return None
    # Modes of the prefilter are in the matrices, but the error does not reach them.
    heard = np.abs(residues) > 1e-14
    poles, residues = poles[heard], residues[heard]
    for z in np.exp(1j * np.array([0.01, 0.3, 1.0, 3.0])):
        exact = p.matrix("c") @ np.linalg.solve(z * np.eye(p.order) - p.matrix("a"), p.matrix("b"))
        if abs((residues / (z - poles)).sum() - exact) > RESIDUES * (abs(exact) + 1.0):
            return None
    is_integral = np.abs(poles - 1.0) < INTEGRATOR
    integral = float(residues[is_integral].sum().real) if is_integral.any() else math.nan
    return Loop(poles[~is_integral], residues[~is_integral], p.d, integral, model)


def _bounds(
    loop: Loop,
    cells: np.ndarray,
    gain: tuple[float, float],
    weight: np.ndarray,
    smallest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for each cell, what is proven (> 0), what its centre has, and what its three sides cost.

    Both sides of the claim are multiplied by z - 1 when the controller has an integrator.
    """
    model, h = loop.model, loop.model.sample_time
    middle, half = 0.5 * (cells[::2] + cells[1::2]), 0.5 * (cells[1::2] - cells[::2])
    z, dz = np.exp(1j * middle[0]), half[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Controller, times z - 1 if it integrates.
        distance = np.abs(z - loop.poles[:, None])
        free = np.maximum(distance - dz, 0.0)
        k = loop.direct + (loop.residues[:, None] / (z - loop.poles[:, None])).sum(axis=0)
        k_off = (np.abs(loop.residues)[:, None] * dz / (distance * free)).sum(axis=0)
        factor, factor_off = np.ones_like(z), np.zeros_like(dz)
        if not math.isnan(loop.integral):
            factor, factor_off = z - 1.0, dz
            k_off = np.abs(factor) * k_off + dz * (np.abs(k) + k_off)
            k = loop.integral + factor * k
        # Finger: the first mode of the box, then the fixed ones.
        zeta_edge = cells[5]
        of_resonance = h * half[1] * np.ones_like(dz)
        first = 1.0 - sum(model.modes.share)
        if np.all(zeta_edge < RINGING):
            ringing = np.sqrt(1.0 - middle[2] ** 2)
            p = np.exp(h * middle[1] * (-middle[2] + 1j * ringing))
            of_damping = h * cells[3] * half[2] / np.sqrt(1.0 - zeta_edge**2)
            part = 0.5 - 0.5j * middle[2] / ringing
            part_off = 0.5 * half[2] / (1.0 - zeta_edge**2) ** 1.5
            g, g_off = _mode(z, dz, p, of_resonance + of_damping, part, part_off)
        else:
            of_resonance = (1.0 + 2.0 * zeta_edge) * of_resonance
            of_damping = 2.0 * h * cells[3] * half[2]
            g, g_off = _damped_mode(z, dz, h * middle[1], middle[2], of_resonance + of_damping)
        g, g_off = first * g, abs(first) * g_off
        for hertz, zeta, share in zip(
            model.modes.frequency_hz, model.modes.damping, model.modes.share
        ):
            ring = math.sqrt(1.0 - zeta**2)
            own = np.full_like(z, _pole(2.0 * math.pi * hertz * h, zeta))
            more, more_off = _mode(z, dz, own, 0.0 * dz, 0.5 - 0.5j * zeta / ring, 0.0)
            g, g_off = g + share * more, g_off + abs(share) * more_off
        lag = math.exp(-2.0 * math.pi * model.amplifier_bandwidth_hz * h)
        lag = lag if model.amplifier_bandwidth_hz else 0.0
        # The amplifier (1 - lag) z / (z - lag) and the delay: |dz| each, and what the pole adds.
        ahead = (1.0 - lag) * z / (z - lag) * z ** (-model.delay_samples)
        rate = model.delay_samples + lag / np.maximum(np.abs(z - lag) - dz, 1e-12)
        g_off = np.abs(ahead) * (g_off + dz * rate * (np.abs(g) + g_off) * (1.0 + dz * rate))
        g = ahead * g
        way, way_off = k * g, np.abs(k) * g_off + k_off * (np.abs(g) + g_off)
        # The nearest point of the line of gains.
        square = np.maximum(np.abs(way) ** 2, 1e-300)
        nearest = np.clip(-(np.conj(way) * factor).real / square, *gain)
        value = np.abs(factor + nearest * way)
        claim = smallest * np.abs(factor)
        claim_off = smallest * factor_off
        bins = np.clip((cells[0] / math.pi * BINS + 1e-9).astype(int), 0, BINS - 1)
        last = np.clip((cells[1] / math.pi * BINS - 1e-9).astype(int), 0, BINS - 1)
        most = least = weight[bins]
        for step in range(1, COARSEST):
            other = weight[np.minimum(bins + step, last)]
            most, least = np.maximum(most, other), np.minimum(least, other)
        off = factor_off + gain[1] * way_off + claim_off + k_off * most
        centre = value - claim - np.abs(k) * least
        proven = value - claim - np.abs(k) * most - off
        bound = np.where(np.isfinite(off), proven, -np.inf)
    cost = np.array([dz / h, of_resonance / h, of_damping / h])
    return bound, centre, cost


def _mode(
    z: np.ndarray,
    dz: np.ndarray,
    p: np.ndarray,
    dp: np.ndarray,
    part: np.ndarray | complex,
    part_off: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return part T(p) + conj(part) T(conj p), and by how much it varies in the cell."""
    total, off = np.zeros_like(z), np.zeros_like(dz)
    for pole, factor in ((p, part), (np.conj(p), np.conj(part))):
        distance = np.abs(z - pole)
        t = (1.0 - pole) / (z - pole)
        t_off = (dp * np.abs(1.0 - z) + dz * np.abs(1.0 - pole)) / (
            distance * np.maximum(distance - dz - dp, 0.0)
        )
        total = total + factor * t
        off = off + np.abs(factor) * t_off + part_off * (np.abs(t) + t_off)
    return total, off


def _damped_mode(
    z: np.ndarray, dz: np.ndarray, angle: np.ndarray, zeta: np.ndarray, da: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mode of natural frequency `angle` (rad per sample), and by how much it varies in the cell.

    Any damping ratio: 1 - (z - 1) R, R the first entry of (z - A)^-1, A = exp(angle [[0, 1], [-1, -2 zeta]]), which
    varies by `da` at most.
    """
    ringing = np.emath.sqrt(1.0 - zeta**2) + 0j
    envelope = np.exp(-zeta * angle)
    even = envelope * np.cos(ringing * angle).real
    odd = envelope * (angle * np.sinc(ringing * angle / np.pi)).real
    above, below = z - even - zeta * odd, z - even + zeta * odd
    determinant = above * below + odd**2
    size = np.sqrt(np.abs(above) ** 2 + np.abs(below) ** 2 + 2.0 * odd**2) / np.abs(determinant)
    d = dz + da
    change = np.where(size * d < 1.0, size**2 * d / (1.0 - size * d), np.inf)
    off = np.abs(z - 1.0) * change + dz * (size + change)
    return 1.0 - (z - 1.0) * below / determinant, off


def _cut(cells: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return the cells, each cut in two along the side that costs most."""
    lower, upper = cells.copy(), cells.copy()
    side = np.argmax(cost, axis=0)
    row = np.arange(cells.shape[1])
    middle = 0.5 * (cells[2 * side, row] + cells[2 * side + 1, row])
    lower[2 * side + 1, row] = middle
    upper[2 * side, row] = middle
    return np.concatenate([lower, upper], axis=1)
