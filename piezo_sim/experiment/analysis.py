# SPDX-License-Identifier: Apache-2.0
"""From a recording to its figures of merit; everything here is computed from bags alone.

There is one analysis per kind of experiment, a function of a recording that returns ``{quantity: value}``.
`QUANTITIES` says how each is shown and what it is; :func:`analyse` makes a value that does not
exist, a settling that never comes, None.
The definitions are those of :mod:`piezo_control.metrics`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from piezo_control import metrics
from piezo_control.recording.recording import BagError, Recording

Figures = dict[str, float | int | None]


class Quantity(NamedTuple):
    """How a figure is shown: heading with unit, decimals; and what it is, in a sentence for reports."""

    heading: str
    digits: int
    definition: str


QUANTITIES = {
    "reference_um": Quantity("reference [µm]", 1, "last value of the reference"),
    "final_um": Quantity("final deflection [µm]", 2, "mean of the last tenth of the record (creep: of its last 0.5 s)"),
    "ringing_hz": Quantity("ringing [Hz]", 1, "frequency of the vibration around the final deflection"),
    "damping_ratio": Quantity("damping ratio", 4, "of that vibration, from its decay"),
    "rise_time_ms": Quantity("rise 10–90 % [ms]", 2, "time from 10 to 90 % of the way to the final deflection"),
    "settling_time_5pct_ms": Quantity("settling to 5 % [ms]", 1, "time from the step after which the deflection stays within 5 % of its way around the final value"),
    "settling_time_2pct_ms": Quantity("settling to 2 % [ms]", 1, "the same for 2 %"),
    "overshoot_percent": Quantity("overshoot [%]", 2, "how far the deflection goes beyond the reference, in % of the step"),
    "static_error_percent": Quantity("static error [%]", 3, "distance of the mean of the last tenth of the record from the reference, in % of the step"),
    "creep_um": Quantity("creep [µm]", 2, "way from 1 s after the step of the voltage to the end, both averaged over 0.5 s"),
    "creep_percent": Quantity("creep [%]", 1, "creep in % of the deflection 1 s after the step"),
    "mean_error_um": Quantity("mean error [µm]", 3, "mean of the deflection less the reference"),
    "peak_to_peak_um": Quantity("peak to peak [µm]", 2, "highest less lowest deflection, of the last cycle where there are cycles"),
    "loop_width_um": Quantity("loop width [µm]", 2, "largest distance, at one drive, of the falling from the rising branch of the last cycle"),
    "loop_width_percent": Quantity("loop width [%]", 2, "loop width in % of peak to peak"),
    "slope": Quantity("slope", 4, "of the straight line through the last cycle of deflection over reference, by least squares"),
    "peak_error_percent": Quantity("peak error [% of stroke]", 2, "largest distance of the deflection from the reference in the last cycle, in % of the reference's stroke"),
    "slope_um_per_v": Quantity("slope [µm/V]", 4, "of the straight line through the last cycle of deflection over voltage, by least squares"),
    "bandwidth_rad_s": Quantity("−3 dB [rad/s]", 0, "where the magnitude has fallen 3 dB below that at the lowest frequency"),
    "lowest_rad_s": Quantity("from [rad/s]", 2, "lowest frequency of the multisine"),
    "highest_rad_s": Quantity("to [rad/s]", 0, "highest frequency of the multisine"),
    "peak_db": Quantity("peak [dB]", 2, "largest magnitude, above that at the lowest frequency"),
    "temperature_change_degc": Quantity("change of temperature [°C]", 1, "largest change from the temperature at the beginning"),
    "deflection_change_um": Quantity("largest change of deflection [µm]", 3, "from the deflection held before the disturbance; for a temperature averaged over 10 ms"),
    "rejection_um_per_degc": Quantity("change per degree [µm/°C]", 4, "largest change of deflection over the change of temperature"),
    "force_change_mn": Quantity("force [mN]", 2, "change of the force on the tip"),
    "change_per_force_um_per_mn": Quantity("change per force [µm/mN]", 3, "largest change of deflection over the change of force"),
    "recovery_ms": Quantity("recovery to 5 % [ms]", 1, "time from the disturbance until 5 % of the largest change is left, around what remains"),
    "remaining_um": Quantity("remaining change [µm]", 3, "of the deflection, at the end of the record"),
    "limited_percent": Quantity("at a limit [% of samples]", 1, "saturation: share of the samples at which the command came to the end of its range, or the voltage or its slew to their limits"),
    "samples": Quantity("samples", 0, "length of the record"),
}  # fmt: skip
"""Quantities in the order of the columns."""

AVERAGE = 0.01  # s of the moving average over a deflection that follows a temperature
CREEP_BEGIN = 1.0  # s after the step from which on slow motion counts as creep
CREEP_AVERAGE = 0.5  # s
SHORTEST_HOLD = 10  # samples for which a reference keeps a value, to be one that it went to
WARMING = 0.5  # degC: a temperature that moves by less is a thermocouple's noise


def transient(recording: Recording) -> Figures:
    """Return final deflection, ringing and damping after a step of the voltage (Fig. 3)."""
    begin = _begin(recording.voltage, "voltage")
    time, value = recording.time[begin:], recording.deflection[begin:]
    try:
        ringing = metrics.ringing(time, value)
    except ValueError:  # a finger that is damped, or sampled too slowly to show it
        ringing = metrics.Ringing(math.nan, math.nan)
    return {
        "final_um": float(np.mean(value[-max(1, value.size // 10) :])) * 1e6,
        "ringing_hz": ringing.frequency_hz,
        "damping_ratio": ringing.damping_ratio,
    }


def creep(recording: Recording) -> Figures:
    """Return the drift from 1 s after a step of the voltage to the end, also in % of the deflection."""
    begin = _begin(recording.voltage, "voltage")
    time, value = recording.time[begin:], recording.deflection[begin:]
    drift = metrics.drift(time, value, CREEP_BEGIN, CREEP_AVERAGE)
    final = float(np.mean(value[time > time[-1] - CREEP_AVERAGE]))
    return {
        "final_um": final * 1e6,
        "creep_um": drift * 1e6,
        "creep_percent": drift / (final - drift) * 100,
    }


def hysteresis(recording: Recording) -> Figures:
    """Return the figures of the last cycle of deflection over voltage (Fig. 5)."""
    loop = _loop(recording, "voltage")
    return {
        "peak_to_peak_um": loop.peak_to_peak * 1e6,
        "loop_width_um": loop.width * 1e6,
        "loop_width_percent": loop.relative_width * 100,
        "slope_um_per_v": loop.slope * 1e6,
    }


def excite(recording: Recording) -> Figures:
    """Return the deflection's range under an excitation for identification."""
    return {"peak_to_peak_um": float(np.ptp(recording.deflection)) * 1e6}


