# SPDX-License-Identifier: Apache-2.0
"""Runs cases on the engine, in this process, and writes the bag that the recorder would have written."""

from __future__ import annotations

import time
from pathlib import Path

from rich.progress import Progress

from piezo_control.recording.writer import write_recording
from piezo_sim import engine
from piezo_sim.experiment.cases import Case, CaseRun


def run_on_engine(case: Case, out: Path, finger: str, progress: Progress) -> CaseRun:
    """Run one case; its bag goes to `out`/bags."""
    bag = out / "bags" / case.name
    task = progress.add_task(f"{case.name} (engine)", total=case.samples)
    parameters = case.parameters(bag)
    begin = time.monotonic()
    temperature, tip_force = parameters["temperature"], case.tip_force
    plant, feedforward = parameters["cantilever"], parameters["feedforward"]
    if feedforward.compensator == "sensorless" and case.mode == "feedback":
        made, _ = engine.run_led(
            plant, parameters["feedback"], feedforward, temperature, case.reference, case.samples,
            case.samples, tip_force, case.every,
        )  # fmt: skip
    elif feedforward.compensator == "sensorless":
        made = engine.run_sensorless(
            plant, feedforward, temperature, case.reference, case.samples, tip_force, case.every
        )
    else:
        made = engine.run(
            plant, feedforward, parameters["feedback"], temperature, case.reference, case.samples,
            tip_force, case.every,
        )  # fmt: skip
    seconds = time.monotonic() - begin
    bag.parent.mkdir(parents=True, exist_ok=True)
    write_recording(bag, finger, made, case.reference, case.tip_force)
    progress.update(task, completed=case.samples)
    return CaseRun(case, bag, case.samples / seconds, processes=1)
