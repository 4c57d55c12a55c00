# SPDX-License-Identifier: Apache-2.0
"""Numbered samples, each answered once: whether a sample is new, repeated, the first of a run, or stray.

A sample numbered one more than the last is new. The last number again is a request to repeat the answer.
Number 0 begins a run. Anything else is stray: it is not answered, and the count goes on as if it had not come.
Where numbers may be left out, a few stray ones that rise are a count that began anew, and go on as such.
"""

from __future__ import annotations

from typing import Any

SAMPLE_TIME = 1e-4
"""Of a finger's loop (s), where nothing else is said."""
NEW, REPEATED, FIRST, STRAY = range(4)


def grid_index(sample: Any, sample_time: float, period: float) -> Any:
    """Return which grid value holds at sample * sample_time; exact, in whole nanoseconds.

    `sample` is a number or an integer array; the result is alike.
    """
    return sample * round(sample_time * 1e9) // round(period * 1e9)


class Sequence:
    """The count of one stream of samples.

    With `gaps`, numbers may be left out, as they are when only the newest sample counts: a number above the
    last one is new, but for a leap of more than `LARGEST_GAP`, which no loss explains.
    """

    LARGEST = 2**53
    """A number above it is no count: at one sample a microsecond it is 285 years, and a float holds no larger one."""

    LARGEST_GAP = 10**7
    RISING = 3
    """So many stray numbers that rise begin a new run, with `gaps`."""

    def __init__(self, gaps: bool = False) -> None:
        self.gaps = gaps
        self.next = -1
        """Number of the sample that comes next; -1 before the first one."""
        self._strays: list[int] = []

    def classify(self, number: int) -> int:
        """Return NEW, REPEATED, FIRST or STRAY; nothing is counted yet."""
        if number == 0 and self.next != 1:
            return FIRST
        if number == self.next - 1:
            return REPEATED
        if number > self.LARGEST:
            return STRAY
        if number == self.next or self.next < 0 and self.gaps:
            return NEW
        if self.gaps and self.next < number < self.next + self.LARGEST_GAP:
            return NEW
        return STRAY

    def count(self, number: int) -> None:
        """Take note that sample `number` was answered."""
        self.next = number + 1
        self._strays.clear()

    def begins_anew(self, number: int) -> bool:
        """Take note of a stray sample, and say whether a new run began: then the count is at this one."""
        if self._strays and number <= self._strays[-1]:
            self._strays.clear()
        self._strays.append(number)
        if not self.gaps or number > self.LARGEST or len(self._strays) < self.RISING:
            return False
        self.count(number - 1)
        return True
