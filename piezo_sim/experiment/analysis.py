"""From recordings to figures of merit; everything here is computed from bags alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from piezo_control.metrics import step_metrics
from piezo_control.recording import Recording

STEADY = 0.02  # s before a disturbance over which the held deflection is averaged


def step_row(recording: Recording) -> dict[str, Any]:
    """Return the figures of a step of the reference at sample 0, from rest.

    Settling is into 5 % of the final value, None when the end of the record is outside; overshoot and
    static error are in % of the reference (:func:`piezo_control.metrics.step_metrics`).
    """
    reference = float(recording.reference[-1])
    figures = step_metrics(recording.time, recording.deflection, reference)
    settling = figures.settling_5_final_s * 1e3
    return {
        "reference_um": reference * 1e6,
        "settling_time_5pct_ms": settling if math.isfinite(settling) else None,
        "overshoot_percent": figures.overshoot * 100,
        "static_error_percent": figures.static_error * 100,
        "samples": recording.time.size,
    }


def thermal_row(recording: Recording) -> dict[str, float]:
    """Return what a change of temperature does to a held deflection.

    `deflection_change_um` is the largest excursion after the first change of temperature from the mean
    of the 20 ms before it, `remaining_um` that of the last 20 ms.
    """
    change = int(np.argmax(recording.temperature != recording.temperature[0]))
    before = recording.time >= recording.time[change] - STEADY
    before &= recording.time < recording.time[change]
    held = recording.deflection[before].mean()
    away = recording.deflection[change:] - held
    last = recording.deflection[recording.time >= recording.time[-1] - STEADY].mean()
    return {
        "temperature_change_degc": float(recording.temperature[-1] - recording.temperature[0]),
        "deflection_change_um": float(np.max(np.abs(away))) * 1e6,
        "remaining_um": float(last - held) * 1e6,
        "reference_um": float(recording.reference[-1]) * 1e6,
        "samples": recording.time.size,
    }
