# SPDX-License-Identifier: Apache-2.0
"""How well identified parameters are known: 95 % intervals by the linearised model, for correlated residuals.

What a model leaves of a measurement is hardly ever white: a sensor's noise is filtered, a model's error comes back
in every cycle. Numbers that are fitted have the covariance::

    A^-1 B A^-1,    A = J^T J + P^T P

with the rows P of a penalty, if the fit had one: its bias is not in the interval. For B there are two, and the larger
interval counts:

- J^T C J, C being the residual's autocovariance up to its first zero, for a noise that is the same all the time; the
  residual is scaled by what the fit takes of it;
- sum_b g_b g_b^T, for a model's error that is larger in places: g_b = (I - J_b^T J_b A^-1)^-1/2 J_b^T r_b, summed over
  blocks that are longer than the residual's memory and independent of each other (K.-Y. Liang and S. L. Zeger, Biometrika 73
  (1986) 13), with what a block draws the model to itself undone (R. M. Bell and D. F. McCaffrey, Survey
  Methodology 28 (2002) 169).

How far choices within the model lead away, which the measurement does not tell from the one made, is added. Values that
follow from the fitted numbers have their intervals by the derivative. Numbers at a bound count as known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matmul_toeplitz
from scipy.stats import t

from piezo_control.identification.fit import column_norms

PROBABILITY = 0.95
MEMORIES = 5  # correlation lengths of the residual in a block
FEWEST_BLOCKS, MOST_BLOCKS = 10, 200
LEAST_LEFT = 1e-6  # of the square of an error, where a block draws the model to itself
LEAST_FREEDOM = 2.0

Values = Mapping[str, float | tuple[float, ...]]


def memory(residual: NDArray[np.float64]) -> float:
    """Return over how many samples a residual is correlated: the sum of its correlations up to the first zero."""
    covariance = _autocovariance(residual)
    return float(2.0 * covariance.sum() / covariance[0] - 1.0) if covariance[0] > 0.0 else 1.0


def _autocovariance(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of samples that are 0, 1, … apart, up to its first zero."""
    size = residual.size
    spectrum = np.abs(np.fft.rfft(residual - residual.mean(), 2 * size)) ** 2
    covariance = np.fft.irfft(spectrum)[:size] / size
    end = int(np.argmax(covariance <= 0.0)) or size
    return covariance[: end if covariance[0] > 0.0 else 1]


def intervals(
    values: Callable[[NDArray[np.float64]], Values],
    fitted: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    residual: NDArray[np.float64],
    penalty: NDArray[np.float64] | None = None,
    others: Sequence[NDArray[np.float64]] = (),
) -> Values:
    """Return half the width of the 95 % interval of each of the `values`.

    Parameters
    ----------
    values : named values as a function of the fitted numbers
    fitted : 1-D array of shape (p,), the fitted numbers
    jacobian : shape (n, p), derivative of model or residual; zeros for a number that is known or at a bound
    residual : 1-D array of shape (n,), in the order of time
    penalty : shape (m, p), rows that were minimised along
    others : what is fitted under other choices, as good as the one made

    Returns
    -------
    dict
        Of the same names and shapes as what `values` returns.
    """
    norms = column_norms(jacobian)
    scaled = jacobian / norms
    rows = scaled if penalty is None else np.concatenate((scaled, penalty / norms))
    root = np.linalg.pinv(np.linalg.qr(rows, mode="r"))  # of A^-1
    sides = scaled @ root
    root /= norms[:, None]

    def flat(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([np.atleast_1d(value) for value in values(numbers).values()])

    deviations = np.std(residual) * np.linalg.norm(root, axis=1) * jacobian.any(axis=0)
    gradient = np.zeros((flat(fitted).size, fitted.size))
    for i in np.flatnonzero(deviations):
        step = np.zeros_like(fitted)
        step[i] = 0.01 * min(deviations[i], abs(fitted[i]) or np.inf)  # no sign changes
        gradient[:, i] = (flat(fitted + step) - flat(fitted - step)) / (2.0 * step[i])
    contrasts = gradient @ root
    spread = np.maximum(
        _by_autocovariance(contrasts, sides, residual), _by_blocks(contrasts, sides, residual)
    )
    away = [np.abs(flat(other) - flat(fitted)) for other in others]
    spread += np.max(away, axis=0, initial=0.0)
    widths, here = {}, 0
    for name, value in values(fitted).items():
        size = np.size(value)
        part = spread[here : here + size].tolist()
        widths[name] = tuple(part) if np.ndim(value) else part[0]
        here += size
    return widths


def _quantile(freedom: float) -> float:
    return float(t.ppf(0.5 + 0.5 * PROBABILITY, freedom))


def _by_autocovariance(
    contrasts: NDArray[np.float64], sides: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return half widths for a noise that is the same all the time; `sides` are J times the root of A^-1."""
    covariance = np.zeros(residual.size)
    correlated = _autocovariance(residual)
    covariance[: correlated.size] = correlated
    middle = sides.T @ matmul_toeplitz(covariance, sides)
    squares = np.einsum("ij,jk,ik->i", contrasts, middle, contrasts)
    independent = residual.size / memory(residual)
    left = max(independent - float(np.sum(sides**2)), LEAST_FREEDOM)
    scale = max(independent / left, 1.0)
    return _quantile(left) * np.sqrt(np.maximum(squares, 0.0) * scale)


def _by_blocks(
    contrasts: NDArray[np.float64], sides: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return half widths for errors that are larger in some blocks than in others."""
    length = max(MEMORIES * memory(residual), residual.size / MOST_BLOCKS)
    blocks = max(int(residual.size / length), FEWEST_BLOCKS)
    squares = np.zeros(len(contrasts))
    for part in np.array_split(np.arange(residual.size), blocks):
        leverage, directions = np.linalg.eigh(sides[part].T @ sides[part])
        score = directions.T @ (sides[part].T @ residual[part])
        undone = score / np.sqrt(np.maximum(1.0 - leverage, LEAST_LEFT))
        squares += (contrasts @ (directions @ undone)) ** 2
    return _quantile(blocks - 1) * np.sqrt(squares)


def lines(found: Values, widths: Values) -> list[str]:
    """Return 'name: value ± half the width' for people, one line for each name that has an interval."""
    return [
        f"{name}: "
        + ", ".join(
            f"{value:.5g} ± {half:.2g}"
            for value, half in zip(np.atleast_1d(found[name]), np.atleast_1d(width))
        )
        for name, width in widths.items()
        if np.any(width)
    ]
