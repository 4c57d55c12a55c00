# SPDX-License-Identifier: Apache-2.0
"""Rows of numbers, the newest so many, to draw from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class History:
    """The newest `length` rows of some columns; older ones are forgotten.

    Examples
    --------
    >>> history = History(("clock", "deflection"), length=3)
    >>> for clock in range(5):
    ...     history.append((clock, 1e-6 * clock))
    >>> history.count, history.since(0)["clock"].tolist(), history.since(0, step=2)["clock"].tolist()
    (5, [2.0, 3.0, 4.0], [2.0, 4.0])
    """

    def __init__(self, columns: Sequence[str], length: int) -> None:
        self.columns = tuple(columns)
        self.count = 0
        """Number of rows that were appended."""
        self.known: set[str] = set()
        """Columns that had a finite number at least once."""
        self._rows = np.full((length, len(self.columns)), np.nan)

    def append(self, row: Sequence[float]) -> None:
        """Take note of a row, with a number for each column."""
        self._rows[self.count % len(self._rows)] = row
        self.known.update(c for c, v in zip(self.columns, row) if math.isfinite(v))
        self.count += 1

    def since(self, first: int, step: int = 1) -> dict[str, NDArray[np.float64]]:
        """Return the columns of the rows `first`, first + 1, …: of those that are there every `step`-th.

        The same rows are left out whatever `first` is.
        """
        first = max(first, self.count - len(self._rows), 0)
        chosen = np.arange(-(-first // step) * step, self.count, step) % len(self._rows)
        return dict(zip(self.columns, self._rows[chosen].T, strict=True))

    def rate(self, column: str, clock: str, rows: int) -> float:
        """Return by how much `column` grew per unit of `clock` over the last so many rows.

        NaN while there are fewer, and where it fell or was not known.
        """
        if self.count <= rows or rows >= len(self._rows):
            return math.nan
        ends = self._rows[np.array([self.count - 1 - rows, self.count - 1]) % len(self._rows)]
        growth, duration = (np.diff(ends[:, self.columns.index(c)])[0] for c in (column, clock))
        return float(growth / duration) if growth >= 0.0 and duration > 0.0 else math.nan
