# SPDX-License-Identifier: Apache-2.0
"""Identification of the hysteresis operator from a measurement by constrained least squares.

The plays' states z_i follow from the voltage alone, so the deflection is linear in the weights; the
dead zones are identified through their inverse, which is linear too (K. Kuhnen, European Journal of
Control 9 (2003) 407). With slopes s_j over the segments v_j between fixed knots of the deflection::

    sum_i w_i z_i(t) = sum_j s_j v_j(y(t + lag)) + offset + drift ln(1 + t / 1 s),
    w_i >= 0,  s_j > 0,  s = 1 in the middle

The lag of deflection behind voltage (amplifier, sensor) is identified along: plays would mimic it for
the one amplitude and frequency recorded, and fail at every other. Offset and drift of the sensor are
no part of the operator either. Half a row is added to the lag's interval, for what is read between two
rows. Neighbouring weights are held together by a smoothness penalty chosen by cross-validation over
segments of the loop; for equal gaps and weights the operator then obeys Rayleigh's law, which is what
extrapolates best to other amplitudes.

The rows before that, from rest to both ends, tell the virgin share of a classical operator: its deflection is
linear in it, too, and no loop depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar, nnls

from piezo_control.hysteresis import (
    Coefficients,
    HysteresisParameters,
    deflection_history,
    invert,
    play_history,
)
from piezo_control.identification.confidence import Values, intervals
from piezo_control.identification.measurement import Measurement, MeasurementError

SMALLEST_SLOPE = 0.05  # of the dead zones, relative to the middle
SMOOTHNESS = (0.0, *np.logspace(-4.0, 1.0, 11).tolist())
FOLDS = 5
FAR = 1e3  # strokes from the middle: beyond any deflection
LAG_ROWS = 4000  # rows used while searching the lag
LAG_PLAYS = 60  # and so many thresholds, of more every second, third, ...
LAG_SMOOTHNESS = (3e-4, 0.01, 0.3, 10.0)
LAG_GAIN = 0.02  # relative, of the deviation: a lag that gains less is not believed
REST = 0.02  # of the stroke and of the voltage's range: so near to rest a recording begins
MOST_ROWS = 200_000  # rows used in a fit; of longer measurements every second, third, ...


@dataclass(frozen=True)
class HysteresisModel:
    """Operator, and what else lies between a voltage and a recorded deflection."""

    parameters: HysteresisParameters
    offset: float  # m, what the sensor shows where the operator says 0
    lag: float  # s, by which the sensor shows a deflection late
    smoothness: float  # penalty chosen
    confidence: Values = field(default_factory=dict)  # half widths of the 95 % intervals, by name
    untold: str = "only a classical operator has one"  # why there is no virgin share

    def deflection(self, time: ArrayLike, voltage: ArrayLike) -> NDArray[np.float64]:
        """Return what the sensor shows (m) under a voltage history (V) from rest."""
        operator = deflection_history(self.parameters, voltage)
        return self.offset + np.interp(np.asarray(time) - self.lag, time, operator)


def settled(measurement: Measurement) -> int:
    """Return the first sample after the voltage has been to both ends: the plays are known then."""
    voltage = measurement.voltage
    margin = 0.01 * np.ptp(voltage)
    top = np.flatnonzero(voltage >= voltage.max() - margin)[0]
    bottom = np.flatnonzero(voltage <= voltage.min() + margin)[0]
    return int(max(top, bottom))


def equal_thresholds(measurement: Measurement, plays: int) -> tuple[float, ...]:
    """Return `plays` thresholds (V) in equal steps below half the voltage's range.

    Larger ones never come into play: a play needs twice its threshold to turn.
    """
    return tuple((0.5 * np.ptp(measurement.voltage) / plays * np.arange(plays)).tolist())


def identify_hysteresis(
    measurement: Measurement,
    thresholds: Sequence[float],
    dead_zones: int = 0,
    lag: float | None = None,
    first: int | None = None,
    last: int | None = None,
) -> HysteresisModel:
    """Identify the operator from the samples `first` to `last` of a measurement.

    Parameters
    ----------
    measurement : Measurement
    thresholds : play thresholds (V), the first 0
    dead_zones : number of dead zones on either side of the middle; 0 is the classical operator
    lag : lag of the deflection (s); None searches it up to a twentieth of the drive's period
    first, last : samples to fit; the plays always start at 0 with the measurement. By default the fit
        begins when the voltage has been to both ends.

    Raises
    ------
    MeasurementError
        If voltage or deflection is constant where it is fitted, a threshold lies beyond the voltages or too little is left
        to fit.
    ParameterError
        If the thresholds do not increase from 0.
    """
    measurement.need_varying("voltage", "deflection")
    HysteresisParameters(tuple(thresholds), (1.0,) * len(thresholds))  # refuses unusable thresholds
    half_range = 0.5 * float(np.ptp(measurement.voltage))
    if thresholds[-1] >= half_range:
        raise MeasurementError(
            f"{measurement.source}: threshold {thresholds[-1]:g} V never comes into play, must be "
            f"below half the range of the voltage, {half_range:g} V"
        )
    first = settled(measurement) if first is None else first
    last = len(measurement.time) if last is None else last
    unknowns = len(thresholds) + 2 * dead_zones + 2
    if last - first < 10 * unknowns:
        raise MeasurementError(
            f"{measurement.source}: {max(last - first, 0)} samples are left to fit {unknowns} "
            f"numbers, must be at least {10 * unknowns}; voltage at both ends from row "
            f"{measurement.rows[settled(measurement)]}"
        )
    measurement.part(slice(first, last)).need_varying("voltage", "deflection")
    searched = lag is None
    if lag is None:
        few = thresholds[:: -(-len(thresholds) // LAG_PLAYS)]
        lag = _Problem(measurement, few, dead_zones, first, last).search_lag()
    problem = _Problem(measurement, thresholds, dead_zones, first, last)
    return problem.solve(lag, searched and lag > 0.0)


class _Problem:
    """The least-squares problem in numbers of order 1: voltage by half range, deflection by stroke."""

    def __init__(
        self,
        measurement: Measurement,
        thresholds: Sequence[float],
        dead_zones: int,
        first: int,
        last: int,
    ) -> None:
        self.measurement = measurement
        self.thresholds = np.asarray(thresholds, float)
        self.rows = np.arange(first, last, -(-(last - first) // MOST_ROWS))
        self.half_range = 0.5 * float(np.ptp(measurement.voltage))
        self.stroke = float(np.ptp(measurement.deflection[first:last]))
        self.middle = 0.5 * float(
            measurement.deflection[first:last].max() + measurement.deflection[first:last].min()
        )
        self.knots = 0.5 * self.stroke * np.arange(1, dead_zones + 1) / (dead_zones + 1)
        self.plays = self._plays() / self.half_range
        elapsed = measurement.time[self.rows] - measurement.time[0]
        self.drift = np.log1p(elapsed)
        self.folds = self._folds()

    def _plays(self) -> NDArray[np.float64]:
        chunk = 50_000
        kept = []
        state = np.zeros_like(self.thresholds)
        for start in range(0, self.rows[-1] + 1, chunk):
            history = play_history(
                self.thresholds, self.measurement.voltage[start : start + chunk], state
            )
            state = history[-1]
            within = (self.rows >= start) & (self.rows < start + chunk)
            kept.append(history[self.rows[within] - start])
        return np.concatenate(kept)

    def _folds(self) -> NDArray[np.int64]:
        """Deal segments of the loop, ten on each branch, to the folds of the cross-validation."""
        voltage = self.measurement.voltage
        share = (voltage[self.rows] - voltage.min()) / (2.0 * self.half_range)
        segment = np.minimum((10 * share).astype(int), 9)
        falling = np.gradient(voltage)[self.rows] < 0.0
        return (segment + 2 * falling) % FOLDS

    def equations(self, lag: float, chosen: slice = slice(None)) -> NDArray[np.float64]:
        """Return the rows [plays, 1, drift, -outer segments | middle segment]."""
        time = self.measurement.time
        rows = self.rows[chosen]
        seen = np.interp(time[rows] + lag, time, self.measurement.deflection) - self.middle
        seen /= self.stroke
        knots = self.knots / self.stroke
        if not len(knots):
            segments = np.empty((len(rows), 0))
            middle = seen
        else:
            middle = np.clip(seen, -knots[0], knots[0])
            widths = np.append(np.diff(knots), np.inf)
            above = np.clip(seen[:, None] - knots, 0.0, widths)
            below = np.clip(seen[:, None] + knots, -widths, 0.0)
            segments = np.concatenate((above, below), axis=1)
        return np.column_stack(
            (self.plays[chosen], np.ones(len(rows)), self.drift[chosen], -segments, middle)
        )

    def penalty(self, smoothness: float) -> NDArray[np.float64]:
        """Return rows that hold neighbouring weights, and neighbouring slopes, together."""
        plays, zones = len(self.thresholds), len(self.knots)
        columns = plays + 2 + 2 * zones + 1
        rows = []
        gaps = np.diff(self.thresholds) * (plays / self.half_range)
        for i in range(1, plays - 1):
            row = np.zeros(columns)
            row[i : i + 2] = -smoothness / gaps[i - 1], smoothness / gaps[i]
            rows.append(row)
        # Segments from the lowest to the highest; the middle one's slope, 1, is the last column.
        above, below = np.arange(zones) + plays + 2, np.arange(zones) + plays + 2 + zones
        order = [*below[::-1], columns - 1, *above]
        bend = smoothness / (2.0 * (zones + 1))
        for left, here, right in zip(order, order[1:], order[2:]):
            row = np.zeros(columns)
            row[[left, here, right]] = bend, -2.0 * bend, bend
            row[-1] *= -1.0
            rows.append(row)
        return np.array(rows).reshape(-1, columns)

    def least_squares(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the bounded solution of ``rows[:, :-1] x = rows[:, -1]``."""
        lowest = self.lowest()
        free, bounded = np.flatnonzero(np.isinf(lowest)), np.flatnonzero(np.isfinite(lowest))
        shifted = rows[:, -1] - rows[:, bounded] @ lowest[bounded]
        # Free unknowns first: below their rows the triangular factor has the bounded ones alone.
        triangle = np.linalg.qr(
            np.column_stack((rows[:, free], rows[:, bounded], shifted)), mode="r"
        )
        n = len(free)
        above = nnls(triangle[n:, n:-1], triangle[n:, -1])[0]
        x = lowest.copy()
        x[bounded] += above
        left = triangle[:n, -1] - triangle[:n, n:-1] @ above
        x[free] = np.linalg.lstsq(triangle[:n, :n], left, rcond=None)[0]
        return x

    def lowest(self) -> NDArray[np.float64]:
        """Return the lower bounds of weights, offset, drift and slopes."""
        plays, zones = len(self.thresholds), len(self.knots)
        return np.concatenate(
            ([1e-6], np.zeros(plays - 1), [-np.inf] * 2, np.full(2 * zones, SMALLEST_SLOPE))
        )

    def search_lag(self) -> float:
        """Return the lag (s) with the least deviation in cross-validation, 0 if its whole rows gain too little."""
        few = slice(None, None, -(-len(self.rows) // LAG_ROWS))

        def deviation(lag: float, chosen: slice = few) -> float:
            return min(self.cross_validation(self.parts(lag, chosen), LAG_SMOOTHNESS)) ** 0.5

        longest = 0.05 * self.period()
        best = minimize_scalar(deviation, bounds=(0.0, longest), method="bounded").x
        # Readings between two rows are means, with less noise, and few rows miss a spike: neither is a lag.
        step = self.measurement.sample_time
        before, after = (deviation(lag, slice(None)) for lag in (0.0, step * round(best / step)))
        return float(best) if after < (1.0 - LAG_GAIN) * before else 0.0

    def period(self) -> float:
        """Return the time (s) between passages of the voltage through its middle, twice the median."""
        voltage = self.measurement.voltage
        above = voltage > 0.5 * (voltage.max() + voltage.min())
        crossings = self.measurement.time[np.flatnonzero(np.diff(above))]
        if len(crossings) < 3:
            return 0.0
        return 2.0 * float(np.median(np.diff(crossings)))

    def parts(self, lag: float, chosen: slice = slice(None)) -> list[NDArray[np.float64]]:
        """Return the equations of each fold as their triangular factor: equal squares, fewer rows."""
        equations, folds = self.equations(lag, chosen), self.folds[chosen]
        equations /= np.sqrt(len(equations))
        return [np.linalg.qr(equations[folds == k], mode="r") for k in range(FOLDS)]

    def cross_validation(
        self, parts: list[NDArray[np.float64]], smoothness: Sequence[float]
    ) -> list[float]:
        """Return, for each smoothness, the squared deviation of every fold fitted on the others."""
        errors = np.zeros(len(smoothness))
        for k, held_back in enumerate(parts):
            others = np.linalg.qr(np.concatenate((*parts[:k], *parts[k + 1 :])), mode="r")
            for i, value in enumerate(smoothness):
                x = self.least_squares(np.concatenate((others, self.penalty(value))))
                errors[i] += np.sum((held_back @ np.append(x, -1.0)) ** 2)
        return errors.tolist()

    def solve(self, lag: float, searched: bool) -> HysteresisModel:
        """Choose the smoothness by cross-validation, solve, and return to SI units."""
        parts = self.parts(lag)
        smoothness = SMOOTHNESS[np.argmin(self.cross_validation(parts, SMOOTHNESS))]
        penalty = self.penalty(smoothness)
        x = self.least_squares(np.concatenate((*parts, penalty)))
        parameters, offset = self._operator(x)
        model = HysteresisModel(
            parameters, offset, lag, smoothness, self._confidence(x, lag, searched, penalty)
        )
        measurement = self.measurement
        deviation = measurement.deflection - model.deflection(measurement.time, measurement.voltage)
        model = replace(model, offset=offset + float(np.mean(deviation[self.rows])))
        drift = self.stroke * x[len(self.thresholds) + 1]
        at_start = model.offset - drift * float(np.mean(self.drift))
        return model if len(self.knots) else self._first_rise(model, at_start, drift)

    def _first_rise(self, model: HysteresisModel, at_start: float, drift: float) -> HysteresisModel:
        """Add the virgin share, as told by the rows until the voltage has been to both ends."""
        measurement = self.measurement
        rows = slice(0, settled(measurement))
        time, voltage = measurement.time[rows], measurement.voltage[rows]
        straight, bent = (
            deflection_history(replace(model.parameters, virgin_share=share), voltage)
            for share in (0.0, 1.0)
        )
        bend = (bent - straight) / self.stroke
        shown = np.interp(time + model.lag, measurement.time, measurement.deflection) - straight
        shown -= at_start + drift * np.log1p(time - measurement.time[0])
        start = int(np.argmin(np.abs(voltage) <= 2.0 * REST * self.half_range))
        if not start:
            return replace(model, untold="the recording does not begin at 0 V")
        beside = float(np.mean(shown[:start]))
        if abs(beside) > REST * self.stroke:
            place = f"{beside * 1e6:.3g} µm beside the rest of its later loops"
            return replace(model, untold=f"the recording begins {place}")
        shown /= self.stroke
        square = float(bend @ bend) or 1.0  # one play alone has no bend
        share = min(1.0, max(0.0, float(bend @ shown) / square))
        width = intervals(
            lambda number: {"hysteresis.virgin_share": float(number[0])},
            np.array([share]),
            bend[:, None],
            shown - share * bend,
        )
        if not np.all(share > np.array(width["hysteresis.virgin_share"])):
            return replace(model, untold="it is not told from 0")
        return replace(
            model,
            parameters=replace(model.parameters, virgin_share=share),
            confidence={**model.confidence, **width},
        )

    def _confidence(
        self, x: NDArray[np.float64], lag: float, searched: bool, penalty: NDArray[np.float64]
    ) -> Values:
        """Return the intervals of what the solution `x` means; of the lag, too, if it was searched."""
        full = np.append(x, -1.0)
        equations = self.equations(lag)
        free = x > self.lowest()
        step = float(np.median(np.diff(self.measurement.time)))
        by_lag = (self.equations(lag + step) - self.equations(lag - step)) @ full / (2.0 * step)
        jacobian = np.column_stack((equations[:, :-1] * free, by_lag * searched))
        rows = np.sqrt(len(equations)) * penalty[:, :-1] * free
        ends = self.measurement.voltage.min(), self.measurement.voltage.max()

        def values(numbers: NDArray[np.float64]) -> Values:
            parameters, offset = self._operator(numbers[:-1])
            loop = deflection_history(parameters, [ends[0], ends[1], ends[0]])
            found: dict[str, float | tuple[float, ...]] = {
                "static_gain": float(np.ptp(loop[1:])) / (ends[1] - ends[0]),
                "hysteresis.weights": parameters.weights,
            }
            for side in ("upper", "lower"):
                for part in ("thresholds", "weights"):
                    name = f"{side}_{part}"
                    found[f"hysteresis.{name}"] = getattr(parameters, name)
            return {**found, "offset": offset, **({"lag": float(numbers[-1])} if searched else {})}

        widths = intervals(
            values,
            np.append(x, lag),
            jacobian,
            equations @ full,
            np.column_stack((rows, 0.0 * rows[:, :1])),
        )
        if not searched:
            return widths
        # That means have less noise draws the lag to the middle between two rows, by half a row at most.
        return {**widths, "lag": np.add(widths["lag"], 0.5 * step).item()}

    def _operator(self, x: NDArray[np.float64]) -> tuple[HysteresisParameters, float]:
        """Return to SI units, and move the dead zones' origin to where the plays sum to 0; the offset, too."""
        plays, zones = len(self.thresholds), len(self.knots)
        total = self.stroke * (x[plays] + x[plays + 1] * float(np.mean(self.drift)))
        # Inverse dead zones as a polygon through 0 in the middle, equal to `total` at the origin.
        knots = np.concatenate((-self.knots[::-1], self.knots))
        slopes = np.concatenate(
            (x[: plays + 1 + zones : -1], [1.0], x[plays + 2 : plays + 2 + zones])
        )
        edges = np.concatenate(([-FAR * self.stroke], knots, [FAR * self.stroke]))
        heights = np.concatenate(([0.0], np.cumsum(slopes * np.diff(edges))))
        heights -= np.interp(0.0, edges, heights)
        origin = float(np.interp(total, heights, edges))
        central = slopes[np.searchsorted(knots, origin)]
        weights = x[:plays] * self.stroke / self.half_range / central
        changes = np.diff(slopes) / central
        upper, lower = knots > origin, knots < origin
        dead_zones = invert(
            Coefficients(
                [0.0],
                [1.0],
                0.0,
                (knots[upper] - origin).tolist(),
                changes[upper].tolist(),
                (origin - knots[lower])[::-1].tolist(),
                (-changes[lower])[::-1].tolist(),
                [0.0],
            )
        )
        upper_thresholds, upper_weights, lower_thresholds, lower_weights = map(
            tuple, dead_zones[3:7]
        )
        parameters = HysteresisParameters(
            tuple(self.thresholds.tolist()),
            tuple(weights.tolist()),
            upper_thresholds,
            upper_weights,
            lower_thresholds,
            lower_weights,
        )
        return parameters, self.middle + origin
