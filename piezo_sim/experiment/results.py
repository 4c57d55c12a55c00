# SPDX-License-Identifier: Apache-2.0
"""What an experiment has shown: figures of merit of every case, as tables, plots and metrics.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from piezo_control.files import write_json
from piezo_control.parameters import flatten, provenance
from piezo_control.recording.recording import BagError, Recording, read
from piezo_control.report.page import Section, cell
from piezo_sim.experiment import plots
from piezo_sim.experiment.analysis import QUANTITIES, Figures, analyse
from piezo_sim.experiment.cases import NODES, Case, CaseRun, parameter_files

MODE_TITLES = {
    "open_loop": "open loop (static gain)",
    "feedforward": "feedforward (inverse hysteresis)",
    "sensorless": "feedforward (hysteresis, vibration, creep and heat)",
}
HEADINGS = {
    "transient": "Step of the voltage (Fig. 3)",
    "creep": "Creep (Fig. 4)",
    "hysteresis": "Hysteresis (Fig. 5)",
    "excite": "Excitation for identification",
    "feedforward": "Feedforward alone (Fig. 9)",
    "step": "Step of the reference (Fig. 13)",
    "frequency": "Frequency response (Fig. 14)",
    "thermal": "Change of the temperature while holding",
    "force": "Force on the tip while holding",
    "hold": "Holding",
}
CAPTIONS = {
    "transient": "Deflection after a step of the voltage from rest.",
    "creep": "Deflection after a step of the voltage, over minutes.",
    "hysteresis": "Last cycle of deflection over voltage.",
    "excite": "Deflection over voltage, every cycle.",
    "feedforward": "Last cycle of deflection over reference, through the inverse hysteresis.",
    "step": "Response to a step of the reference.",
    "frequency": "Magnitude from the reference to the deflection.",
    "thermal": "Temperature, deflection from the value held before, and voltage.",
    "force": "Tip force, deflection from the value held before, and voltage.",
    "hold": "Deflection where nothing is asked of it but to stay.",
}
DRIVEN_BY_VOLTAGE = ("transient", "creep", "hysteresis", "excite")
LONGEST_ARRAY = 4  # that a report shows element by element
CLOSED_LOOP_AXIS = 0.045  # s: time axis of Fig. 13


@dataclass(frozen=True)
class Result:
    """A case that was run, its recording as read from the bag, and its figures."""

    run: CaseRun
    recording: Recording
    figures: Figures

    @property
    def panel(self) -> str:
        """Title of the panel that a plot shows the case in: how the finger was driven."""
        case = self.run.case
        if case.mode == "feedback":
            return f"feedforward and feedback: {case.controller}"
        if case.analysis in DRIVEN_BY_VOLTAGE:
            return "voltage applied as it is"
        return MODE_TITLES[case.mode]

    @property
    def label(self) -> str:
        """Legend entry: the temperature, where it is constant."""
        degc = self.recording.temperature
        return f"{degc[0]:g} °C" if np.ptp(degc) == 0 else "deflection"


def result(run: CaseRun) -> Result:
    """Read and analyse the bag of a run; raise BagError naming the bag."""
    recording = read(run.bag)
    try:
        return Result(run, recording, analyse(recording, run.case.analysis))
    except BagError as error:
        raise BagError(f"{run.bag}: {error}") from None


def sections(results: Sequence[Result], out: Path) -> list[Section]:
    """Return one section per experiment and kind of analysis, with plots written to `out`."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for entry in results:
        case = entry.run.case
        groups.setdefault((case.experiment, case.analysis), []).append(entry)
    return [
        Section(
            HEADINGS[kind],
            _origin(group),
            figures(
                group, kind, out / f"{experiment}_{kind}" if kind != experiment else out / kind
            ),
            *table({r.run.case.name: r.figures for r in group}, "case"),
            links={r.run.case.name: f"{r.run.bag.relative_to(out)}/" for r in group},
        )
        for (experiment, kind), group in groups.items()
    ]


def definitions(figures: Iterable[Figures]) -> Section:
    """Return a section that says what each quantity is that the `figures` have."""
    shown = set().union(*figures)
    rows = [[q.heading, q.definition] for name, q in QUANTITIES.items() if name in shown]
    return Section("Definitions", columns=["figure", "what it is"], rows=rows, is_appendix=True)


def parameters(cases: Sequence[Case]) -> Section:
    """Return a section with the parameters of the cases' nodes that are not the defaults."""
    users: dict[tuple[str, str, str], list[str]] = {}
    for case in cases:
        for node, given in case.parameters().items():
            default = flatten(NODES[node]())
            for name, value in flatten(given).items():
                if value != default[name]:
                    users.setdefault((node, name, _shown(value)), []).append(case.name)
    rows = [
        [f"{node}: {name}", value, "all" if len(used) == len(cases) else ", ".join(used)]
        for (node, name, value), used in sorted(users.items())
    ]
    return Section(
        "Parameters that are not the defaults",
        columns=["parameter", "value", "cases"],
        rows=rows,
        is_appendix=True,
    )


