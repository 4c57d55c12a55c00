# SPDX-License-Identifier: Apache-2.0
"""Analysis and comparison of recordings from anywhere: bags of whatever recorder, tables of instruments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from piezo_control.identification.columns import LOOP
from piezo_control.identification.measurement import is_bag, places
from piezo_control.identification.table import TableError, read_columns
from piezo_control.recording.recording import BagError, Recording, read
from piezo_control.report.page import Section
from piezo_sim.experiment import plots
from piezo_sim.experiment.analysis import Figures, analyse, classify, steps
from piezo_sim.experiment.results import CAPTIONS, HEADINGS, definitions, table


@dataclass(frozen=True)
class Analysed:
    """A recording, what was left out of it, its kind, and its figures: of every step, or of the whole."""

    recording: Recording
    left_out: str
    kind: str
    figures: Mapping[str, Figures]  # by what they are of; '' is the whole


def analysed(
    bags: Sequence[Path],
    kind: str | None = None,
    finger: str = "",
    run: int | None = None,
    partial: bool = False,
    columns: Mapping[str, str] | None = None,
    sample_time: float | None = None,
    refused: list[BagError] | None = None,
) -> dict[str, Analysed]:
    """Return bags and tables, by the shortest ends of their paths that tell them apart.

    Each as `kind`, or as what it looks like. `finger`, `run` and `partial` are of bags
    (:func:`piezo_control.recording.recording.read`), `columns` and `sample_time` of tables
    (:func:`piezo_control.identification.table.read_columns`). A recording whose signals are not
    those of such an experiment is left out, and the BagError that names it put into `refused`;
    raised, where there is none.
    """

    def recorded(path: Path) -> tuple[Recording, str]:
        if is_bag(path):
            return read(path, finger, run, partial), ""
        return _read_table(path, columns or {}, sample_time)

    found = {}
    for name, bag in told_apart(bags).items():
        try:
            found[name] = _analyse(bag, *recorded(bag), kind)
        except BagError as error:
            if refused is None:
                raise
            refused.append(error)
    return found


def told_apart(paths: Iterable[Path]) -> dict[str, Path]:
    """Return paths by their shortest ends that tell them apart; what is one place is there once."""
    places = {path.resolve(): path for path in paths}
    parts = 1
    while len({place.parts[-parts:] for place in places}) < len(places):
        parts += 1
    return {str(Path(*place.parts[-parts:])): path for place, path in places.items()}


def _read_table(
    path: Path, columns: Mapping[str, str], sample_time: float | None
) -> tuple[Recording, str]:
    """Return the recording in a table, and what was read of it."""
    try:
        found = read_columns(path, LOOP, columns, ("deflection",), sample_time)
    except TableError as error:
        raise BagError(str(error)) from None
    time = found.values.pop("time")
    late = np.flatnonzero(np.diff(time) <= 0.0)
    if time.size < 2 or late.size:
        row = f"row {found.rows[late[0] + 1]}: the time" if late.size else "one row or none: a run"
        raise BagError(f"{path}: {row} must go on; --sample-rate takes the place of its column")
    since = time - time[0]
    number = places(time).astype(np.int64)
    if np.any(np.diff(number) < 1):
        number = np.arange(time.size)  # samples at odd instants: none can be called missing
    signals = (f.name for f in fields(Recording) if f.name not in ("number", "time"))
    nothing = dict.fromkeys(signals, np.full(time.size, np.nan))
    return Recording(number=number, time=since, **{**nothing, **found.values}), found.description


def _analyse(bag: Path, recorded: Recording, read_as: str, kind: str | None) -> Analysed:
    try:
        recording, left_out = recorded.complete()
        left_out = "; ".join(filter(None, (read_as, left_out)))
        chosen = kind or classify(recording)
        parts = {_title(part): part for part in steps(recording)} if chosen == "step" else {}
        if len(parts) < 2:
            parts = {"": recording}
        return Analysed(
            recording,
            left_out,
            chosen,
            {name: analyse(part, chosen) for name, part in parts.items()},
        )
    except BagError as error:
        raise BagError(f"{bag}: {error}") from None


def _title(step: Recording) -> str:
    """Return when a step begins, and from where to where the reference goes."""
    first, last = step.reference[0] * 1e6, step.reference[-1] * 1e6
    begin = step.time[min(1, step.time.size - 1)]
    ramp = step.time[np.argmax(step.reference == step.reference[-1])] - begin
    took = f" within {ramp:.3g} s" if ramp > 0.0 else ""
    if first == last:
        first, begin = 0.0, step.time[0]
    return f"{begin:.4g} s: {first:.4g} → {last:.4g} µm{took}"


def analyse_bags(found: Mapping[str, Analysed], out: Path) -> list[Section]:
    """Return a section with plot and table for each bag."""
    made = []
    shown = [figures for one in found.values() for figures in one.figures.values()]
    for number, (name, one) in enumerate(found.items()):
        png = plots.PLOTS[one.kind](
            {name: {"deflection": [one.recording]}}, out / f"{number}_{one.kind}.png"
        )
        made.append(
            Section(
                f"{name}: {HEADINGS[one.kind]}",
                _said(one),
                [(png, CAPTIONS[one.kind])],
                *table({of or name: figures for of, figures in one.figures.items()}, "bag"),
            )
        )
    return [*made, definitions(shown)]


def compare_bags(found: Mapping[str, Analysed], out: Path) -> list[Section]:
    """Return sections with all bags in one plot and one table, the first being the reference.

    Below each other bag the table says how far its figures are from those of the first, step by
    step, or why not.
    Raises BagError when the bags are of different kinds.
    """
    kinds = {name: one.kind for name, one in found.items()}
    if len(set(kinds.values())) > 1:
        listed = ", ".join(f"{name}: {kind}" for name, kind in kinds.items())
        raise BagError(f"bags of different kinds cannot be compared ({listed}); name one kind")
    chosen = next(iter(kinds.values()))
    lines = {name: [one.recording] for name, one in found.items()}
    png = plots.PLOTS[chosen]({HEADINGS[chosen]: lines}, out / f"compare_{chosen}.png")
    rows: dict[str, Figures] = {}
    first = next(iter(found))
    for name, one in found.items():
        rows |= {f"{name} {of}".strip(): figures for of, figures in one.figures.items()}
        here, there = len(one.figures), len(found[first].figures)
        if here != there:
            rows[f"  {name} − {first}: none, steps: {here} and {there}"] = {}
        elif name != first:
            pairs = zip(one.figures.items(), found[first].figures.values())
            rows |= {
                f"  {name} − {first} {of}".rstrip(): _difference(figures, others)
                for (of, figures), others in pairs
            }
    said = " ".join(f"{name}: {_said(one)}" for name, one in found.items())
    section = Section("Comparison", said, [(png, CAPTIONS[chosen])], *table(rows, "bag"))
    return [section, definitions(rows.values())]


def _said(one: Analysed) -> str:
    left_out = f" {one.left_out[0].upper()}{one.left_out[1:]}." if one.left_out else ""
    return f"{one.recording.time.size:,} samples, one every {one.recording.sample_time * 1e3:g} ms.{left_out}"


def _difference(row: Figures, first: Figures) -> Figures:
    pairs = {quantity: (value, first.get(quantity)) for quantity, value in row.items()}
    return {q: None if a is None or b is None else a - b for q, (a, b) in pairs.items()}
