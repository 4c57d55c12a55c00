# SPDX-License-Identifier: Apache-2.0
"""A self-contained page of figures and tables, and the same tables on the terminal."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import Environment, PackageLoader
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table


@dataclass(frozen=True)
class Section:
    """A heading with text, figures (PNG file and caption) and a table of cells."""

    title: str
    text: str = ""
    figures: Sequence[tuple[Path, str]] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = field(default_factory=list)


def write_html(path: Path, title: str, sections: Iterable[Section], footer: str = "") -> None:
    """Write `sections` as one HTML file with the pictures inside."""
    environment = Environment(loader=PackageLoader("piezo_sim.experiment", "."), autoescape=True)
    environment.filters["is_text"] = lambda cell: not re.match(r"[-+–0-9]", cell)
    template = environment.get_template("report.html.j2")
    pages = [
        {
            "title": section.title,
            "text": section.text,
            "columns": section.columns,
            "rows": section.rows,
            "figures": [
                {"caption": caption, "data": base64.b64encode(png.read_bytes()).decode()}
                for png, caption in section.figures
            ],
        }
        for section in sections
    ]
    path.write_text(template.render(title=title, sections=pages, footer=footer))


def print_table(console: Console, section: Section) -> None:
    """Print the section's table on the terminal."""
    table = Table(
        title=escape(section.title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False
    )
    for column in section.columns:
        is_first = column == section.columns[0]
        table.add_column(escape(column), justify="left" if is_first else "right", no_wrap=is_first)
    for row in section.rows:
        table.add_row(*map(escape, row))
    console.print(table)


def cell(value: float | None, digits: int = 2) -> str:
    """Return a number as a table shows it; None, a figure that does not exist, is a dash."""
    return "–" if value is None else f"{value:.{digits}f}"
