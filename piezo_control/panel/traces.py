# SPDX-License-Identifier: Apache-2.0
"""Figures of what was measured of late, which go on by themselves."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, DataRange1d, DatetimeTickFormatter, Span
from bokeh.plotting import figure
from numpy.typing import NDArray

from piezo_control.panel.history import History

LOOKS = 50  # a second: rows of a history
SPANS = {"10 s": 10, "1 min": 60, "10 min": 600}
"""What there is to choose from, in s."""
MOST = 1500  # rows that are drawn; a screen has no more columns
COLORS = ("#2f7de1", "#e07b1a")  # of the fingers; seen on white and on black

FIGURES: dict[str, tuple[tuple[str, ...], float]] = {
    "position": (("deflection", "reference", "command"), 0.2),
    "voltage": (("voltage",), 1.0),
    "temperature": (("temperature",), 1.0),
    "force": (("tip_force",), 0.1),
    "rate": (("rate",), 100.0),
    "jitter": (("jitter",), 10.0),
}
"""Signals of each figure, and the least span of its axis."""
SCALES = {"deflection": 1e6, "reference": 1e6, "command": 1e6, "tip_force": 1e3, "jitter": 1e6}
"""From SI to what is drawn: µm, mN, µs."""
DASHES = {"reference": "dashed", "command": "dotted"}
"""Lines that are not solid; the names are those of CSS, too."""
SIGNALS = ("clock", "number", *(s for signals, _ in FIGURES.values() for s in signals))
"""Columns of a history: `clock` in s since 1970, the others in SI."""
TICKS = {"seconds": "%H:%M:%S", "minsec": "%H:%M:%S", "minutes": "%H:%M", "hourmin": "%H:%M"}


def drawn(rows: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return rows of a history in the units of the figures, `clock` in ms of the local time of day."""
    local = time.localtime().tm_gmtoff
    columns = {n: v * SCALES.get(n, 1.0) for n, v in rows.items() if n not in ("clock", "number")}
    return {"clock": (rows["clock"] + local) * 1e3, **columns}


def known(histories: Iterable[History]) -> list[str]:
    """Return the figures that there is something to draw in, at any time so far."""
    signals = set().union(*(history.known for history in histories))
    return [name for name, (needed, _) in FIGURES.items() if signals.intersection(needed)]


class Traces:
    """Figures of the histories of one or two fingers, and what they are drawn from."""

    def __init__(self, histories: Mapping[str, History], names: Iterable[str] = FIGURES) -> None:
        self._histories = dict(histories)
        self._sources = {
            name: ColumnDataSource(drawn(history.since(history.count)), name=f"source{name}")
            for name, history in histories.items()
        }
        self._drawn = dict.fromkeys(histories, 0)
        self._clock = DataRange1d(follow="end", range_padding=0.0)
        self._limits: dict[str, tuple[Span, Span]] = {}
        self.figures = {name: self._figure(name) for name in names}
        self.is_frozen = False
        self.show(next(iter(SPANS)))

    def show(self, span: str) -> None:
        """Show the last so much, one of SPANS."""
        seconds = SPANS[span]
        self._clock.follow_interval = seconds * 1e3
        self._rows = min(seconds * LOOKS, MOST)
        self._step = math.ceil(seconds * LOOKS / MOST)
        for name, history in self._histories.items():
            rows = history.since(history.count - seconds * LOOKS, self._step)
            self._sources[name].data = drawn(rows)
            self._drawn[name] = history.count

    def go_on(self) -> None:
        """Draw what came since the last time."""
        if self.is_frozen:
            return
        for name, history in self._histories.items():
            rows = history.since(self._drawn[name], self._step)
            self._drawn[name] = history.count
            if len(rows["clock"]):
                self._sources[name].stream(drawn(rows), rollover=self._rows)

    def limit(self, figure: str, low: float, high: float) -> None:
        """Draw the limits of a figure, in its unit."""
        for line, value in zip(self._limits[figure], (low, high), strict=True):
            if line.location != value:
                line.update(location=value, visible=math.isfinite(value))

    def _figure(self, name: str) -> Any:
        signals, least = FIGURES[name]
        plot = figure(
            name=name, height=280 if name == "position" else 170, sizing_mode="stretch_width",
            x_range=self._clock, y_range=DataRange1d(min_interval=least, range_padding=0.15),
            tools="pan,xwheel_zoom,box_zoom,reset,save", toolbar_location="above", toolbar_inner=True,
            background_fill_color=None, border_fill_color=None, outline_line_color=None,
        )  # fmt: skip
        plot.toolbar.logo = None
        plot.toolbar.autohide = True
        plot.xaxis.formatter = DatetimeTickFormatter(**TICKS)
        for color, source in zip(COLORS, self._sources.values(), strict=False):
            for signal in signals:
                plot.line(
                    "clock", signal, source=source, color=color, line_width=2.0,
                    line_dash=DASHES.get(signal, "solid"),
                )  # fmt: skip
        self._limits[name] = tuple(
            Span(dimension="width", line_color="#d64545", line_dash="dashed", visible=False)
            for _ in range(2)
        )
        plot.renderers.extend(self._limits[name])
        return plot
