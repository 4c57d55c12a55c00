# SPDX-License-Identifier: Apache-2.0
"""All shipped controllers in one table: margins of the linear loop, and runs on both plants, cold and warm.

The linear loop is that of the box that `robust` was certified for. Runs are those of the finger with its
inverse hysteresis, for the truth plant the identified one; figures are computed from their bags, the tip being
where the sensor read it. Tracking is of sines of ±20 µm, once settled: after 0.1 s and half a cycle. Controllers
that follow a model run with the models under them that undo the temperature, as their certificates ask for.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import Progress

from piezo_control.design.certificate import Box, box_margins
from piezo_control.design.cli import read_problem
from piezo_control.feedback import read_controller
from piezo_control.metrics import step_metrics
from piezo_control.nodes.parameters import FeedforwardNodeParameters
from piezo_control.parameters import build, dump, flatten, load
from piezo_control.profile import Profile
from piezo_control.recording.recording import Recording, read
from piezo_control.report.page import Section
from piezo_control.sequence import SAMPLE_TIME
from piezo_sim.experiment.cases import Case, params_folder
from piezo_sim.experiment.on_engine import run_on_engine
from piezo_sim.plant.sensor import SensorParameters

FOLLOWING = ("following", "following_adapted")
CONTROLLERS = ("paper", "robust", "fast", "integrator_notch", "pid", *FOLLOWING)
PREVIEW_HZ = 150.0
PREVIEW = ", preview"
PREVIEWED = (f"robust{PREVIEW}", f"following{PREVIEW}")
STEP = 20e-6  # m
STEP_TIME = 0.08  # s
DEGC = (22.0, 32.0)
HERTZ = (1.0, 10.0, 100.0)
SETTLED = 0.1  # s
SIDES = (5, 3, 3, 1000)
"""Values of resonance, damping and gain, and frequencies, at which the linear loop is looked at."""
TEXT = (
    "Linear loop: nominal / worst finger of the box that 'robust' is certified for (resonance ±10 %, damping ratio "
    "×0.5 to ×2, gain −10 to +17 %). A second mode is survived wherever it lies, with up to 10 % static share, "
    "when the largest |K S| W is below 1. Runs: at 22 / 32 °C, 5 % of the step around the reference; on the "
    "truth plant with the inverse identified from its recordings. 'never': not within 80 ms. "
    "'following' and 'following_adapted' are certified for smaller boxes (resonance ±10 and ±3 %, gain ±10 and ±2 %), "
    "and run with the temperature undone."
)


def margins_of(controllers: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return figures of the linear loop, nominal / worst, by controller and quantity."""
    problem = read_problem(params_folder() / "synthesis_robust.yaml")
    box = Box(problem, *SIDES)
    middle = len(box.fingers.gain) // 2
    found = {}
    for name in controllers:
        controller = read_controller(name)
        figures = box.figures(controller)
        delays = np.array([m.delay_s for m in box_margins(box, controller)]) * 1e3

        # Figures are infinite, margins without meaning, where a finger is unstable.
        is_stable = bool(np.all(np.isfinite(figures.sensitivity_peak)))
        found[name] = {
            label: f"{values[middle]:.2f} / " + (f"{worst:.2f}" if is_stable else "unstable")
            for label, values, worst in (
                ("Ms", figures.sensitivity_peak, figures.sensitivity_peak.max()),
                ("effort |K S|", figures.effort_peak, figures.effort_peak.max()),
                ("noise gain", figures.noise_gain, figures.noise_gain.max()),
                ("second mode |K S| W", figures.unmodelled, figures.unmodelled.max()),
                ("delay margin [ms]", delays, delays.min()),
            )
        }
    return found


def cases(controller: str, plant: str, params: Path | None) -> Iterator[tuple[float, Case]]:
    """Yield frequency (Hz) and run of the sines at each temperature, a step being 0 Hz.

    With those of PREVIEWED the sines are known ahead.
    """
    for degc, hertz in itertools.product(DEGC, (0.0, *HERTZ)):
        length = STEP_TIME
        reference = Profile([0.0], [STEP])
        if hertz:
            length = SETTLED + 2.5 / hertz
            time = np.arange(0.0, length + 0.1, min(1e-3, 1e-2 / hertz))
            reference = Profile(time, STEP * np.sin(2.0 * np.pi * hertz * time), linear=True)
        yield (
            hertz,
            Case(
                name=f"{plant}_{controller.replace(', ', '_')}_{hertz:g}hz_{degc:g}degc",
                mode="feedback",
                controller=controller.removesuffix(PREVIEW),
                plant=plant,
                sample_time=SAMPLE_TIME,
                duration=length,
                reference=reference,
                tip_force=Profile([0.0], [0.0]),
                temperature={"profile": "constant", "base_degc": degc},
                engine=True,
                params=params,
                preview_band=PREVIEW_HZ if controller in PREVIEWED else 0.0,
            ),
        )


def tracking_error(recording: Recording, hertz: float) -> float:
    """Return the largest error (% of STEP) of the tip, once settled."""
    late = SensorParameters().delay_samples
    error = recording.deflection[late:] - recording.reference[:-late]
    settled = recording.time[:-late] >= SETTLED + 0.5 / hertz
    return 100.0 * float(np.max(np.abs(error[settled]))) / STEP


def temperature_undone(inverse: Path | None, out: Path) -> Path:
    """Write the parameters of `inverse`, its models to go on under a controller; return the folder."""
    given = load(inverse / "feedforward.yaml", "feedforward") if inverse else {}
    models = replace(build(FeedforwardNodeParameters, given), compensator="sensorless")
    out.mkdir(parents=True, exist_ok=True)
    dump(out / "feedforward.yaml", "feedforward", flatten(models))
    return out


def study(out: Path, inverses: Mapping[str, Path | None], progress: Progress) -> Section:
    """Run all controllers on the plants of `inverses`, which has the folder of each one's parameter files."""
    columns = [*CONTROLLERS, *PREVIEWED]
    linear = margins_of(CONTROLLERS)
    linear |= {name: linear[name.removesuffix(PREVIEW)] for name in PREVIEWED}
    rows = [[label, *(linear[c][label] for c in columns)] for label in linear["robust"]]
    for plant, params in inverses.items():
        cells: dict[str, dict[str, list[str]]] = {}
        undone = temperature_undone(params, out / "temperature_undone" / plant)
        for controller in columns:
            under = undone if controller.removesuffix(PREVIEW) in FOLLOWING else params
            for hertz, case in cases(controller, plant, under):
                recording = read(run_on_engine(case, out, "finger", progress).bag)
                for label, text in _figures(recording, hertz).items():
                    cells.setdefault(label, {}).setdefault(controller, []).append(text)
        for label, by_controller in cells.items():
            rows.append([f"{plant}: {label}", *(" / ".join(by_controller[c]) for c in columns)])
    return Section("Controllers, one table", TEXT, columns=["figure", *columns], rows=rows)


def _figures(recording: Recording, hertz: float) -> dict[str, str]:
    if hertz:
        return {f"{hertz:g} Hz, largest error [%]": f"{tracking_error(recording, hertz):.2f}"}
    step = step_metrics(recording.time, recording.deflection, STEP)
    settling = step.settling_5_reference_s * 1e3
    return {
        "settling [ms]": f"{settling:.1f}" if np.isfinite(settling) else "never",
        "overshoot [%]": f"{step.overshoot * 100:.2f}",
    }
