# SPDX-License-Identifier: Apache-2.0
"""Pictures, and their curves once more for a browser: zoomed with the wheel, read under the pointer, without a network.

Where Bokeh is installed; a picture is a picture without it.
"""

from __future__ import annotations

import json
import math
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import AxLine, Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from piezo_control.files import replaced

DOTS_PER_INCH = 110
HAS_BOKEH = find_spec("bokeh") is not None
POINTS = 4000  # of a curve: more than a screen has pixels
HEIGHT = 320  # pixels of a panel
SQUARE = {"aspect_ratio": 1.0, "max_width": 2 * HEIGHT}
DASHES = {"-": "solid", "--": "dashed", ":": "dotted", "-.": "dashdot"}
MARKERS = {"x": "x", "+": "cross", "_": "dash"}  # any other is a circle


def thinned(y: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which points of a curve of any length to draw: the lowest and the highest of each stretch."""
    if len(y) <= POINTS:
        return np.arange(len(y))
    stretch = math.ceil(2 * len(y) / POINTS)
    whole = np.pad(y, (0, -len(y) % stretch), mode="edge").reshape(-1, stretch)
    begins = np.arange(len(whole)) * stretch
    ends = np.concatenate((begins + np.argmin(whole, 1), begins + np.argmax(whole, 1)))
    return np.unique(np.concatenate(([0], np.minimum(ends, len(y) - 1), [len(y) - 1])))


def plot_file(picture: Path) -> Path:
    """Return where the curves of a picture are kept."""
    return picture.with_suffix(".plot.json")


def save(figure: Figure, picture: Path) -> Path:
    """Write a figure as PNG, its curves beside it for who wants to zoom; return the picture's path."""
    with replaced(picture) as (place,):
        figure.savefig(place, dpi=DOTS_PER_INCH)
    if HAS_BOKEH:
        _write_plot(figure, picture)
    return picture


def _write_plot(figure: Figure, picture: Path) -> None:
    """Write the curves of a matplotlib figure beside its picture, as an item that Bokeh embeds."""
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot

    panels: dict[tuple[int, int], Any] = {}
    for axis in figure.axes:
        place = axis.get_subplotspec()
        if place is None:
            continue
        shared = axis.get_shared_x_axes()
        followed = next((p for other, p in panels.values() if shared.joined(axis, other)), None)
        panels[place.rowspan.start, place.colspan.start] = axis, _panel(axis, followed)
    rows = range(1 + max(row for row, _ in panels))
    columns = range(1 + max(column for _, column in panels))
    grid = [[panels.get((row, column), (None, None))[1] for column in columns] for row in rows]
    item = json_item(gridplot(grid, sizing_mode="stretch_width", merge_tools=True))
    with replaced(plot_file(picture)) as (place,):
        place.write_text(json.dumps(item))


def _panel(axis: Axes, followed: Any) -> Any:
    """Return a panel as one of Bokeh, with the range of the one that is `followed`."""
    from bokeh.models import HoverTool
    from bokeh.plotting import figure

    panel = figure(
        title=axis.get_title(), x_axis_label=axis.get_xlabel(), y_axis_label=axis.get_ylabel(),
        x_axis_type=axis.get_xscale(), y_axis_type=axis.get_yscale(), height=HEIGHT,
        **(SQUARE if axis.get_aspect() == 1.0 else {}),
        x_range=followed.x_range if followed else axis.get_xlim(), y_range=axis.get_ylim(),
        tools="pan,wheel_zoom,box_zoom,reset,save", active_scroll="wheel_zoom",
    )  # fmt: skip
    for line in axis.get_lines():
        look = _look(line, line.get_color())
        if isinstance(line, AxLine) or line.get_transform() != axis.transData:
            panel.add_layout(_straight(line, look))
            continue
        x, y = (np.asarray(values, np.float32) for values in line.get_data())
        shown = thinned(y)
        named = {} if str(line.get_label()).startswith("_") else {"legend_label": line.get_label()}
        if line.get_linestyle() == "None":
            color, marker = look["line_color"], MARKERS.get(str(line.get_marker()), "circle")
            panel.scatter(x[shown], y[shown], marker=marker, color=color, fill_color=None, **named)
        else:
            panel.line(x[shown], y[shown], **look, **named)
    for bars in axis.collections:  # of errors
        if isinstance(bars, LineCollection):
            ends = np.array(bars.get_segments())
            look = {"line_color": to_hex(bars.get_color()[0])}
            panel.multi_line(list(ends[..., 0]), list(ends[..., 1]), **look)
    for outline in axis.patches:  # of a histogram
        if isinstance(outline, Polygon):
            x, y = outline.get_xy().T
            named = {"legend_label": outline.get_label()} if outline.get_label() else {}
            y = np.maximum(y, axis.get_ylim()[0])  # it ends at 0, which a logarithmic axis lacks
            panel.line(x, y, **_look(outline, outline.get_edgecolor()), **named)
    panel.add_tools(HoverTool(tooltips=[("", "$x, $y")], mode="mouse"))
    if panel.legend:
        panel.legend.click_policy = "hide"
        panel.legend.orientation = "horizontal"
        panel.add_layout(panel.legend[0], "below")  # where it covers no curve
    return panel


def _look(line: Line2D | Polygon, color: Any) -> dict[str, Any]:
    """Return how a line looks, in the words of Bokeh."""
    return {
        "line_color": to_hex(color), "line_width": line.get_linewidth(),
        "line_alpha": line.get_alpha() or 1.0,
        "line_dash": DASHES.get(str(line.get_linestyle()), "solid"),
    }  # fmt: skip


def _straight(line: Line2D, look: dict[str, Any]) -> Any:
    """Return a line that goes through the whole panel."""
    from bokeh.models import Slope, Span

    if isinstance(line, AxLine):
        x, y = line.get_xy1()
        slope = line.get_slope()
        return Slope(gradient=slope, y_intercept=y - slope * x, **look)
    x, y = line.get_data()
    if x[0] == x[-1]:
        return Span(dimension="height", location=float(x[0]), **look)
    return Span(dimension="width", location=float(y[0]), **look)
