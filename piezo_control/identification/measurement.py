# SPDX-License-Identifier: Apache-2.0
"""Measurements to identify from, out of a rosbag2 folder or a text file, checked before use.

Sample k pairs a deflection with the voltage that was held during the sample time *before* the instant
the sensor saw it; temperature and tip force likewise. A text file is expected to be paired so. In a
bag the cantilever publishes deflection k, taken `sensor_delay` samples earlier, and only then receives
voltage k, so deflection k belongs to voltage k - 1 - sensor_delay, and to 0 V before the first one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piezo_control.identification.columns import QUANTITIES
from piezo_control.identification.table import LARGEST_MISSING_SHARE, TableError, read_columns
from piezo_control.recording import recording

SHORTEST = 50  # samples
LARGEST_JITTER = 0.02  # of the sample time, standard deviation
SMALLEST_GAP = 1.75  # of the median step; a clock of few digits steps by 5/3 of it at most


class MeasurementError(ValueError):
    """A measurement that cannot be used; the message names file, column and row."""


@dataclass(frozen=True)
class Measurement:
    """Signals of one finger over time, equally long 1-D arrays; None where not recorded.

    `rows` holds what names a sample in messages: line numbers of a file, sample numbers of a bag.
    """

    source: str
    time: NDArray[np.float64]  # s
    voltage: NDArray[np.float64]  # V
    deflection: NDArray[np.float64]  # m
    temperature: NDArray[np.float64] | None  # degC
    tip_force: NDArray[np.float64] | None  # N
    rows: NDArray[np.int64]
    description: str = ""  # what was read, for people

    def __post_init__(self) -> None:
        if len(self.time) < SHORTEST:
            raise MeasurementError(
                f"{self.source}: {len(self.time)} samples, must be at least {SHORTEST}"
            )
        for name in QUANTITIES:
            column = getattr(self, name)
            bad = [] if column is None else np.flatnonzero(~np.isfinite(column))
            if len(bad):
                raise self.error(name, bad[0], "must be a finite number")
        steps = np.diff(self.time)
        late = np.flatnonzero(steps <= 0.0)
        if len(late):
            text = f"not after {self.time[late[0]]:g} before it"
            if steps.min() < 0.0:
                text += ": the time goes back; give one recording at a time, in its order"
            else:
                text += (
                    f": {len(late):,} rows repeat a time; where the clock is coarse, --sample-rate "
                    f"{1.0 / np.mean(steps):.5g} takes its place"
                )
            raise self.error("time", late[0] + 1, text)

    def error(self, column: str, sample: int, text: str) -> MeasurementError:
        """Return the error about one entry, to be raised."""
        value = getattr(self, column)[sample]
        return MeasurementError(
            f"{self.source}: column '{column}', row {self.rows[sample]} is {value:g}: {text}"
        )

    def need_varying(self, *columns: str) -> None:
        """Raise MeasurementError for the first of the `columns` that is missing or constant."""
        for name in columns:
            values = getattr(self, name)
            if values is None:
                raise MeasurementError(f"{self.source}: no column '{name}', which is needed")
            if np.ptp(values) == 0.0:
                raise MeasurementError(
                    f"{self.source}: column '{name}' is {values[0]:g} in all rows "
                    f"{self.rows[0]} to {self.rows[-1]}: nothing to identify from"
                )

    @property
    def sample_time(self) -> float:
        """Time from sample to sample (s): the mean, without gaps; the median is a multiple of the clock's digit."""
        return _step(self.time)

    def _is_even(self) -> bool:
        """Say whether all samples are within a digit of the clock where even sampling, with gaps, has them."""
        steps, noise = np.diff(self.time), 8.0 * np.spacing(np.abs(self.time).max())
        apart = np.diff(np.sort(steps))
        digit = apart[apart > noise].min(initial=self.sample_time)
        if np.any(np.abs(steps - digit * np.round(steps / digit)) > 0.01 * digit):
            return False
        off = self.time - self.time[0] - self.sample_time * places(self.time)
        return bool(np.abs(off).max() <= digit + noise)

    def need_even_sampling(self) -> None:
        """Raise MeasurementError at the first gap: a step that differs from the sample time by 1 %.

        Where only the clock's digits make the steps differ, they may.
        """
        steps = np.diff(self.time)
        allowed = 0.5 if self._is_even() else 0.01
        uneven = np.flatnonzero(np.abs(steps - self.sample_time) > allowed * self.sample_time)
        if len(uneven):
            i = uneven[0]
            raise self.error(
                "time",
                i + 1,
                f"{steps[i]:g} s after the row before, must be {self.sample_time:g}; where the instrument samples "
                f"evenly, --sample-rate {1.0 / self.sample_time:.5g} takes the place of its clock",
            )

    def clock(self) -> list[str]:
        """Say what is odd about the time: gaps, and steps that vary.

        Raises MeasurementError at the first gap when more is missing than may be.
        """
        steps = np.diff(self.time)
        gaps = np.flatnonzero(_are_gaps(steps))
        missing = int(np.sum(np.round(steps[gaps] / self.sample_time) - 1))
        said = []
        if missing:
            lost = f"{missing:,} rows are missing in {gaps.size} gaps"
            if missing > LARGEST_MISSING_SHARE * (steps.size + missing):
                text = f"{steps[gaps[0]]:.4g} s after the row before, rows come every {self.sample_time:.4g} s: {lost}"
                text += "; use a part without them"
                if np.ptp(steps) < 1.01 * self.sample_time:
                    text += f", or where the clock is coarse, --sample-rate {1.0 / np.mean(steps):.5g} in its place"
                raise self.error("time", int(gaps[0]) + 1, text)
            said.append(f"{lost}, the first before row {self.rows[gaps[0] + 1]}")
        even = np.delete(steps, gaps) / self.sample_time
        if np.std(even) > LARGEST_JITTER and not self._is_even():
            worst = int(
                np.argmax(np.abs(np.where(_are_gaps(steps), 0.0, steps - self.sample_time)))
            )
            said.append(
                f"the time between rows varies by {100.0 * np.std(even):.2g} %, most before row {self.rows[worst + 1]}; "
                f"where the instrument samples evenly, give --sample-rate {1.0 / np.mean(even * self.sample_time):.5g}"
            )
        return said

    def bridged(self) -> Measurement:
        """Return the measurement with straight lines across what few rows are missing; as it is, if none are."""
        place = places(self.time)
        if place[-1] + 1 == len(place) or np.any(np.diff(place) < 1.0):
            return self
        whole = np.arange(place[-1] + 1)

        def filled(values: NDArray | None) -> NDArray | None:
            return None if values is None else np.interp(whole, place, values)

        columns: dict[str, Any] = {name: filled(getattr(self, name)) for name in QUANTITIES}
        if self._is_even():
            columns["time"] = self.time[0] + self.sample_time * whole
        rows = self.rows[np.searchsorted(place, whole)]
        return replace(self, **columns, rows=rows)

    def part(self, samples: slice) -> Measurement:
        """Return the measurement of these samples only."""
        cut: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[samples]
            for name in (*QUANTITIES, "rows")
        }
        return replace(self, **cut)


