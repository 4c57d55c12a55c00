# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers as instruments and spreadsheets write them: what is a name, a unit, a number is found.

Text (:mod:`piezo_control.identification.rows`), spreadsheets (.xlsx, the first sheet), and what
:mod:`piezo_control.identification.arrays` reads.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from piezo_control.identification.arrays import READERS, absent, read_vectors
from piezo_control.identification.rows import (
    MISSING,
    OVERLOAD,
    Row,
    layout,
    numbered,
    read_rows,
    with_points,
)
from piezo_control.identification.units import UNITS, said_unit, si, split_name, unit_of
from piezo_control.safety import HIGHEST_DEGC, LARGEST_DEFLECTION, LOWEST_DEGC

LARGEST_MISSING_SHARE = 0.01  # of the rows
OVERFLOW = (
    9e36,
    1e38,
)  # 9.9e37 is IEEE 488.2's for a value beyond the range, 1e37 older instruments'
DOUBTFUL = {
    "temperature": (150.0, 500.0, "kelvin", "K"),
    "time": (1e11, 1e19, "ms, us or ns since 1970", "ms"),
}
"""Between which a column that has no unit may be in another: no piezo is as warm, and 1e11 s are 3000 years."""
GUESSED = "m", "mm", "um", "nm"  # picometres are always said
GAINS = 0.02e-6, 50e-6  # m/V, of a small stack without a lever, and of a bender


class TableError(ValueError):
    """A table that cannot be read; the message names file, column and row."""