def origins(cases: Sequence[Case]) -> Section:
    """Return a section that says where the parameters of the cases come from, as their files have it."""
    paths = dict.fromkeys(path for case in cases for path in parameter_files(case))
    rows = [["everything else", "the paper's finger (Rakotondrabe, Diouf, Lutz, IFAC 2008)"]]
    for path in paths:
        words = provenance(path) or ["written by hand: its head names no tool"]
        rows += [[path.name if index == 0 else "", line] for index, line in enumerate(words)]
    return Section(
        "Where the parameters come from", columns=["file", "of what"], rows=rows, is_appendix=True
    )


def _shown(value: Any) -> str:
    is_long = isinstance(value, tuple) and len(value) > LONGEST_ARRAY
    return f"{len(value)} values from {value[0]:g} to {value[-1]:g}" if is_long else str(value)


def figures(results: Sequence[Result], kind: str, path: Path) -> list[tuple[Path, str]]:
    """Draw results of one kind; return PNG files, named after `path`, with captions."""
    panels: dict[str, dict[str, list[Recording]]] = {}
    closed: dict[str, dict[str, list[Recording]]] = {}
    for entry in results:
        for group in (panels, closed) if entry.run.case.mode == "feedback" else (panels,):
            group.setdefault(entry.panel, {}).setdefault(entry.label, []).append(entry.recording)
    drawn = [(plots.PLOTS[kind](panels, path.with_suffix(".png")), CAPTIONS[kind])]
    if kind == "step" and closed and closed != panels:
        closer = path.with_name(f"{path.name}_closed_loop.png")
        caption = "The closed loop alone, in the axes of Fig. 13."
        drawn.insert(0, (plots.step(closed, closer, CLOSED_LOOP_AXIS), caption))
    return drawn


def table(rows: Mapping[str, Figures], name: str) -> tuple[list[str], list[list[str]]]:
    """Return headings and cells of a table with a row per entry and a column per quantity."""
    shown = [q for q in QUANTITIES if any(q in row for row in rows.values())]
    headings = [name, *(QUANTITIES[q].heading for q in shown)]
    cells = [
        [title, *(cell(row.get(q), QUANTITIES[q].digits) for q in shown)]
        for title, row in rows.items()
    ]
    return headings, cells


def _origin(results: Sequence[Result]) -> str:
    on_engine = results[0].run.case.engine
    steps = sum(r.run.case.samples for r in results)
    if on_engine:
        return f"From the engine, the same step functions in one process ({steps} samples)."
    return (
        f"From {results[0].run.processes} separate ROS 2 node processes over topics, in lock-step "
        f"({steps} samples)."
    )


def metrics(results: Sequence[Result], out: Path) -> dict[str, Any]:
    """Return the content of metrics.json: all cases, and how fast the nodes ran.

    The warm-up at the end of the experiment `step` stands apart, as `thermal_step`, that of further
    controllers among the cases.
    """
    rows = [
        {
            "name": r.run.case.name,
            "experiment": r.run.case.experiment,
            "mode": r.run.case.mode,
            "controller": r.run.case.controller,
            "plant": r.run.case.plant,
            "from": "engine" if r.run.case.engine else "nodes",
            "temperature_degc": float(r.recording.temperature[0]),
            **r.figures,
            "bag": str(r.run.bag.relative_to(out)),
        }
        for r in results
    ]
    warm_ups = [
        r for r in rows if r["experiment"] == "step" and str(r["name"]).startswith("thermal_")
    ]
    content: dict[str, Any] = {"cases": rows}
    if warm_ups:
        content = {"cases": [r for r in rows if r != warm_ups[0]], "thermal_step": warm_ups[0]}
    speeds = [r.run.steps_per_second for r in results if not r.run.case.engine]
    if speeds:
        content["loop"] = {
            "steps_per_second": float(np.mean(speeds)),
            "processes": max(r.run.processes for r in results),
        }
    return content


def write_metrics(content: Mapping[str, Any], out: Path) -> None:
    """Write metrics.json to `out`."""
    write_json(out / "metrics.json", content)


def footer(content: Mapping[str, Any], bags: int) -> str:
    """Return the last line of a report."""
    text = f"Every figure is computed from the {bags} recorded bags."
    if "loop" in content:
        loop = content["loop"]
        text += f" {loop['processes']} node processes, {loop['steps_per_second']:.0f} loop steps/s."
    return text
