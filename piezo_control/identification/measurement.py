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

from piezo_control.identification.table import (
    LARGEST_MISSING_SHARE,
    UNITS,
    TableError,
    read_table,
)
from piezo_control.recording import recording
from piezo_control.safety import LARGEST_DEFLECTION

SHORTEST = 50  # samples
QUANTITIES = {  # the units a column may have, the first of them where nothing says which
    "time": ("s", "ms", "us", "min"),
    "voltage": ("V", "mV", "kV"),
    "deflection": ("m", "mm", "um", "nm"),
    "temperature": ("degc",),
    "tip_force": ("N", "mN", "uN"),
}


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
        late = np.flatnonzero(np.diff(self.time) <= 0.0)
        if len(late):
            raise self.error("time", late[0] + 1, f"not after {self.time[late[0]]:g} before it")

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
        """Time from sample to sample (s), the median."""
        return float(np.median(np.diff(self.time)))

    def need_even_sampling(self) -> None:
        """Raise MeasurementError at the first gap: a step that differs from the sample time by 1 %."""
        steps = np.diff(self.time)
        uneven = np.flatnonzero(np.abs(steps - self.sample_time) > 0.01 * self.sample_time)
        if len(uneven):
            i = uneven[0]
            raise self.error(
                "time", i + 1, f"{steps[i]:g} s after the row before, must be {self.sample_time:g}"
            )

    def part(self, samples: slice) -> Measurement:
        """Return the measurement of these samples only."""
        cut: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[samples]
            for name in (*QUANTITIES, "rows")
        }
        return replace(self, **cut)


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
        Time between rows (s) of a file without time column.

    Rows in which a cell that is needed is empty are left out, if they are few.
    """
    try:
        table = read_table(path)
        found = {q: table.find(q, columns.get(q), units) for q, units in QUANTITIES.items()}
        for quantity in ("voltage", "deflection"):
            if found[quantity] is None:
                raise MeasurementError(
                    f"{path}: no column for '{quantity}'; the file has {', '.join(table.headers)}"
                )
        if found["time"] is None and sample_time is None:
            raise MeasurementError(f"{path}: no column for 'time' and no sample time given")
        places = {quantity: place for quantity, place in found.items() if place}
        values = {q: table.numbers(index) * UNITS[unit] for q, (index, unit) in places.items()}
    except TableError as error:
        raise MeasurementError(str(error)) from None
    if "time" not in values:
        values["time"] = sample_time * np.arange(len(table.rows))
    empty = np.any([np.isnan(column) for column in values.values()], axis=0)
    if empty.mean() > LARGEST_MISSING_SHARE:
        raise MeasurementError(
            f"{path}: {empty.sum()} of {empty.size} rows have an empty cell in a column that is needed, the "
            f"first is row {table.rows[empty][0]}; at most {LARGEST_MISSING_SHARE:.0%} may"
        )
    stroke = np.ptp(values["deflection"][~empty])
    if LARGEST_DEFLECTION < stroke < np.inf:
        raise MeasurementError(
            f"{path}: the deflection spans {stroke:g} m, must be at most {LARGEST_DEFLECTION:g} m: say its "
            "unit, as in --deflection COLUMN:um"
        )
    read = ", ".join(f"{q} = column '{table.headers[i]}' [{u}]" for q, (i, u) in places.items())
    left_out = f"; {empty.sum()} rows with empty cells left out" if empty.any() else ""
    columns_found = {q: values[q][~empty] if q in values else None for q in QUANTITIES}
    return Measurement(
        source=str(path),
        rows=table.rows[~empty],
        description=f"read {(~empty).sum():,} rows {table.form}: {read}{left_out}",
        **columns_found,
    )


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
    """
    try:
        recorded = recording.read(path, finger, run)
    except recording.BagError as error:
        raise MeasurementError(str(error)) from None
    before = 1 + sensor_delay

    def earlier(values: NDArray, at_start: float) -> NDArray:
        return np.concatenate((np.full(before, at_start), values))[: len(values)]

    def since_sent(values: NDArray, until_then: float | None = None) -> NDArray | None:
        sent = np.flatnonzero(~np.isnan(values))
        if not len(sent):
            return None
        start = values[sent[0]] if until_then is None else until_then
        return earlier(np.concatenate((np.full(sent[0], start), values[sent[0] :])), start)

    measurement = Measurement(
        str(path),
        (recorded.number - recorded.number[0]) * recorded.sample_time,
        earlier(recorded.voltage, 0.0),
        recorded.deflection,
        since_sent(recorded.temperature),
        since_sent(recorded.tip_force, until_then=0.0),
        recorded.number,
        f"read {recorded.number.size:,} samples of a bag, one every {recorded.sample_time:g} s",
    )
    measurement.need_even_sampling()
    return measurement
