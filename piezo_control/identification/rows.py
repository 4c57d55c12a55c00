# SPDX-License-Identifier: Apache-2.0
"""Text as rows of cells, and which of them hold names, units and numbers.

Any usual encoding; separated by tabs, semicolons, commas, bars or blanks; decimal points or commas; quoted or not; with
comments; below whatever an instrument writes above its samples; with a row of names and one of units, or without.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from piezo_control.identification.units import UNITS, said_unit, unit_of

OVERLOAD = re.compile(
    r"(?i)[-+]?(ovld|ovfl|o\.?l\.?|clip(ped|ping)?|sat(urated)?|(over|under)([ _-]?(load|range|flow))?)|\*+"
)
"""What instruments write for a value beyond their range."""
MISSING = re.compile(
    rf"(?i)|-+|-?nan|-?1\.#(ind|qnan)\w*|n/?a|null|none|#(n/a|nv|[a-z]+/?0?!)|{OVERLOAD.pattern[4:]}"
)
"""What programs write for no number; Excel's begin like a comment."""
SUMMARY = re.compile(
    r"(?i)(mean|average|avg|median|min(imum)?|max(imum)?|std\.?([ .]*dev\.?)?|standard deviation|s\.?d\.?|rms|variance"
    r"|sum|total|count|range|statistics|summary|mittelwert|maxim\w*|minim\w*|standardabweichung|summe|moyenne)\s*:?"
)
"""What spreadsheets have in front of a row below the data."""
COMMENT = re.compile(r"(?i)\s*(#(?!n/a|nv\b|\w+/?0?!)|%)[#%]*")
NUMBER = re.compile(r"[-+−]?[\d.,]*\d[.,]?([eEdD][-+]?\d+)?")
JUDGED = 50  # rows at the end, which have numbers


class Row(NamedTuple):
    """Cells of a row, `number` counts from 1 in the file."""

    number: int
    cells: list[str]
    comment: bool = False


class Layout(NamedTuple):
    """What is where: rows of numbers, as wide as there are names."""

    names: list[str]  # '0', '1', … for a table without any
    units: list[str]  # '' where none is said, the word that is said where it is none of UNITS
    rows: list[Row]
    decimal: str
    above: int  # rows above the names
    below: int  # rows of words or of a summary at the end


def read_rows(data: bytes) -> tuple[list[Row], str]:
    """Return the rows of a text that are not empty, and in words how their cells are separated.

    Raises ValueError for what is no text.
    """
    text = _decode(data)
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    written = [line for _, line in lines if not COMMENT.match(line)]
    if not written:
        return [], ""
    votes = Counter(map(_separator, written[-JUDGED:]))
    separator = votes.most_common(1)[0][0]
    rows = []
    for number, line in lines:
        comment = COMMENT.match(line)
        cells = _split(line[comment.end() :] if comment else line, separator)
        if any(cells):
            rows.append(Row(number, cells, bool(comment)))
    spelled = {"\t": "tabs", " ": "blanks"}.get(separator, f"'{separator}'")
    form = f"separated by {spelled}"
    is_open = rows and not rows[-1].comment and not text.endswith(("\n", "\r"))
    if is_open and _is_cut([row.cells for row in rows if not row.comment]):
        form += f", row {rows.pop().number} left out, where the file ends within a row"
    return rows, form


def _is_cut(rows: list[list[str]]) -> bool:
    """Tell whether the last row has fewer cells than most, or a last number of fewer digits than all others."""
    *others, last = rows
    width = Counter(map(len, others)).most_common(1)[0][0] if others else 0
    numbers = [
        cells[-1] for cells in others if len(cells) == len(last) and NUMBER.fullmatch(cells[-1])
    ]
    marked = any(re.search("[.,]", cell) for cell in numbers)

    def digits(cell: str) -> int:  # with what is behind them, as an exponent
        parts = re.split("[.,]", cell)
        return len(parts[-1]) if len(parts) > 1 or not marked else 0

    return len(last) < width or digits(last[-1]) < min(map(digits, numbers), default=0)


