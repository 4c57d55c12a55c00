# SPDX-License-Identifier: Apache-2.0
"""A self-contained page of figures and tables, and the same tables on the terminal.

The page says how it came to be: command, time and version.
"""

from __future__ import annotations

import base64
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from piezo_control.files import replaced
from piezo_control.report.pictures import plot_file
from piezo_control.shared import version

GAP = 2  # blanks between the columns of a table
EDGES = 2  # blanks around it
WIDEST_TEXT = 26  # from here on the words of a cell are wrapped


@dataclass(frozen=True)
class Section:
    """A heading with text, figures (PNG file and caption) and a table of cells.

    `links` says which cells lead to which file beside the page. What `is_appendix` stands at the end of the
    page and not on the terminal.
    """

    title: str
    text: str = ""
    figures: Sequence[tuple[Path, str]] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default_factory=list)
    links: Mapping[str, str] = field(default_factory=dict)
    is_appendix: bool = False


def write_html(
    path: Path,
    title: str,
    sections: Iterable[Section],
    verdict: Sequence[str] = (),
    footer: str = "",
) -> Path:
    """Write `verdict`, in sentences, and `sections` as one HTML file with the pictures inside; return its path."""
    environment = Environment(loader=PackageLoader("piezo_control.report", "."), autoescape=True)
    environment.filters["is_text"] = is_text
    template = environment.get_template("page.html.j2")
    pages: list[dict[str, Any]] = [
        {
            "title": section.title,
            "text": section.text,
            "columns": section.columns,
            "rows": section.rows,
            "links": section.links,
            "is_appendix": section.is_appendix,
            "figures": [
                {
                    "caption": caption,
                    "data": base64.b64encode(png.read_bytes()).decode(),
                    "plot": _plot(png),
                }
                for png, caption in section.figures
            ],
        }
        for section in sorted(sections, key=lambda section: section.is_appendix)
    ]
    origin = {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "date": f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        "version": f"piezo_gripper {version()}",
        "has_metrics": (path.parent / "metrics.json").exists(),
        "script": _script() if any(f["plot"] for page in pages for f in page["figures"]) else "",
    }
    text = template.render(title=title, sections=pages, verdict=verdict, footer=footer, **origin)
    with replaced(path) as (place,):
        place.write_text(text)
    return path


def _plot(picture: Path) -> str:
    """Return the curves of a picture, as a script's text may say them; empty: there are none."""
    file = plot_file(picture)
    return file.read_text().replace("</", "<\\/") if file.exists() else ""


def _script() -> str:
    """Return the library that draws curves in the page, whole: it may be opened where there is no network."""
    from bokeh.resources import Resources

    return Resources(mode="inline", components=["bokeh"]).render_js()


def print_table(console: Console, section: Section) -> None:
    """Print the section's table on the terminal; columns that do not fit stand in a table of their own."""
    title = escape(section.title)
    for columns in _fitting(section, console.width - EDGES):
        table = Table(
            title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, GAP - 1, 0, 0)
        )
        for index in columns:
            table.add_column(
                escape(section.columns[index]),
                justify="right" if index and _is_numeric(section, index) else "left",
                width=_width(section, index),
            )
        for row in section.rows:
            table.add_row(*(escape(row[index]) for index in columns))
        console.print(table)
        title = ""


def _fitting(section: Section, width: int) -> Iterator[list[int]]:
    """Split the columns so that each part, the first column in each, fits into `width`."""
    widths = [_width(section, index) + GAP for index in range(len(section.columns))]
    part = [0]
    for index in range(1, len(widths)):
        if len(part) > 1 and sum(widths[i] for i in (*part, index)) > width:
            yield part
            part = [0]
        part.append(index)
    yield part


def _width(section: Section, index: int) -> int:
    """Return the width of a column: nothing but text of several words is wrapped, between words."""
    cells = [row[index] for row in section.rows]
    words = [word for text in (section.columns[index], *cells) for word in text.split()]
    longest = max(map(len, cells), default=0)
    return max(*map(len, words), min(longest, WIDEST_TEXT), 1)


def _is_numeric(section: Section, index: int) -> bool:
    return all(not is_text(row[index]) for row in section.rows)


def is_text(cell: str) -> bool:
    """Tell text from a number or the dash in its place."""
    return not re.match(r"[-+–≤≥<0-9]", cell)


def cell(value: float | None, digits: int = 2) -> str:
    """Return a number as a table shows it; None, a figure that does not exist, is a dash."""
    return "–" if value is None else f"{value:.{digits}f}"