def feedforward(recording: Recording) -> Figures:
    """Return the figures of the last cycle of deflection over reference (Fig. 9).

    The peak error is the largest distance from the reference, in % of the reference's stroke.
    """
    loop = _loop(recording, "reference")
    cycle = metrics.last_cycle(recording.reference)
    reference = recording.reference[cycle]
    error = np.max(np.abs(recording.deflection[cycle] - reference)) / np.ptp(reference)
    return {
        "slope": loop.slope,
        "peak_error_percent": float(error) * 100,
        "peak_to_peak_um": loop.peak_to_peak * 1e6,
        "loop_width_um": loop.width * 1e6,
        "loop_width_percent": loop.relative_width * 100,
    }


def steps(recording: Recording) -> list[Recording]:
    """Return the parts of a recording in which the reference goes from one value that it holds to the next.

    Each begins with the last sample of the value before and ends with the last one of the value after; what
    is between is how the reference went there, a jump or a ramp. A reference that is there at sample 0 is a
    step from rest, the only one that begins with its value.
    """
    _need(recording, "reference")
    reference = recording.reference
    edges = [0, *(np.flatnonzero(np.diff(reference)) + 1).tolist(), reference.size]
    stays = [(a, b) for a, b in pairwise(edges) if b - a >= SHORTEST_HOLD or a == 0]
    parts = []
    if recording.number[0] == 0 and reference[0] != 0.0 and stays[0][1] >= SHORTEST_HOLD:
        parts.append(recording.part(slice(0, stays[0][1])))
    for (_, left), (begin, end) in pairwise(stays):
        if reference[begin] != reference[left - 1]:
            parts.append(recording.part(slice(left - 1, end)))
    return parts