def _are_gaps(steps: NDArray[np.float64]) -> NDArray[np.bool_]:
    return steps > SMALLEST_GAP * np.median(steps)


def _step(time: NDArray[np.float64]) -> float:
    steps = np.diff(time)
    return float(np.mean(steps[~_are_gaps(steps)]))


def places(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return which sample of even sampling each `time` (s) is, from 0; what is missing is passed over.

    Each step is rounded by itself: over a long recording, the sample time is not known well enough.
    """
    return np.concatenate(([0.0], np.cumsum(np.round(np.diff(time) / _step(time)))))


def read_measurement(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    sample_time: float | None = None,
    finger: str = "",
    run: int | None = None,
    sensor_delay: int = 1,
) -> Measurement:
    """Read a bag (`finger`, `run`, `sensor_delay`) or a table (`columns`, `sample_time`).

    Raises MeasurementError, naming file, column and row, when it cannot be used.
    """
    if is_bag(path):
        return read_bag(path, finger, run, sensor_delay)
    return read_text(path, columns or {}, sample_time)


def is_bag(path: str | Path) -> bool:
    """Tell a rosbag2 folder or storage file from a text file."""
    return Path(path).is_dir() or Path(path).suffix in (".mcap", ".db3")


def read_text(
    path: str | Path, columns: Mapping[str, str], sample_time: float | None = None
) -> Measurement:
    """Read a table of numbers (:mod:`piezo_control.identification.table`).

    Parameters
    ----------
    path : path of the file
    columns : mapping
        Where to find a quantity: ``{"deflection": "4:um"}`` is column 4, counted from 0, in
        micrometres; ``"probe:um"`` the column of that name, or the only one with 'probe' in its name. A
        quantity not mentioned is looked for under its own name. A unit in the file need not be given.
    sample_time : float, optional
        Time between rows (s); it takes the place of a column with the time.

    Rows in which a cell that is needed is empty are left out, if they are few.
    """
    try:
        found = read_columns(path, QUANTITIES, columns, ("voltage", "deflection"), sample_time)
    except TableError as error:
        raise MeasurementError(str(error)) from None
    measurement = Measurement(
        source=str(path),
        rows=found.rows,
        description=found.description,
        **{quantity: found.values.get(quantity) for quantity in QUANTITIES},
    )
    odd = measurement.clock()
    return replace(measurement, description="; ".join([found.description, *odd]))


def read_bag(
    path: str | Path, finger: str = "", run: int | None = None, sensor_delay: int = 1
) -> Measurement:
    """Read one run of one finger from a rosbag2 folder.

    Parameters
    ----------
    path : path of the folder, or of its storage file
    finger : namespace of the finger, needed when the bag has several
    run : which run, from 0, of a bag in which the sample numbers start again
    sensor_delay : age of a deflection (samples) when the cantilever publishes it

    Samples that were lost, or whose voltage was, are left out, if they are few.
    """
    try:
        recorded, left_out = recording.read(path, finger, run).complete()
    except recording.BagError as error:
        raise MeasurementError(str(error)) from None
    number = recorded.number
    wanted = number - 1 - sensor_delay
    index = np.searchsorted(number, np.maximum(wanted, 0)).clip(max=number.size - 1)
    paired = (number[index] == wanted) | (wanted < 0)
    if number[0] > 0:
        paired &= wanted >= 0
    total = number[-1] - number[0] + 1 - (0 if number[0] == 0 else 1 + sensor_delay)
    if paired.sum() < (1.0 - LARGEST_MISSING_SHARE) * total:
        raise MeasurementError(
            f"{path}: {total - paired.sum():,} of {total:,} samples have no deflection or no voltage before them "
            f"({left_out}), at most {LARGEST_MISSING_SHARE:.0%} may; record with the recorder node, or with "
            "`ros2 bag record --qos-profile-overrides-path params/rosbag2_qos.yaml`"
        )

    def earlier(values: NDArray, at_start: float) -> NDArray | None:
        if np.isnan(values).all():
            return None
        return np.where(wanted < 0, at_start, values[index])[paired]

    return Measurement(
        str(path),
        ((number - number[0]) * recorded.sample_time)[paired],
        earlier(recorded.voltage, 0.0),
        recorded.deflection[paired],
        earlier(recorded.temperature, recorded.temperature[0]),
        earlier(recorded.tip_force, recorded.tip_force[0]),
        number[paired],
        f"read {paired.sum():,} samples of a bag, one every {recorded.sample_time:g} s"
        + (f"; {left_out}" if left_out else ""),
    )
