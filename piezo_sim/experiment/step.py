"""Experiment `step`: the paper's closing figure, from the bags to table, plots, metrics and report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from piezo_control.recording import read
from piezo_sim.experiment import plots
from piezo_sim.experiment.analysis import step_row, thermal_row
from piezo_sim.experiment.report import Section, cell, write_html
from piezo_sim.experiment.runner import Run

STEP_COLUMNS = {
    "settling_time_5pct_ms": ("settling to 5 % [ms]", 1),
    "overshoot_percent": ("overshoot [%]", 2),
    "static_error_percent": ("static error [%]", 2),
}
THERMAL_COLUMNS = {
    "temperature_change_degc": ("change of temperature [°C]", 1),
    "deflection_change_um": ("largest change of deflection [µm]", 3),
    "remaining_um": ("remaining change [µm]", 3),
}


def conclude(runs: Sequence[Run], out: Path, title: str) -> list[Section]:
    """Analyse the bags of `runs`; write metrics.json, PNGs and report.html; return the tables."""
    responses: dict[str, dict] = {}
    cases = []
    for run in runs[:-1]:
        recording = read(run.bag)
        degc = float(recording.temperature[0])
        responses.setdefault(run.case.mode, {})[f"{degc:g} °C"] = recording
        cases.append(
            {
                "name": run.case.name,
                "mode": run.case.mode,
                "controller": run.case.controller,
                "temperature_degc": degc,
                **step_row(recording),
                "bag": str(run.bag.relative_to(out)),
            }
        )
    thermal = runs[-1]
    warming = read(thermal.bag)
    thermal_step = {**thermal_row(warming), "bag": str(thermal.bag.relative_to(out))}
    loop = {
        "steps_per_second": sum(run.steps_per_second for run in runs) / len(runs),
        "processes": thermal.processes,
    }
    metrics = {"cases": cases, "thermal_step": thermal_step, "loop": loop}
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    sections = [
        Section(
            "Step of the reference",
            "Recorded from separate ROS 2 node processes; every figure is computed from the bags.",
            [(plots.steps(responses, out / "step.png"), "Response to a step of the reference.")],
            ["case", *(heading for heading, _ in STEP_COLUMNS.values())],
            [
                [case["name"], *(cell(case[key], d) for key, (_, d) in STEP_COLUMNS.items())]
                for case in cases
            ],
        ),
        Section(
            "Step of the temperature",
            "The finger holds its reference under feedback while it warms up.",
            [(plots.disturbance(warming, out / "thermal_step.png"), "Warm-up under feedback.")],
            ["case", *(heading for heading, _ in THERMAL_COLUMNS.values())],
            [
                [
                    thermal.case.name,
                    *(cell(thermal_step[key], d) for key, (_, d) in THERMAL_COLUMNS.items()),
                ]
            ],
        ),
    ]
    footer = f"{loop['processes']} node processes, {loop['steps_per_second']:.0f} loop steps/s."
    write_html(out / "report.html", title, sections, footer)
    return sections
