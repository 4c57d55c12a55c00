# SPDX-License-Identifier: Apache-2.0
"""A signal that travels ahead of its use: points in time, held or joined by straight lines."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Signal(Protocol):
    """A reference (m) or a tip force (N) over time."""

    @property
    def largest(self) -> float:
        """Size that no value exceeds."""

    def at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the values at `time` (s since sample 0, any shape)."""


class Profile:
    """A reference (m) or a tip force (N) over time.

    Parameters
    ----------
    time : array_like, shape (n,)
        Instants in seconds since sample 0, strictly increasing, n >= 1.
    value : array_like, shape (n,)
        Values at these instants, finite.
    linear : bool
        Straight lines between the points; otherwise value[i] holds until time[i + 1]. Before the first
        and after the last point the nearest value holds.

    Raises
    ------
    ValueError
        For no points, unequal lengths, numbers that are not finite, or time that does not increase;
        the message names the index and the value.

    Examples
    --------
    >>> Profile([0.0, 0.02], [0.0, 20e-6]).at([0.0, 0.019, 0.02])
    array([0.e+00, 0.e+00, 2.e-05])
    """

    def __init__(self, time: ArrayLike, value: ArrayLike, linear: bool = False) -> None:
        self.time = np.array(time, dtype=float)
        self.value = np.array(value, dtype=float)
        self.linear = linear
        if self.time.ndim != 1 or self.time.shape != self.value.shape or not self.time.size:
            raise ValueError(
                f"profile has {self.time.size} instants and {self.value.size} values; "
                "needs as many of both, at least one"
            )
        for name, array in (("time", self.time), ("value", self.value)):
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise ValueError(f"profile {name}[{bad[0]}] is {array[bad[0]]}, must be finite")
        late = np.flatnonzero(np.diff(self.time) <= 0)
        if late.size:
            i = late[0]
            raise ValueError(
                f"profile time[{i + 1}] is {self.time[i + 1]:g} s after time[{i}] = "
                f"{self.time[i]:g} s; must increase"
            )

    @property
    def largest(self) -> float:
        """Size that no value exceeds."""
        return float(np.max(np.abs(self.value)))

    def part(self, begin: float, end: float) -> Profile:
        """Return the profile between two instants (s); it stays where it is at the end."""
        inside = self.time[(self.time > begin) & (self.time < end)]
        times = np.array([begin, *inside, end])
        return Profile(times, self.at(times), self.linear)

    def at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the values at `time` (s, any shape)."""
        if self.linear:
            return np.interp(time, self.time, self.value)
        index = np.searchsorted(self.time, time, side="right") - 1
        return self.value[np.maximum(index, 0)]


class SampledSignal:
    """A signal read sample by sample: ``sampled[k]`` is the value at k * sample_time, as a float.

    Values are computed in blocks, because one look-up at a time costs more than the control law.
    """

    BLOCK = 1024

    def __init__(self, signal: Signal, sample_time: float) -> None:
        self.signal = signal
        self.sample_time = sample_time
        self._first = 0
        self._values: list[float] = []

    def __getitem__(self, number: int) -> float:
        index = number - self._first
        if not 0 <= index < len(self._values):
            self._first = number
            index = 0
            numbers = np.arange(number, number + self.BLOCK)
            self._values = self.signal.at(numbers * self.sample_time).tolist()
        return self._values[index]
