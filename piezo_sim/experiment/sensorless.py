# SPDX-License-Identifier: Apache-2.0
"""What each model of the sensorless feedforward is worth, on a finger known from recordings alone.

The finger is excited (`experiment identification`) and identified by the commands of docs/sensorless.md,
through its sensor. Then steps, holds and sines run without the sensor: with the inverse hysteresis alone,
with vibration, creep and heat added one by one, and with a controller beside. Figures are computed from the
bags, from the tip as the sensor read it: in % of the stroke of 40 µm, for the step of its 20 µm. With all
models the finger is led over topics, by the nodes; for the stages before, and for the controller, the engine
writes the bags.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from piezo_control.creep import CreepParameters
from piezo_control.identification import cli as identify
from piezo_control.nodes.parameters import FeedforwardNodeParameters
from piezo_control.parameters import build, dump, flatten, load
from piezo_control.profile import Profile
from piezo_control.recording.recording import Recording, read
from piezo_control.report.page import Section
from piezo_control.sensorless import SensorlessParameters
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.shaping import ShapingParameters, ahead, shaper
from piezo_control.thermal import ThermalParameters
from piezo_sim.experiment import plots
from piezo_sim.experiment import study as command_line
from piezo_sim.experiment.cases import Case, RunFailed, read_experiment
from piezo_sim.experiment.cli import run_all
from piezo_sim.experiment.on_engine import run_on_engine
from piezo_sim.plant.sensor import SensorParameters

PLANTS = ("prandtl_ishlinskii", "truth")
CONTROLLER = "robust"
SLOW = 2e-2  # s, sample time of a hold of minutes without a controller
STEP = 20e-6  # m
STROKE = 2.0 * STEP
HOLD = 300.0  # s
START = 0.1  # s, of a sine
CYCLE = 1.0  # s, of the sine before a step, which makes the hysteresis forget the first rise
COLD, WARM = 22.0, 32.0  # °C
TEXT = (
    "Models identified from recordings of the finger, and no sensor in the loop; largest errors, as the sensor "
    "read the tip. With heat, the last of the models, from node processes over topics in lock-step; the stages "
    f"before and the controller '{CONTROLLER}' from the engine. Step and hold follow a cycle of a sine, sines "
    "start from rest; without a controller they are known ahead by the shaper's delay."
)
NO_CREEP = CreepParameters(gain=0.0, gain_per_degc=0.0)
NO_HEAT = ThermalParameters(sensitivity=0.0, gain_per_degc=0.0, lag_per_degc=0.0)
NO_FORCE = Profile([0.0], [0.0])
ALL_MODELS = "+ heat"


# --- models ---------------------------------------------------------------------------------------


def identified(plant: str, out: Path) -> FeedforwardNodeParameters:
    """Excite a finger on the engine, identify it by the commands, and return what the feedforward loads.

    Bags and parameter files go to `out`. The limits of the voltage are those of the paper's amplifier.
    """
    _, cases = read_experiment("identification", {"plant": plant, "engine": True})
    with Progress(disable=True) as progress:
        bags = {c.name: str(run_on_engine(c, out, "finger", progress).bag) for c in cases}
    drifting = [bag for name, bag in bags.items() if not name.startswith("vibration")]
    with (out / "identify.log").open("w") as log, contextlib.redirect_stdout(log):
        for words in (
            # The last loops are the smallest, which no others tell: nothing is held back.
            [*"hysteresis --model classical --plays 16 --hold-back 0".split(), bags["loop_22degc"]],
            ["dynamics", "--modes", "1", bags["vibration_22degc"]],
            ["drift", *drifting],
        ):
            if identify.main([*words, "--out", str(out)]):
                raise RunFailed(f"identify {words[0]} failed on plant '{plant}'")
    path = out / "feedforward.yaml"
    return build(FeedforwardNodeParameters, load(path, "feedforward"), str(path))


def stages(models: SensorlessParameters) -> Iterator[tuple[str, SensorlessParameters]]:
    """Yield the models one after the other: hysteresis, and what is added to it."""
    alone = replace(models, creep=NO_CREEP, thermal=NO_HEAT, shaping=ShapingParameters(kind="none"))
    yield "hysteresis", alone
    yield "+ vibration", replace(alone, shaping=models.shaping)
    yield "+ creep", replace(alone, shaping=models.shaping, creep=models.creep)
    yield ALL_MODELS, models


# --- what is asked of the tip -----------------------------------------------------------------------


@dataclass(frozen=True)
class Task:
    """Where the tip has to be over time (s, m), from when on that counts, and how warm it is meanwhile."""

    name: str
    wanted: Profile
    begin: float
    duration: float
    temperature: Mapping[str, Any]
    unit: float = STROKE  # m, that is 100 %
    is_known_ahead: bool = False
    is_slow: bool = False

    def case(self, mode: str, models: SensorlessParameters, folder: Path) -> Case:
        """Return the run in `mode`, with the parameter files in `folder`."""
        is_slow = self.is_slow and mode == "sensorless"
        sample_time = SLOW if is_slow else SAMPLE_TIME
        reference = self.wanted
        if self.is_known_ahead and mode == "sensorless":
            taps = shaper(models.shaping, models.dynamics.denominator, sample_time)
            reference = ahead(self.wanted, self.begin, self.duration, taps, sample_time)
        return Case(
            name=f"{folder.name}_{self.name}",
            mode=mode,
            controller=CONTROLLER if mode == "feedback" else "none",
            plant=folder.parent.name,
            sample_time=sample_time,
            duration=self.duration,
            reference=reference,
            tip_force=NO_FORCE,
            temperature=self.temperature,
            experiment="sensorless",
            every=1 if is_slow or self.duration < 2.0 else 10 if self.duration < HOLD else 100,
            params=folder,
        )

    def error(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        """Return time (s) and error (%) of the tip, from `begin` on."""
        # A reading is one of the tip `delay_samples` before.
        spacing = float(np.min(np.diff(recording.number)))
        late = recording.sample_time / spacing * SensorParameters().delay_samples
        time = recording.time - late
        error = 100.0 * (recording.deflection - self.wanted.at(time)) / self.unit
        counts = time >= self.begin - 1e-9
        return time[counts], error[counts]


def constant(degc: float) -> dict[str, Any]:
    """Return a temperature that stays."""
    return {"profile": "constant", "base_degc": degc}


def warming(start: float, duration: float) -> dict[str, Any]:
    """Return the way from COLD to WARM, in s."""
    return {
        "profile": "ramp",
        "base_degc": COLD,
        "amplitude_degc": WARM - COLD,
        "start": start,
        "duration": duration,
    }


def after_a_cycle(rise: float) -> Profile:
    """Return one cycle of a sine, a rest, and STEP from then on, reached within `rise` (s)."""
    time = np.arange(0.0, CYCLE, 1e-3)
    sine = STEP * np.sin(2.0 * np.pi * time / CYCLE)
    until = 1.1 * CYCLE
    return Profile([*time, CYCLE, until, until + rise], [*sine, 0.0, 0.0, STEP], linear=True)


def sine(frequency_hz: float) -> Profile:
    """Return three cycles of a sine of STEP that start from rest after START s."""
    time = np.linspace(0.0, 3.0 / frequency_hz, 3001)
    value = STEP * np.sin(2.0 * np.pi * frequency_hz * time)
    return Profile(START + time, value, linear=True)


def tasks() -> Iterator[Task]:
    """Yield step, holds and sines, cold, warm and on the way."""
    end = 1.1 * CYCLE
    yield Task("step_22degc", after_a_cycle(1e-9), end + 2e-3, end + 0.2, constant(COLD), STEP)
    for name, temperature in (
        ("22degc", constant(COLD)),
        ("32degc", constant(WARM)),
        ("22_to_32degc", warming(10.0, 60.0)),
    ):
        # The voltage rises within 0.2 s, so that nothing vibrates between two slow samples.
        hold = after_a_cycle(0.2)
        yield Task(f"hold_{name}", hold, end + 0.3, end + 0.3 + HOLD, temperature, is_slow=True)
    for degc in (COLD, WARM):
        for hertz in (1.0, 10.0, 50.0):
            name = f"{hertz:g}hz_{degc:g}degc"
            wanted = sine(hertz)
            end = float(wanted.time[-1])
            yield Task(name, wanted, 0.0, end, constant(degc), is_known_ahead=True)


# --- the study ------------------------------------------------------------------------------------


def models_folder(out: Path, plant: str, stage: str) -> Path:
    """Return the folder of the parameter file of a stage, by the last of its models."""
    return out / "models" / plant / stage.removeprefix("+ ")


def cases(plant: str, models: FeedforwardNodeParameters, out: Path) -> dict[str, dict[str, Case]]:
    """Return the runs of each stage by name of the task; their parameter files go below `out`."""
    found: dict[str, dict[str, Case]] = {}
    for stage, parameters in [*stages(models), (CONTROLLER, models)]:
        mode = "feedback" if stage == CONTROLLER else "sensorless"
        found[stage] = {}
        for task in tasks():
            shown = parameters
            folder = models_folder(out, plant, stage)
            if task.is_slow and mode == "sensorless":
                # Between two slow samples any vibration fades: there is nothing to shape.
                shown = replace(parameters, shaping=ShapingParameters(kind="none"))
                folder = folder.with_name(f"{folder.name}_slow")
            folder.mkdir(parents=True, exist_ok=True)
            dump(folder / "feedforward.yaml", "feedforward", flatten(shown))
            case = task.case(mode, shown, folder)
            found[stage][task.name] = replace(
                case, name=f"{plant}_{case.name}", engine=stage != ALL_MODELS
            )
    return found


def study(
    out: Path, namespace: str, progress: Progress, is_on_nodes: bool = True
) -> tuple[dict[str, dict[str, dict[str, float]]], list[Section]]:
    """Identify both plants and run all stages; return the largest errors (%) and a section for each plant."""
    wanted = {
        plant: cases(plant, identified(plant, out / "identified" / plant), out) for plant in PLANTS
    }
    listed = [
        replace(case, engine=case.engine or not is_on_nodes)
        for by_stage in wanted.values()
        for by_task in by_stage.values()
        for case in by_task.values()
    ]
    runs = {run.case.name: run for run in run_all(listed, out, namespace, progress)}
    found: dict[str, dict[str, dict[str, float]]] = {}
    sections = []
    for plant, by_stage in wanted.items():
        errors = {
            stage: {
                task.name: task.error(read(runs[by_task[task.name].name].bag)) for task in tasks()
            }
            for stage, by_task in by_stage.items()
        }
        found[plant] = {
            stage: {name: float(np.max(np.abs(e))) for name, (_, e) in by_task.items()}
            for stage, by_task in errors.items()
        }
        sections.append(page(plant, errors, found[plant], out))
    return found, sections


def page(
    plant: str,
    errors: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    largest: Mapping[str, Mapping[str, float]],
    out: Path,
) -> Section:
    """Return table and picture of one plant."""
    shown = (
        "step_22degc",
        "hold_32degc",
        "hold_22_to_32degc",
        "1hz_22degc",
        "1hz_32degc",
        "50hz_22degc",
    )
    panels = {name: {stage: errors[stage][name] for stage in errors} for name in shown}
    picture = plots.errors(panels, out / f"sensorless_{plant}.png")
    rows = [
        [
            task.name.replace("_", " "),
            *(f"{by_task[task.name]:.2f}" for by_task in largest.values()),
        ]
        for task in tasks()
    ]
    caption = "Error of the tip, models added one by one, and beside them under feedback."
    columns = ["largest error [%]", *largest]
    return Section(f"Without a sensor, plant {plant}", TEXT, [(picture, caption)], columns, rows)


def work(
    arguments: argparse.Namespace, out: Path, console: Console
) -> tuple[dict[str, Any], Sequence[Section]]:
    """Do the study into the folder `out`."""
    with Progress(console=console) as progress:
        return study(out, "finger", progress, not arguments.engine)


def main() -> int:
    """Run the command line and return its exit code."""
    parser = command_line.parser("piezo_sim.experiment.sensorless", __doc__)
    parser.add_argument("--engine", action="store_true", help="all on the engine, without nodes")
    return command_line.run(parser.parse_args(), "Without a sensor", work)


if __name__ == "__main__":
    sys.exit(main())
