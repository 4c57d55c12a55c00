# SPDX-License-Identifier: Apache-2.0
"""Whether a temperature can be believed: one that is missing or frozen is named, and not used.

Times are in s on a clock that never stands still or jumps: ``time.monotonic``, or the instants of samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from piezo_control.parameters import parameter
from piezo_control.safety import HIGHEST_DEGC, LOWEST_DEGC


@dataclass(frozen=True)
class ThermometerParameters:
    """When a temperature is not believed, and what happens then."""

    timeout: float = parameter(
        5.0, "missing: no temperature for so long", unit="s", low=1e-2, high=3600.0
    )
    frozen_after: float = parameter(
        0.0,
        "frozen: exactly the same value for so long, which no thermocouple reads; 0: never",
        unit="s",
        low=0.0,
        high=1e6,
    )
    fallback: str = parameter(
        "hold",
        "missing or frozen: hold the body's temperature and go on, or fault: go to rest",
        choices=("hold", "fault"),
    )
    degc_at_start: float = parameter(
        22.0,
        "temperature of the finger before any was read",
        unit="degC",
        low=LOWEST_DEGC,
        high=HIGHEST_DEGC,
    )


class Thermometer:
    """The newest temperature; `now` (s) at construction is when it began to be waited for.

    >>> thermometer = Thermometer(ThermometerParameters(timeout=1.0), now=0.0)
    >>> thermometer.hear(25.0, now=0.5)
    >>> thermometer.read(now=1.0), thermometer.read(now=2.0), thermometer.wrong
    (25.0, nan, 'temperature missing: none for 1 s')
    """

    def __init__(self, parameters: ThermometerParameters, now: float) -> None:
        self.parameters = parameters
        self.degc = math.nan
        self.wrong = ""
        """What was wrong at the last reading; empty: nothing."""
        self._heard = self._changed = now

    @property
    def ends(self) -> str:
        """What is wrong at the last reading and ends at rest; empty: nothing, or the models go on."""
        return self.wrong if self.parameters.fallback == "fault" else ""

    def hear(self, degc: float, now: float) -> None:
        """Take a finite temperature (°C)."""
        if degc != self.degc:
            self._changed = now
        self.degc = degc
        self._heard = now

    def check(self) -> None:
        """Raise ValueError if what was wrong at the last reading would end at rest again."""
        if self.ends:
            raise ValueError(f"{self.ends}, and 'thermometer.fallback' is 'fault'")

    def read(self, now: float) -> float:
        """Return the temperature (°C), NaN when it cannot be believed; `wrong` says why."""
        p = self.parameters
        self.wrong = ""
        if now - self._heard > p.timeout:
            self.wrong = f"temperature missing: none for {p.timeout:g} s"
        elif p.frozen_after and now - self._changed > p.frozen_after:
            self.wrong = f"temperature frozen: {self.degc:g} °C for {p.frozen_after:g} s"
        return math.nan if self.wrong else self.degc
