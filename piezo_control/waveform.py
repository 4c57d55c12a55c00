# SPDX-License-Identifier: Apache-2.0
"""A signal that goes on by itself: a periodic function of time, evaluated wherever a sample needs it.

With tau = time - start and the phase p in cycles, p = frequency tau, but for a sweep, whose frequency grows
(or falls) by the same factor in the same time, from `frequency` to `end_frequency` = r frequency:

    p = frequency duration (r^(tau / duration) - 1) / ln r

    step           offset + amplitude in the first half of every cycle, offset in the second
    sine, sweep    offset + amplitude sin(2 pi p)
    triangle       offset + amplitude (1 - 4 |frac(p + 1/4) - 1/2|)
    decaying_sine  offset + amplitude min(1, (n - p) / (n - 1)) sin(2 pi p)

n is the number of whole cycles in `duration`, after which the value is the offset again, as before the start.
So every shape but the step begins and ends without a jump.

The decaying sine serves identification and homing: its first cycle goes to both ends and makes the plays of a
hysteresis forget what was before; every further one turns a little earlier and leaves other plays moving.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SHAPES = ("step", "sine", "triangle", "sweep", "decaying_sine")
HIGHEST_FREQUENCY = 1e5  # Hz
LONGEST = 1e6  # s


@dataclass(frozen=True)
class Waveform:
    """A signal (m, V or N) over time.

    Parameters
    ----------
    shape : one of SHAPES
    amplitude : unit of the signal
    frequency : Hz; of a sweep: at its start
    offset : unit of the signal
    end_frequency : Hz, of a sweep alone: at its end
    duration : s; 0: without an end, which sweep and decaying sine need to have
    start : s since sample 0

    Raises
    ------
    ValueError
        For an unknown shape, a number that is not finite or out of range, a sweep or decaying sine that has
        no duration or fewer than one or two cycles in it; the message names the number and what is allowed.

    Examples
    --------
    >>> Waveform("triangle", amplitude=10e-6, frequency=1.0).at([0.0, 0.25, 0.5, 0.75])
    array([ 0.e+00,  1.e-05,  0.e+00, -1.e-05])
    """

    shape: str
    amplitude: float
    frequency: float
    offset: float = 0.0
    end_frequency: float = 0.0
    duration: float = 0.0
    start: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise ValueError(f"shape is '{self.shape}', must be one of {', '.join(SHAPES)}")
        for name in ("amplitude", "offset", "start"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}, must be finite")
        if not 0.0 <= self.duration <= LONGEST:
            raise ValueError(f"duration is {self.duration:g}, must be in [0, {LONGEST:g}] s")
        for name in ("frequency", *(["end_frequency"] if self.shape == "sweep" else [])):
            if not 0.0 < getattr(self, name) <= HIGHEST_FREQUENCY:
                raise ValueError(
                    f"{name} is {getattr(self, name):g}, must be in (0, {HIGHEST_FREQUENCY:g}] Hz"
                )
        if self.shape == "sweep" and self.end_frequency == self.frequency:
            raise ValueError(
                f"end_frequency is {self.end_frequency:g} Hz as is frequency: that is a sine"
            )
        fewest = {"sweep": 1, "decaying_sine": 2}.get(self.shape, 0)
        if fewest and not (self.duration and self.cycles >= fewest):
            raise ValueError(
                f"duration is {self.duration:g} s, must have room for {fewest} cycles of a {self.shape}"
            )

    @classmethod
    def of(cls, message: Any) -> Waveform:
        """Return what a message of the type piezo_gripper_msgs/Waveform says; ValueError as above."""
        shape = dict(enumerate(SHAPES)).get(message.shape, str(message.shape))
        names = [field.name for field in fields(cls)]
        return cls(**{name: getattr(message, name) for name in names} | {"shape": shape})

    @property
    def cycles(self) -> float:
        """Number of whole cycles until the end; infinite without one."""
        if not self.duration:
            return math.inf
        return math.floor(float(self._phase(np.array(self.duration))) + 1e-9)

    @property
    def highest_frequency(self) -> float:
        """The highest frequency (Hz) of the sines that it is named by."""
        return max(self.frequency, self.end_frequency if self.shape == "sweep" else 0.0)

    @property
    def largest(self) -> float:
        """Size that no value exceeds."""
        return max(map(abs, self.ends))

    @property
    def ends(self) -> tuple[float, float]:
        """The lowest and the highest value that it may have."""
        turns = [self.offset + self.amplitude, self.offset]
        if self.shape != "step":
            turns.append(self.offset - self.amplitude)
        return min(turns), max(turns)

    def at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the values at `time` (s since sample 0, any shape)."""
        tau = np.asarray(time, dtype=float) - self.start
        phase = self._phase(np.clip(tau, 0.0, self.duration or None))
        whole = phase - np.floor(phase)
        if self.shape == "step":
            wave = np.where(whole < 0.5, 1.0, 0.0)
        elif self.shape == "triangle":
            wave = 1.0 - 4.0 * np.abs((whole + 0.25) % 1.0 - 0.5)
        else:
            wave = np.sin(2.0 * np.pi * whole)
        if self.shape == "decaying_sine":
            wave = wave * np.minimum(1.0, (self.cycles - phase) / (self.cycles - 1.0))
        runs = (tau >= 0.0) & (tau < (self.duration or math.inf)) & (phase < self.cycles)
        return self.offset + np.where(runs, self.amplitude * wave, 0.0)

    def _phase(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the cycles that have passed `tau` (s) after the start."""
        if self.shape != "sweep":
            return self.frequency * tau
        rate = math.log(self.end_frequency / self.frequency) / self.duration
        return self.frequency * np.expm1(rate * tau) / rate
