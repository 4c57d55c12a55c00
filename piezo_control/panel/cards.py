# SPDX-License-Identifier: Apache-2.0
"""What a finger does, in words, figures and between its limits, as HTML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from jinja2 import Environment, PackageLoader

AT_LIMIT = 0.01  # share of the range that counts as its end
TEMPLATES = Environment(loader=PackageLoader("piezo_control.panel", "."), autoescape=True)


@dataclass(frozen=True)
class Gauge:
    """Where a value is between its limits, all in `unit`; NaN for what is not known."""

    title: str
    unit: str
    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def has_limits(self) -> bool:
        """Whether the limits are known."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @property
    def is_known(self) -> bool:
        """Whether value and limits are."""
        return math.isfinite(self.value) and self.has_limits

    @property
    def text(self) -> str:
        """The value."""
        return f"{self.value:.2f}" if math.isfinite(self.value) else "–"

    @property
    def share(self) -> float:
        """Where the value is from low (0) to high (1)."""
        return min(1.0, max(0.0, (self.value - self.low) / (self.high - self.low)))

    @property
    def is_at_limit(self) -> bool:
        """Whether the value is at one of its ends."""
        return self.is_known and min(self.share, 1.0 - self.share) <= AT_LIMIT


@dataclass(frozen=True)
class Card:
    """What is shown of one finger.

    `tone` is 'good', 'busy', 'bad' or 'gone'; `words` say what the finger does, `loop` which controller is in it.
    """

    name: str
    color: str
    tone: str
    words: str
    loop: str
    gauges: Sequence[Gauge]
    figures: Sequence[tuple[str, str]]
    limits: Sequence[tuple[str, str]] = field(default_factory=list)


@dataclass
class Message:
    """Something that was asked for at a time of day, and what came of it; empty as long as nothing did."""

    time: str
    what: str
    outcome: str = ""
    is_refused: bool = False


def render(template: str, **values: object) -> str:
    """Return HTML of a template beside this module; what nodes say is text there, whatever is in it."""
    return TEMPLATES.get_template(f"{template}.html.j2").render(values)