def step(recording: Recording) -> Figures:
    """Return the figures of the last step of the reference (Fig. 13).

    Times count from when the reference begins to move. Settling is into 5 % and 2 % of the final value;
    overshoot and static error are in % of the step (:func:`piezo_control.metrics.step_metrics`).
    """
    found = steps(recording)
    if not found:
        raise ValueError(
            "the reference goes from no value that it holds to another: there is no step"
        )
    last = found[-1]
    reference, initial = float(last.reference[-1]), float(last.reference[0])
    begin = 1
    if initial == reference:
        begin, initial = 0, 0.0  # from rest
    figures = metrics.step_metrics(last.time[begin:], last.deflection[begin:], reference, initial)
    return {
        "reference_um": reference * 1e6,
        "settling_time_5pct_ms": figures.settling_5_final_s * 1e3,
        "settling_time_2pct_ms": figures.settling_2_final_s * 1e3,
        "rise_time_ms": figures.rise_s * 1e3,
        "overshoot_percent": figures.overshoot * 100,
        "static_error_percent": figures.static_error * 100,
    }


def frequency(recording: Recording) -> Figures:
    """Return band and peak of the response of the deflection to the reference (Fig. 14).

    The peak is relative to the lowest frequency, as the band is.
    """
    response = frequency_response(recording)
    magnitude = response.magnitude_db
    return {
        "lowest_rad_s": float(response.frequency[0]),
        "highest_rad_s": float(response.frequency[-1]),
        "bandwidth_rad_s": metrics.bandwidth(response),
        "peak_db": float(np.max(magnitude) - magnitude[0]),
    }


def frequency_response(recording: Recording) -> metrics.FrequencyResponse:
    """Return the measured response of the deflection to the reference."""
    _need(recording, "reference")
    spacing = np.median(np.diff(recording.time))
    count = round((recording.time[-1] - recording.time[0]) / spacing) + 1
    # A sample that was lost would shift all that follow: in its place is the straight line across.
    time = np.linspace(recording.time[0], recording.time[-1], count)
    signals = (
        np.interp(time, recording.time, s) for s in (recording.reference, recording.deflection)
    )
    return metrics.frequency_response(time, *signals)


def thermal(recording: Recording) -> Figures:
    """Return what a change of temperature does to a held deflection, averaged over 10 ms."""
    _need(recording, "temperature")
    figures = metrics.disturbance_metrics(
        recording.time, recording.deflection, recording.temperature, AVERAGE
    )
    return {
        "temperature_change_degc": figures.change,
        "deflection_change_um": figures.excursion * 1e6,
        "rejection_um_per_degc": figures.rejection * 1e6,
        "remaining_um": figures.remaining * 1e6,
        "reference_um": float(recording.reference[-1]) * 1e6,
    }


def force(recording: Recording) -> Figures:
    """Return what a step of the tip force does to a held deflection."""
    _need(recording, "tip_force")
    figures = metrics.disturbance_metrics(recording.time, recording.deflection, recording.tip_force)
    return {
        "force_change_mn": figures.change * 1e3,
        "deflection_change_um": figures.excursion * 1e6,
        "change_per_force_um_per_mn": figures.rejection * 1e3,
        "recovery_ms": figures.recovery_s * 1e3,
        "remaining_um": figures.remaining * 1e6,
    }


def hold(recording: Recording) -> Figures:
    """Return how well a deflection is held where nothing else happens."""
    error = recording.deflection - recording.reference
    return {
        "reference_um": float(recording.reference[-1]) * 1e6,
        "mean_error_um": float(np.mean(error)) * 1e6,
        "peak_to_peak_um": float(np.ptp(recording.deflection)) * 1e6,
    }


ANALYSES: dict[str, Callable[[Recording], Figures]] = {
    a.__name__: a
    for a in (
        transient,
        creep,
        hysteresis,
        excite,
        feedforward,
        step,
        frequency,
        thermal,
        force,
        hold,
    )  # fmt: skip
}


