"""Figures that describe a response: settling, overshoot, static error, band.

Every figure is defined in its docstring; times are measured from the step, relative figures are
fractions (0.05 is 5 %) of the step, that is of the change of the reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class StepMetrics(NamedTuple):
    """Figures of a step response, see :func:`step_metrics`."""

    settling_5_reference_s: float
    settling_2_reference_s: float
    settling_5_final_s: float
    settling_2_final_s: float
    rise_s: float
    overshoot: float
    static_error: float
    final: float


def settling_time(time: ArrayLike, value: ArrayLike, target: float, band: float) -> float:
    """Return the time from time[0] after which ``|value - target| <= band`` for good, in s.

    It is the instant of the first sample from which on all samples are inside the band; infinite
    when the last sample is outside. `time` and `value` are 1-D arrays with shape (nsamples,), `band`
    and `target` have the unit of `value`.
    """
    time = np.asarray(time, dtype=float)
    outside = np.flatnonzero(~(np.abs(np.asarray(value, dtype=float) - target) <= band))
    if outside.size == 0:
        return 0.0
    if outside[-1] + 1 == time.size:
        return float("inf")
    return float(time[outside[-1] + 1] - time[0])


def step_metrics(
    time: ArrayLike, value: ArrayLike, reference: float, initial: float = 0.0, tail: float = 0.1
) -> StepMetrics:
    """Return the figures of the response to a step of the reference.

    Parameters
    ----------
    time, value : array_like
        1-D arrays with shape (nsamples,) in s and m; time[0] is the instant of the step.
    reference, initial : float
        Value of the reference after and before the step, in m. Their difference is the step.
    tail : float
        Fraction of the record, at its end, whose mean is the final value.

    Returns
    -------
    StepMetrics
        * ``settling_5_reference_s``, ``settling_2_reference_s``: settling into 5 % and 2 % of the
          step around the **reference**, so a static error above the band never settles;
        * ``settling_5_final_s``, ``settling_2_final_s``: the same around the **final value**, the
          band a fraction of the change from `initial` to it (the usual definition, and the one by
          which the paper's controller needs 13.3 ms);
        * ``rise_s``: from the first crossing of 10 % to that of 90 % of the change to the final
          value, between samples by linear interpolation; infinite when 90 % is never reached;
        * ``overshoot``: how far the response exceeds the **reference**, as a fraction of the step,
          0 when it never does;
        * ``static_error``: ``|reference - final| / |step|``;
        * ``final``: the final value in m.

    Raises ValueError when the step is zero or the arrays do not fit together.
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    step = reference - initial
    if time.shape != value.shape or time.ndim != 1 or time.size < 2:
        raise ValueError(
            f"time {time.shape} and value {value.shape} must be equal 1-D shapes of 2 or more"
        )
    if step == 0.0:
        raise ValueError("reference and initial are equal: there is no step")
    progress = (value - initial) / step
    final = float(np.mean(progress[-max(1, round(tail * time.size)) :]))
    return StepMetrics(
        settling_5_reference_s=settling_time(time, progress, 1.0, 0.05),
        settling_2_reference_s=settling_time(time, progress, 1.0, 0.02),
        settling_5_final_s=settling_time(time, progress, final, 0.05 * abs(final)),
        settling_2_final_s=settling_time(time, progress, final, 0.02 * abs(final)),
        rise_s=_first_crossing(time, progress, 0.9 * final)
        - _first_crossing(time, progress, 0.1 * final),
        overshoot=max(0.0, float(np.max(progress)) - 1.0),
        static_error=abs(1.0 - final),
        final=initial + step * final,
    )


def _first_crossing(time: np.ndarray, value: np.ndarray, level: float) -> float:
    above = np.flatnonzero(value * np.sign(level) >= abs(level))
    if above.size == 0:
        return float("inf")
    i = above[0]
    if i == 0:
        return float(time[0])
    return float(
        time[i - 1] + (level - value[i - 1]) / (value[i] - value[i - 1]) * (time[i] - time[i - 1])
    )


def rms(value: ArrayLike) -> float:
    """Return the root mean square of `value`, in its unit."""
    return float(np.sqrt(np.mean(np.square(np.asarray(value, dtype=float)))))
