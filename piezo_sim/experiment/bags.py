# SPDX-License-Identifier: Apache-2.0
"""Analysis and comparison of bags from anywhere: this package, `ros2 bag record`, real hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from piezo_control.recording.recording import BagError, Recording, read
from piezo_sim.experiment import plots
from piezo_sim.experiment.analysis import Figures, analyse, classify
from piezo_sim.experiment.report import Section
from piezo_sim.experiment.results import CAPTIONS, HEADINGS, definitions, table


def recordings(
    bags: Sequence[Path], finger: str, run: int | None, partial: bool
) -> dict[str, Recording]:
    """Return the recordings by the shortest ends of the bags' paths that tell them apart."""
    names = {bag: bag.resolve() for bag in bags}
    parts = 1
    while len({Path(*path.parts[-parts:]) for path in names.values()}) < len(names):
        parts += 1
    return {
        str(Path(*path.parts[-parts:])): read(bag, finger, run, partial)
        for bag, path in names.items()
    }


def analyse_bags(found: Mapping[str, Recording], kind: str | None, out: Path) -> list[Section]:
    """Return a section with plot and table for each recording, as `kind` or what it looks like.

    Raises BagError naming the bag when its signals are not those of such an experiment.
    """
    made, shown = [], []
    for number, (name, recording) in enumerate(found.items()):
        chosen, figures = _figures(name, recording, kind)
        shown.append(figures)
        png = plots.PLOTS[chosen](
            {name: {"deflection": [recording]}}, out / f"{number}_{chosen}.png"
        )
        made.append(
            Section(
                f"{name}: {HEADINGS[chosen]}",
                f"{recording.time.size} samples, one every {recording.sample_time * 1e3:g} ms.",
                [(png, CAPTIONS[chosen])],
                *table({name: figures}, "bag"),
            )
        )
    return [*made, definitions(shown)]


def compare_bags(found: Mapping[str, Recording], kind: str | None, out: Path) -> list[Section]:
    """Return sections with all recordings in one plot and one table, the first being the reference.

    Below each other bag the table says how far its figures are from those of the first. Raises BagError
    when the recordings are of different kinds.
    """
    figures: dict[str, Figures] = {}
    kinds = {}
    for name, recording in found.items():
        kinds[name], figures[name] = _figures(name, recording, kind)
    if len(set(kinds.values())) > 1:
        listed = ", ".join(f"{name}: {k}" for name, k in kinds.items())
        raise BagError(f"bags of different kinds cannot be compared ({listed}); name one kind")
    chosen = next(iter(kinds.values()))
    lines = {name: [recording] for name, recording in found.items()}
    png = plots.PLOTS[chosen]({HEADINGS[chosen]: lines}, out / f"compare_{chosen}.png")
    rows: dict[str, Figures] = {}
    first = next(iter(figures))
    for name, row in figures.items():
        rows[name] = row
        if name != first:
            rows[f"  {name} − {first}"] = _difference(row, figures[first])
    section = Section("Comparison", "", [(png, CAPTIONS[chosen])], *table(rows, "bag"))
    return [section, definitions(figures.values())]


def _difference(row: Figures, first: Figures) -> Figures:
    pairs = {quantity: (value, first[quantity]) for quantity, value in row.items()}
    return {q: None if a is None or b is None else a - b for q, (a, b) in pairs.items()}


def _figures(name: str, recording: Recording, kind: str | None) -> tuple[str, Figures]:
    try:
        chosen = kind or classify(recording)
        return chosen, analyse(recording, chosen)
    except BagError as error:
        raise BagError(f"{name}: {error}") from None