@dataclass
class Table:
    """Columns of cells, still as the file has them; `rows` are the numbers of their lines."""

    path: Path
    headers: list[str]  # '0', '1', … for a file without a line of names
    units: list[str]  # '' where the file says none, its word where that is none of UNITS
    cells: pd.DataFrame
    rows: NDArray[np.int64]
    decimal: str = "."
    form: str = ""
    others: list[str] = field(default_factory=list)  # names of what is not as long

    @property
    def contents(self) -> str:
        """What can be chosen from, for people."""
        others = f"; not as long: {', '.join(self.others)}" if self.others else ""
        return ", ".join(self.headers) + others

    def has(self, wanted: Mapping[str, str | None]) -> bool:
        """Tell whether there are columns of all `wanted` quantities."""
        return all(
            self._index(self._parts(column, quantity)[0], quantity, exact=column is None)
            is not None
            for quantity, column in wanted.items()
        )

    def find(
        self, quantity: str, wanted: str | None, units: tuple[str, ...]
    ) -> tuple[int, str, NDArray[np.float64]] | None:
        """Return index, unit and values (SI) of the column of a `quantity`, None when there is none.

        `wanted` is NAME, NUMBER or a part of the name that only one column has, with ':UNIT' behind it where
        the file does not say; without it the quantity is looked for under its own name. The first of
        `units` holds where nothing says another one. Raises TableError for what is not there or not understood.
        """
        name, unit = self._parts(wanted, quantity)
        if unit and unit_of(unit) not in units:
            raise TableError(
                f"column '{wanted}' for '{quantity}': unit '{unit}' must be one of {', '.join(units)}"
            )
        index = self._index(name, quantity, exact=wanted is None)
        if index is None:
            if wanted is None:
                return None
            raise TableError(
                f"{self.path}: no column '{name}' for '{quantity}'; the file has {self.contents}"
            )
        unit = unit_of(unit) or self.units[index]
        if quantity == "time" and (clock := self._clock(index, unit)):
            return index, *clock
        low, high, other, spelled = DOUBTFUL.get(quantity, (np.inf, np.inf, "", ""))
        if not unit and low < self._median(index) < high:
            raise TableError(
                f"{self.path}: column '{self.headers[index]}' has numbers around {self._median(index):.4g} and no unit, "
                f"which may be {other}: say it in the heading, as in '{quantity} [{spelled}]', or as in "
                f"--{quantity} {index}:{spelled}"
            )
        if (unit := unit or units[0]) not in units:
            option = f"--{quantity.replace('_', '-')} {index}:{units[0]}"
            raise TableError(
                f"{self.path}: column '{self.headers[index]}' is in {unit}, '{quantity}' must be in one of "
                f"{', '.join(units)}; where '{unit}' is wrong or no unit, say the unit, as in {option}"
            )
        return index, unit, si(self.numbers(index), unit)

    def _parts(self, wanted: str | None, quantity: str) -> tuple[str, str]:
        """Return the name and the unit in NAME or NAME:UNIT; some names have a colon."""
        name, colon, unit = (wanted or "").rpartition(":")
        if not colon or wanted in self.headers:
            name, unit = wanted or "", ""
        return name or quantity, unit

    def _index(self, name: str, quantity: str, exact: bool) -> int | None:
        def plain(text: str) -> str:
            return re.sub(r"[\s_]+", " ", text).strip().lower()

        bases = [split_name(header)[0] for header in self.headers]
        alike = [plain(base) for base in bases]
        ends = [base.rpartition(".")[2].strip() for base in alike]  # of a name within a group
        for names, sought in (
            (self.headers, name), (bases, name), (alike, plain(name)), (ends, plain(name)),
        ):  # fmt: skip
            if found := [i for i, entry in enumerate(names) if entry == sought]:
                return self._only(found, name, quantity)
        if exact:
            return None
        if name.isdigit() and int(name) < len(self.headers):
            return int(name)
        part = re.escape(plain(name))
        for pattern in (rf"\b{part}\b", part):  # whole words first
            if found := [i for i, h in enumerate(self.headers) if re.search(pattern, plain(h))]:
                return self._only(found, name, quantity)
        return None

    def _only(self, found: list[int], name: str, quantity: str) -> int:
        if len(found) > 1:
            raise TableError(
                f"{self.path}: '{name}' for '{quantity}' may be any of "
                f"{', '.join(self.headers[i] for i in found)}, columns {', '.join(map(str, found))}"
            )
        return found[0]

    def numbers(self, index: int) -> NDArray[np.float64]:
        """Return a column as numbers, NaN where a cell is empty or says that there is none.

        Raises TableError for the first cell that is no number.
        """
        values = self._numbers(index)
        return np.where(_is_overflow(values), np.nan, values)

    def overloaded(self, index: int, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell in which of the `rows` an instrument says that a value was beyond its range."""
        cells = self.cells.iloc[rows, index]
        if cells.dtype != object:
            return _is_overflow(cells.to_numpy(float))
        numbers = pd.to_numeric(with_points(cells, self.decimal), errors="coerce").to_numpy(float)
        return cells.str.fullmatch(OVERLOAD).to_numpy(bool) | _is_overflow(numbers)

    def _numbers(self, index: int) -> NDArray[np.float64]:
        column = self.cells.iloc[:, index]
        if column.dtype != object:
            return column.to_numpy(dtype=float)
        values = pd.to_numeric(column, errors="coerce").to_numpy(float)
        unread = np.isnan(values) & (column != "").to_numpy()
        if unread.any():
            plain = with_points(column, self.decimal)
            values = pd.to_numeric(plain, errors="coerce").to_numpy(float)
            unread = np.isnan(values) & ~column.str.fullmatch(MISSING).to_numpy(bool)
        if unread.any():
            row = int(np.flatnonzero(unread)[0])
            raise TableError(
                f"{self.path}: column '{self.headers[index]}', row {self.rows[row]} is "
                f"'{column.iloc[row]}', must be a finite number"
            )
        return values

    def _median(self, index: int) -> float:
        """Return the median of the numbers of a column; NaN where there are none."""
        values = self.numbers(index)
        return (
            float(np.median(values[np.isfinite(values)])) if np.isfinite(values).any() else np.nan
        )

    def span(self, index: int) -> float:
        """Return how far the numbers of a column are apart; 0 where there are none."""
        values = self.numbers(index)
        return float(np.ptp(values[np.isfinite(values)])) if np.isfinite(values).any() else 0.0

    def _clock(self, index: int, unit: str) -> tuple[str, NDArray[np.float64]] | None:
        """Return how a column writes instants, and these in seconds since the first; None for numbers.

        Raises TableError for times that may be minutes and seconds or hours and minutes, unless `unit` says which.
        """
        column = self.cells.iloc[:, index]
        if column.dtype != object:
            return None
        written = column[~column.str.fullmatch(MISSING)]
        begin = with_points(written.iloc[:1], self.decimal)
        if written.empty or pd.to_numeric(begin, errors="coerce").notna().any():
            return None
        text = with_points(written, self.decimal)
        parts = text.str.extract(r"^(?:(\d+):)?(\d+):(\d+(?:\.\d*)?)$").astype(float)
        first, second = parts[1], parts[2]
        if second.isna().any():
            dates = pd.to_datetime(text, errors="coerce", format="mixed")
            if dates.isna().any():
                return None
            form, seconds = "date", (dates - dates.iloc[0]).dt.total_seconds()
        elif parts[0].notna().any():
            form, seconds = "h:min:s", 3600.0 * parts[0].fillna(0.0) + 60.0 * first + second
        elif unit == "min" or first.max() >= 24.0 or text.str.contains(".", regex=False).any():
            form, seconds = "min:s", 60.0 * first + second
        elif unit == "h":
            form, seconds = "h:min", 3600.0 * first + 60.0 * second
        else:
            raise TableError(
                f"{self.path}: column '{self.headers[index]}' has times as '{text.iloc[-1]}', which are minutes and "
                "seconds or hours and minutes: say the unit before the colon, as in "
                f"--time {index}:min or --time {index}:h, or in the heading, as in [mm:ss] or [hh:mm]"
            )
        return form, (seconds - seconds.iloc[0]).reindex(column.index).to_numpy(float)


def _is_overflow(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    return (np.abs(values) >= OVERFLOW[0]) & (np.abs(values) <= OVERFLOW[1])


@dataclass(frozen=True)
class Columns:
    """Quantities of a table in SI units, each a 1-D array as long as `rows`, the numbers of the lines."""

    values: dict[str, NDArray[np.float64]]
    rows: NDArray[np.int64]
    description: str  # what was read, for people


def read_columns(
    path: str | Path,
    quantities: Mapping[str, tuple[str, ...]],
    columns: Mapping[str, str],
    needed: Sequence[str],
    sample_time: float | None = None,
) -> Columns:
    """Read the columns of a table that hold known quantities.

    Parameters
    ----------
    path : path of the file
    quantities : the units that each may have, the first of them where nothing says which; time among them
    columns : where to find a quantity that has another name, see :meth:`Table.find`; for a table without names
        that has just the columns that are needed, time first, nothing has to be said
    needed : quantities that have to be there, beside the time
    sample_time : time between rows (s); it takes the place of the column with the time

    Rows in which a cell that is needed is empty are left out, if they are few. Raises TableError, naming file,
    column and row.
    """
    wanted = ["time", *needed] if sample_time is None else needed
    table = read_table(path, {quantity: columns.get(quantity) for quantity in wanted})
    if table.headers == numbered(len(table.headers)) and not columns:
        columns = _in_order(table, wanted)
        if columns:
            others = " ".join(f"--{q.replace('_', '-')} {place}" for q, place in columns.items())
            table.form += (
                f", without names: this order and these units assumed; {others} says so, or others"
            )
    found = {
        quantity: table.find(quantity, columns.get(quantity), units)
        for quantity, units in quantities.items()
        if quantity != "time" or sample_time is None
    }
    has = f"the file has {table.contents}: say which column it is"
    for quantity in needed:
        if found[quantity] is None:
            raise TableError(f"{path}: no column for '{quantity}'; {has}, as in --{quantity} 1")
    if sample_time is None and found["time"] is None:
        raise TableError(f"{path}: no column for 'time' and no sample time given; {has}")
    places = {quantity: place for quantity, place in found.items() if place}
    of_column = {index: quantity for quantity, (index, *_) in places.items()}
    for quantity, (index, *_) in places.items():
        if of_column[index] != quantity:
            raise TableError(
                f"{path}: column '{table.headers[index]}' cannot be both '{quantity}' and '{of_column[index]}'"
            )
    values = {quantity: si for quantity, (*_, si) in places.items()}
    if sample_time is not None:
        values["time"] = sample_time * np.arange(len(table.rows))
    empty = np.any([np.isnan(column) for column in values.values()], axis=0)
    without = np.flatnonzero(empty)
    beyond = [table.overloaded(index, without) for index, *_ in places.values()]
    overloads = int(np.any(beyond, axis=0).sum()) if without.size else 0
    if empty.sum() > LARGEST_MISSING_SHARE * empty.size:
        row = int(np.argmax(empty))
        index = next(i for q, (i, *_) in places.items() if np.isnan(values[q][row]))
        raise TableError(
            f"{path}: column '{table.headers[index]}', row {table.rows[row]} is '{table.cells.iloc[row, index]}', must "
            f"be a finite number: {empty.sum()} of {empty.size} rows have an empty cell or no number in a column that "
            f"is needed, the first is row {table.rows[row]}; at most {LARGEST_MISSING_SHARE:.0%} may"
            + f"; in {overloads} of them an instrument was out of its range"
            * bool(overloads)
        )
    stroke = (
        float(np.ptp(values["deflection"][~empty]))
        if "deflection" in values and not empty.all()
        else 0.0
    )
    if LARGEST_DEFLECTION < stroke < np.inf:
        raise TableError(
            f"{path}: the deflection spans {stroke:g} m, must be at most {LARGEST_DEFLECTION:g} m: say its "
            "unit, as in --deflection COLUMN:um"
        )
    degc = values.get("temperature", np.empty(0))
    if (wild := np.flatnonzero((degc < LOWEST_DEGC) | (degc > HIGHEST_DEGC))).size:
        index, unit, _ = places["temperature"]
        raise TableError(
            f"{path}: column '{table.headers[index]}', row {table.rows[wild[0]]} is {degc[wild[0]]:.5g}, must be within "
            f"[{LOWEST_DEGC:g}, {HIGHEST_DEGC:g}] °C; read in {unit}: say another, as in --temperature {index}:degC"
        )
    words = [f"{q} = column '{table.headers[i]}' [{unit}]" for q, (i, unit, _) in places.items()]
    if sample_time is not None:
        words.insert(0, f"time = rows {sample_time:g} s apart")
    left_out = f"; {empty.sum()} rows with empty cells left out" if empty.any() else ""
    left_out += f", in {overloads} of which an instrument was out of its range" * bool(overloads)
    return Columns(
        {quantity: column[~empty] for quantity, column in values.items()},
        table.rows[~empty],
        f"read {(~empty).sum():,} rows {table.form}: {', '.join(words)}{left_out}",
    )


def _in_order(table: Table, wanted: Sequence[str]) -> dict[str, str]:
    """Return where the `wanted` quantities are in a table without names: in this order, if no column is left.

    A deflection is in the unit in which a finger moves that far under such voltages. Raises TableError where that
    is not just one.
    """
    filled = np.flatnonzero((table.cells != "").any())
    if len(filled) != len(wanted):
        return {}
    places = {quantity: str(i) for quantity, i in zip(wanted, filled)}
    if "deflection" in places:
        stroke = table.span(int(places["deflection"]))
        voltage = table.span(int(places["voltage"])) if "voltage" in places else 0.0
        possible = [
            unit
            for unit in GUESSED
            if stroke * UNITS[unit] <= LARGEST_DEFLECTION
            and (not voltage or GAINS[0] <= stroke * UNITS[unit] / voltage <= GAINS[1])
        ]
        if len(possible) != 1:
            under = f" under {voltage:g} V" if voltage else ""
            options = " ".join(
                f"--{quantity.replace('_', '-')} {i}" for quantity, i in places.items()
            )
            raise TableError(
                f"{table.path}: no names, and a deflection that spans {stroke:g}{under} may be in "
                f"{' or '.join(possible or GUESSED)}: say its unit, as in {options}:um"
            )
        places["deflection"] += f":{possible[0]}"
    return places


def read_table(path: str | Path, wanted: Mapping[str, str | None] = MappingProxyType({})) -> Table:
    """Read a table of numbers; raises TableError naming what cannot be read.

    Of vectors the longest are taken, or the longest among which the `wanted` quantities are, see :meth:`Table.find`.
    """
    path = Path(path)
    if path.suffix.lower() in READERS:
        return _read_vectors(path, wanted)
    if path.suffix.lower() == ".xlsx":
        return _read_sheet(path)
    try:
        data = path.read_bytes()
        rows, form = read_rows(gzip.decompress(data) if path.suffix.lower() == ".gz" else data)
    except (gzip.BadGzipFile, ValueError, EOFError, zlib.error) as error:
        raise TableError(f"{path}: cannot be read as text: {error}") from None
    except OSError as error:
        raise TableError(f"{path}: cannot be read: {error.strerror}") from None
    return _table(path, rows, form)


def _table(path: Path, rows: list[Row], form: str) -> Table:
    if not rows:
        raise TableError(f"{path}: no rows")
    try:
        found = layout(rows)
    except ValueError as error:
        raise TableError(f"{path}: {error}") from None
    if found.above:
        form += f", {found.above} rows above the names passed over"
    if found.below:
        form += f", {found.below} rows of words or of a summary at the end left out"
    if found.decimal == ",":
        form += ", decimal commas"
    cells = pd.DataFrame(
        [row.cells for row in found.rows], columns=range(len(found.names)), dtype=object
    )
    numbers = np.array([row.number for row in found.rows], dtype=int)
    return Table(path, found.names, found.units, cells, numbers, found.decimal, form)


def _read_vectors(path: Path, wanted: Mapping[str, str | None]) -> Table:
    try:
        lengths = read_vectors(path)
    except ValueError as error:
        raise TableError(f"{path}: {error}") from None
    tables = []
    for vectors in lengths:
        headers = [vector.name for vector in vectors]
        told = [unit_of(vector.unit) for vector in vectors]
        units = [unit or said_unit(header) for unit, header in zip(told, headers)]
        # Not by name: two of them may have the same.
        cells = pd.DataFrame(dict(enumerate(vector.values for vector in vectors)))
        others = [other.name for others in lengths if others is not vectors for other in others]
        form = "vectors by name" + (
            f", {len(others)} of other lengths passed over" if others else ""
        )
        tables.append(
            Table(path, headers, units, cells, np.arange(len(cells)), form=form, others=others)
        )
    return next((table for table in tables if table.has(wanted)), tables[0])


def _read_sheet(path: Path) -> Table:
    try:
        cells = pd.read_excel(path, header=None, dtype=str, engine="openpyxl").dropna(how="all")
    except ImportError:
        raise TableError(f"{path}: cannot be read: {absent('openpyxl')}") from None
    except Exception as error:  # of the library that takes the bytes apart, whatever they are
        raise TableError(f"{path}: cannot be read: {error}") from None
    rows = [Row(n + 1, [c.strip() for c in cells]) for n, *cells in cells.fillna("").itertuples()]
    return _table(path, rows, "of the first sheet")
