# SPDX-License-Identifier: Apache-2.0
"""How well a model describes a measurement, and what is too little to be written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piezo_control.identification.measurement import MeasurementError

LARGEST_RMS_PERCENT = 10.0
"""Of the stroke: a straight line through a piezo actuator's loop misses by 5 to 9 %."""
GOOD_RMS_PERCENT = 1.0
"""Of the largest stroke: so little is not compared with what less of a model leaves."""
LARGEST_SHARE = 0.5
"""Of what less of a model leaves."""


@dataclass(frozen=True)
class FitQuality:
    """Deviation of a model from a measurement."""

    rms: float  # m
    maximum: float  # m
    stroke: float  # m, from the lowest to the highest deflection
    share: (
        float  # of what less of a model leaves, both without the sensor's noise; NaN: not compared
    )

    @property
    def rms_percent(self) -> float:
        """Root mean square as a percentage of the stroke."""
        return 100.0 * self.rms / self.stroke

    @property
    def maximum_percent(self) -> float:
        """Largest deviation as a percentage of the stroke."""
        return 100.0 * self.maximum / self.stroke


def noise(values: NDArray[np.float64]) -> float:
    """Return the standard deviation of white noise on a slow signal: by its second differences' median."""
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6.0))


def quality(
    measured: NDArray[np.float64],
    modelled: NDArray[np.float64],
    less: NDArray[np.float64] | None = None,
) -> FitQuality:
    """Compare histories of deflection (m): measured, modelled, and modelled by less, as by a straight line."""
    deviation = measured - modelled
    square, share = float(np.mean(deviation**2)), np.nan
    if less is not None:
        white = noise(measured) ** 2
        left = max(float(np.mean((measured - less) ** 2)) - white, np.finfo(float).tiny)
        share = float(np.sqrt(max(square - white, 0.0) / left))
    return FitQuality(
        float(np.sqrt(square)), float(np.abs(deviation).max()), float(np.ptp(measured)), share
    )


def column_norms(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the norms of columns, whose units differ; 1 for a column of zeros."""
    norms = np.linalg.norm(matrix, axis=0)
    return np.where(norms == 0.0, 1.0, norms)


def straight(
    measured: NDArray[np.float64], *regressors: NDArray[np.float64], fitted: slice = slice(None)
) -> NDArray[np.float64]:
    """Return the sum of multiples of `regressors` and a constant that is closest where it is `fitted`."""
    matrix = np.column_stack((np.ones_like(measured), *regressors))
    scaled = matrix / column_norms(matrix)
    return scaled @ np.linalg.lstsq(scaled[fitted], measured[fitted], rcond=None)[0]


def need(source: str, fits: dict[str, FitQuality], less: str, reason: str = "") -> None:
    """Raise MeasurementError for a fit that explains too little, or hardly more than `less` of a model.

    It says the `reason`, where there is one, else what to look for.
    """
    good = 0.01 * GOOD_RMS_PERCENT * max(fit.stroke for fit in fits.values())
    for part, fit in fits.items():
        said = f"{part}: rms {fit.rms_percent:.1f} % of the stroke"
        look = "look for outliers, a reversed sign, wrong columns, or an actuator of another kind"
        advice = f"nothing written; {reason or look}"
        if not fit.rms_percent <= LARGEST_RMS_PERCENT:
            raise MeasurementError(
                f"{source}: the fit explains too little ({said}, must be at most {LARGEST_RMS_PERCENT:g} %), {advice}"
            )
        if fit.rms > good and fit.share > LARGEST_SHARE:
            raise MeasurementError(
                f"{source}: the fit explains too little ({said}, {100.0 * fit.share:.0f} % of what {less} leaves, must "
                f"be at most {100.0 * LARGEST_SHARE:g} %), {advice}"
            )
