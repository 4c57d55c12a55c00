# SPDX-License-Identifier: Apache-2.0
"""How well identified parameters are known: 95 % intervals by the linearised model, for correlated residuals.

What a model leaves of a measurement is hardly ever white: a sensor's noise is filtered, a model's error comes back
in every cycle. So the scores J^T r are summed over blocks that are longer than the residual's memory, and the
blocks are taken as independent (the sandwich of K.-Y. Liang and S. L. Zeger, Biometrika 73 (1986) 13)::

    cov = (J^T J + P^T P)^-1 (sum_b g_b g_b^T) (J^T J + P^T P)^-1,    g_b = J_b^T r_b

with the rows P of a penalty, if the fit had one: its bias is not in the interval. Values that follow from the fitted
numbers have their intervals by the derivative. Numbers at a bound count as known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from piezo_control.identification.fit import column_norms

PROBABILITY = 0.95
MEMORIES = 5  # correlation lengths of the residual in a block
FEWEST_BLOCKS, MOST_BLOCKS = 10, 200

Values = Mapping[str, float | tuple[float, ...]]


def memory(residual: NDArray[np.float64]) -> float:
    """Return over how many samples a residual is correlated: the sum of its correlations up to the first zero."""
    size = residual.size
    spectrum = np.abs(np.fft.rfft(residual - residual.mean(), 2 * size)) ** 2
    correlation = np.fft.irfft(spectrum)[:size]
    if correlation[0] <= 0.0:
        return 1.0
    correlation /= correlation[0]
    end = int(np.argmax(correlation <= 0.0)) or size
    return float(2.0 * correlation[:end].sum() - 1.0)


def intervals(
    values: Callable[[NDArray[np.float64]], Values],
    fitted: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    residual: NDArray[np.float64],
    penalty: NDArray[np.float64] | None = None,
) -> Values:
    """Return half the width of the 95 % interval of each of the `values`.

    Parameters
    ----------
    values : named values as a function of the fitted numbers
    fitted : 1-D array of shape (p,), the fitted numbers
    jacobian : shape (n, p), derivative of model or residual; zeros for a number that is known or at a bound
    residual : 1-D array of shape (n,), in the order of time
    penalty : shape (m, p), rows that were minimised along

    Returns
    -------
    dict
        Of the same names and shapes as what `values` returns.
    """
    length = max(MEMORIES * memory(residual), residual.size / MOST_BLOCKS)
    blocks = max(int(residual.size / length), FEWEST_BLOCKS)
    directions = _directions(jacobian, residual, blocks, penalty)
    quantile = t.ppf(0.5 + 0.5 * PROBABILITY, blocks - 1)
    deviations = np.linalg.norm(directions, axis=1)

    def flat(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([np.atleast_1d(value) for value in values(numbers).values()])

    gradient = np.zeros((flat(fitted).size, fitted.size))
    for i in np.flatnonzero(deviations):
        step = np.zeros_like(fitted)
        step[i] = 0.01 * min(deviations[i], abs(fitted[i]) or np.inf)  # no sign changes
        gradient[:, i] = (flat(fitted + step) - flat(fitted - step)) / (2.0 * step[i])
    spread = quantile * np.linalg.norm(gradient @ directions, axis=1)
    widths, here = {}, 0
    for name, value in values(fitted).items():
        size = np.size(value)
        part = spread[here : here + size].tolist()
        widths[name] = tuple(part) if np.ndim(value) else part[0]
        here += size
    return widths


def _directions(
    jacobian: NDArray[np.float64],
    residual: NDArray[np.float64],
    blocks: int,
    penalty: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """Return a root of the covariance, shape (p, blocks): what each block moves the fitted numbers by."""
    norms = column_norms(jacobian)
    scaled = jacobian / norms
    rows = scaled if penalty is None else np.concatenate((scaled, penalty / norms))
    root = np.linalg.pinv(np.linalg.qr(rows, mode="r"))
    edges = np.linspace(0, residual.size, blocks + 1).astype(int)[:-1]
    scores = np.add.reduceat(scaled * residual[:, None], edges)
    return (root @ (root.T @ scores.T)) / norms[:, None] * np.sqrt(blocks / (blocks - 1))


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