def analyse(recording: Recording, kind: str) -> Figures:
    """Return the figures of a recording as an experiment of `kind`, a key of ANALYSES.

    Raises BagError when the signals are not those of such an experiment.
    """
    try:
        figures = {name: _finite(value) for name, value in ANALYSES[kind](recording).items()}
        if np.all(np.isfinite(recording.limited)):
            figures["limited_percent"] = float(np.mean(recording.limited)) * 100
        return {**figures, "samples": int(recording.time.size)}
    except ValueError as error:
        raise BagError(f"cannot be analysed as '{kind}': {error}") from None


def classify(recording: Recording) -> str:
    """Return the kind of experiment that the signals suggest, and as which they can be analysed.

    In this order: a reference that goes from value to value, which a controller follows; a tip
    force that changes, a temperature that changes; a reference of many frequencies; a cyclic one
    (`hysteresis` when the voltage is proportional to it); any other one that swings (`excite`);
    one that stays what it was before (`hold`); a voltage held under a static gain (`creep` when
    that lasts for more than 10 s); any other reference: a step. Without a reference the voltage
    decides.

    Raises BagError saying why it cannot be analysed as the first of these.
    """
    refusals = []
    for kind in _suggested(recording):
        try:
            analyse(recording, kind)
            return kind
        except BagError as error:
            refusals.append(error)
    nothing = BagError("neither reference nor voltage was recorded: name the kind of experiment")
    raise next(iter(refusals), nothing)


def _suggested(recording: Recording) -> Iterator[str]:
    """Yield the kinds that :func:`classify` has to choose from, the likeliest first."""
    has_reference = bool(np.all(np.isfinite(recording.reference)))
    drive = recording.reference if has_reference else recording.voltage
    if not np.all(np.isfinite(drive)):
        return
    is_static = not has_reference or _is_proportional(recording.voltage, drive)
    if not is_static and len(steps(recording)) > 1:
        yield "step"
    if np.ptp(recording.tip_force) > 0.0:
        yield "force"
    if np.ptp(recording.temperature) >= WARMING:
        yield "thermal"
    tops, bottoms = _turns(drive), _turns(-drive)
    if tops.size + bottoms.size > 1:
        if not (_is_even(np.diff(tops)) and _is_even(np.diff(bottoms))):
            yield "frequency"
        elif not is_static:
            yield "feedforward"
        elif _is_even(drive[tops]) and _is_even(drive[bottoms]):
            yield "hysteresis"
        yield "excite"
    elif np.ptp(drive) == 0.0 and (recording.number[0] > 0 or drive[0] == 0.0):
        yield "hold"
    elif is_static:
        yield "creep" if recording.time[-1] > 10.0 else "transient"
    else:
        yield "step"


def _turns(drive: np.ndarray) -> np.ndarray:
    """Return the samples at which a signal turns down by more than a tenth of its range: noise does not."""
    from scipy.signal import find_peaks

    return find_peaks(drive, prominence=0.1 * np.ptp(drive))[0]


def _is_even(values: np.ndarray) -> bool:
    """Say whether values are equal within a fifth."""
    return values.size == 0 or bool(np.ptp(values) <= 0.2 * np.max(np.abs(values)))


def _is_proportional(value: np.ndarray, drive: np.ndarray) -> bool:
    gain = np.dot(value, drive) / max(np.dot(drive, drive), 1e-300)
    return bool(np.max(np.abs(value - gain * drive)) <= 1e-6 * np.max(np.abs(value)))


def _begin(signal: np.ndarray, name: str) -> int:
    """Return the sample from which on a signal has its last value."""
    if not np.isfinite(signal[-1]):
        raise ValueError(f"no {name} was recorded")
    changes = np.flatnonzero(signal != signal[-1])
    return int(changes[-1]) + 1 if changes.size else 0


def _need(recording: Recording, name: str) -> None:
    if not np.all(np.isfinite(getattr(recording, name))):
        raise ValueError(f"no {name} was recorded, or not from the beginning")


def _loop(recording: Recording, drive: str) -> metrics.LoopMetrics:
    _need(recording, drive)
    values = getattr(recording, drive)
    cycle = metrics.last_cycle(values)
    return metrics.loop_metrics(values[cycle], recording.deflection[cycle])


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