def _decode(data: bytes) -> str:
    """Return the text of a file by its byte-order mark, as UTF-8, or as the Windows of a lab."""
    for mark, name in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"),
                       (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):  # fmt: skip
        if data.startswith(mark):
            return data.decode(name)
    for first, name in (
        (1, "utf-16-le"),
        (0, "utf-16-be"),
    ):  # without a mark, Latin letters have a byte of 0
        if not len(data) % 2 and data[first::2].count(0) > 0.9 * len(data) / 2:
            return data.decode(name)
    if b"\0" in data:
        raise UnicodeDecodeError(
            "utf-8", data, data.index(b"\0"), data.index(b"\0") + 1, "binary data"
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252")


def _separator(line: str) -> str:
    """Return what separates the cells of a line, which has numbers."""
    for separator in ("\t", ";", "|"):
        if separator in line:
            return separator
    if "," not in line:
        return " "
    # Commas separate, unless blanks do and the commas are within numbers.
    entries = line.split()
    if len(entries) > 1 and all(re.fullmatch(r'"?[-+−\d.,eE]+"?', e) for e in entries):
        if not any(e.endswith(",") for e in entries):
            return " "
    return ","


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        line = line.replace("\t", " ").strip()
    if '"' not in line:  # much faster
        return line.split() if separator == " " else [c.strip() for c in line.split(separator)]
    (cells,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
    return [cell.strip() for cell in cells]


def with_points(text: pd.Series, decimal: str) -> pd.Series:
    """Return numbers as computers write them: decimal points, hyphens for minus, 'e' for Fortran's 'D'."""
    plain = text.str.replace(decimal, ".", regex=False).str.replace("−", "-", regex=False)
    return plain.str.replace(r"(?<=\d)[dD](?=[-+]?\d+$)", "e", regex=True)


def _are_numbers(cells: Sequence[str], decimal: str) -> list[bool]:
    """Tell which cells are numbers or instants."""
    numbers = pd.to_numeric(with_points(pd.Series(cells, dtype=object), decimal), errors="coerce")
    return [
        known or bool(re.match(r"\d+[-/.:]\d+", cell))
        for known, cell in zip(numbers.notna().tolist(), cells)
    ]


def numbered(columns: int) -> list[str]:
    """Return what stands for the names in a table without any."""
    return [str(i) for i in range(columns)]


def layout(rows: list[Row]) -> Layout:
    """Find names, units and numbers.

    The rows at the end show how many columns there are and which of them hold numbers; the names are in the last
    row of words above the first row that looks like these, or in a comment right above it. Raises ValueError for a
    row with more cells than columns, and for names that are not as many.
    """
    rows = _timed(rows)
    shown = [row.cells for row in rows if not row.comment][-JUDGED:]
    width = Counter(map(len, shown)).most_common(1)[0][0]
    shown = [cells for cells in shown if len(cells) == width]
    decimal = _decimal(shown)
    votes = [_are_numbers(cells, decimal) for cells in shown]
    numeric = [i for i in range(width) if 2 * sum(vote[i] for vote in votes) > len(votes)]

    def fits(row: Row) -> bool:
        given = [i for i in numeric if i < len(row.cells) and not MISSING.fullmatch(row.cells[i])]
        known = _are_numbers(row.cells, decimal)
        return not row.comment and bool(given) and all(known[i] for i in given)

    def of_words(row: Row) -> bool:
        is_said = not all(map(MISSING.fullmatch, row.cells))
        return is_said and not any(_are_numbers(row.cells, decimal))

    first = next((i for i, row in enumerate(rows) if fits(row)), len(rows))
    at = next(
        (i for i in range(first - 1, -1, -1) if not rows[i].comment and of_words(rows[i])), -1
    )
    if at < 0 and first and rows[first - 1].comment and of_words(rows[first - 1]):
        at = first - 1 if len(rows[first - 1].cells) == width else -1
    if at >= 0 and at < first - 1 and _length(rows[at].cells) == 1:
        at = -1
    below = [row for row in rows[at + 1 :] if not row.comment]
    end = len(below)
    while end and not fits(below[end - 1]) and _follows(below[end - 1], width):
        end -= 1
    summary = len(below) - end
    del below[end:]
    names, units = numbered(width), [""] * width
    if at >= 0 and not (_length(rows[at].cells) == 1 < width):
        names, units, at = _named(rows, at, width)
        filled = max(map(_length, shown))
        if len(names) > filled and names[-1].lower() == "comment":  # LabVIEW's, without cells
            names, units = names[:-1], units[:-1]
        if not filled <= len(names) <= width:
            raise ValueError(
                f"row {rows[at].number} has {len(names)} names, the rows below it have {filled} cells: which is "
                "which cannot be known; make them equally many"
            )
        labels = [row.cells[1:] for row in rows[:at] if row.cells[0] == "Y_Unit_Label"]  # LabVIEW's
        said = ["", *(labels or [[]])[-1], *[""] * len(units)]
        units = [unit or unit_of(label) for unit, label in zip(units, said)]
        names, units = ((entries + [""] * width)[:width] for entries in (names, units))
    for row in below:
        if any(row.cells[width:]):
            raise ValueError(
                f"row {row.number} has {len(row.cells)} cells, must have at most {width}"
            )
    whole = [Row(row.number, (row.cells + [""] * width)[:width]) for row in below]
    _refuse_thousands(whole, decimal)
    above = sum(not row.comment for row in rows[: max(at, 0)])
    return Layout(names, units, whole, decimal, above, summary)


def _timed(rows: list[Row]) -> list[Row]:
    """Return rows with the time in the place of Rigol's numbers of samples: it has 'Start' and 'Increment' above."""
    names, below = (row.cells for row in rows[:2]) if len(rows) > 1 else ([], [])
    if names[:1] != ["X"] or "Increment" not in names or len(below) < len(names) - 1:
        return rows
    last = names.index("Increment") - 1
    try:
        start, increment = map(float, below[last : last + 2])
        times = [repr(start + increment * float(row.cells[0])) for row in rows[2:]]
    except ValueError:
        return rows
    head = [rows[0]._replace(cells=names[:last]), rows[1]._replace(cells=["s", *below[1:last]])]
    data = [row._replace(cells=[t, *row.cells[1:last]]) for row, t in zip(rows[2:], times)]
    return head + data


def _follows(row: Row, width: int) -> bool:
    """Tell whether a row at the end is none of the table: of a summary, or a sentence."""
    words = list(filter(None, row.cells))
    is_sentence = len(words) == 1 < width and " " in words[0]
    return bool(SUMMARY.fullmatch(words[0])) or is_sentence


def _decimal(shown: list[list[str]]) -> str:
    """Return the decimal mark: a comma where some cells are numbers with one, and none with a point."""
    cells = [cell for cells in shown for cell in cells]
    commas = any(re.fullmatch(r"[-+−]?\d*,\d+([eE][-+]?\d+)?", cell) for cell in cells)
    points = any(re.fullmatch(r"[-+−]?[\d,]*\.\d*([eE][-+]?\d+)?", cell) for cell in cells)
    return "," if commas and not points else "."


def _refuse_thousands(rows: list[Row], decimal: str) -> None:
    """Raise ValueError where what is taken for a decimal mark may as well be between thousands.

    Both have three digits behind them. A decimal comma is known by any number of the table that cannot be thousands,
    as 0,123; a decimal point by every number of the column having one.
    """
    thousands = re.compile(rf"[-+−]?[1-9]\d{{0,2}}([{decimal}]\d{{3}})+")
    doubtful, known = "", False
    for column in zip(*(row.cells for row in rows)):
        marked = next((cell for cell in column if decimal in cell), "")
        if not all(thousands.fullmatch(cell) for cell in column if decimal in cell):
            known = decimal == ","
        elif marked and (decimal == "," or any(c.lstrip("-+−").isdigit() for c in column)):
            doubtful = marked
    if doubtful and not known:
        raise ValueError(
            f"'{doubtful}' is {doubtful.replace(decimal, '')}, or has decimals: numbers with three digits behind each "
            f"'{decimal}' may be either; write them without marks between thousands, decimals with more digits"
        )


def _named(rows: list[Row], at: int, width: int) -> tuple[list[str], list[str], int]:
    """Return names, units, and the index of the row of names, of words in row `at`: names, or units below them."""
    names, units = (rows[at - 2].cells, rows[at - 1].cells) if at > 1 else ([], [])
    if len(names) == len(units) > 1 and all(unit_of(word) in UNITS for word in units if word):
        at -= 1  # what is left between the units and the numbers are Origin's comments
    words = rows[at].cells[: _length(rows[at].cells)]
    told = [unit_of(word) for word in words]
    if at and not rows[at - 1].comment and _are_units(words):
        names = rows[at - 1].cells[: _length(rows[at - 1].cells)]
        told += [""] * len(names)
        return names, [unit or said_unit(name) for unit, name in zip(told, names)], at - 1
    return words, [said_unit(word) for word in words], at


def _are_units(cells: list[str]) -> bool:
    """Tell whether at least half of what is in cells are units."""
    words = list(filter(None, cells))
    return 2 * sum(unit_of(word) in UNITS for word in words) >= len(words)


def _length(cells: list[str]) -> int:
    """Return how many cells there are up to the last one that is not empty."""
    return max((i for i, cell in enumerate(cells, 1) if cell), default=0)
