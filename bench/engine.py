# SPDX-License-Identifier: Apache-2.0
"""Speed of the engine: compiled and as plain Python, over a long run, over many draws.

Each function returns rows ``{"name", "value", "unit", "reference", "ratio"}``; `reference` is what was
measured in the same run, `ratio` is value / reference.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_control.sequence import SAMPLE_TIME
from piezo_sim import engine
from piezo_sim.experiment import monte_carlo
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

ROOT = Path(__file__).resolve().parent.parent
PLAYS = 10
SAMPLES = 1_000_000
REPEATS = 5


def closed_loop() -> list[dict[str, Any]]:
    """Closed loop with 10 plays each way: samples per second, against those of the laws as plain Python."""
    hysteresis = HysteresisParameters(
        thresholds=tuple(3.0 * i for i in range(PLAYS)),
        weights=(3e-7, *[4e-8] * (PLAYS - 1)),
    )
    rates = []
    for compiled, samples in ((True, SAMPLES), (False, SAMPLES // 1000)):
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            engine.run(
                CantileverParameters(hysteresis=hysteresis),
                FeedforwardParameters(hysteresis=hysteresis),
                _paper_controller(),
                TemperatureParameters(),
                Profile([0.0, samples * SAMPLE_TIME], [0.0, 15e-6], linear=True),
                samples,
                compiled=compiled,
            )
            seconds.append(time.perf_counter() - start)
        rates.append(samples / min(seconds))
    return [row("engine, closed loop, 10 plays each way", rates[0], "samples/s", rates[1])]


def long_run(engine_rate: float) -> list[dict[str, Any]]:
    """Creep experiment: 40 V for 300 s at 10 kHz, against as many samples of the bare loop."""
    samples = 3_000_000
    plant = CantileverParameters()
    step = Profile([0.0], [40.0])
    engine.drive(plant, TemperatureParameters(), step, 1)
    start = time.perf_counter()
    engine.drive(plant, TemperatureParameters(), step, samples, every=100)
    seconds = time.perf_counter() - start
    return [row("creep experiment, 300 s at 10 kHz", seconds, "s", samples / engine_rate)]


def monte_carlo_study(engine_rate: float) -> list[dict[str, Any]]:
    """10,000 step responses with metrics on all cores, against their samples in the bare loop."""
    draws = 10_000
    study = monte_carlo.Study(feedback=_paper_controller())
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        monte_carlo.monte_carlo(study, draws, folder)
        seconds = time.perf_counter() - start
    bare = draws * study.samples / engine_rate
    return [row("Monte Carlo, 10,000 steps of 60 ms", seconds, "s", bare)]


def import_time() -> list[dict[str, Any]]:
    """Fresh interpreter to imported laws, as a node has to wait for them, against numpy alone."""
    best = {}
    for module in ("piezo_sim.engine", "numpy"):
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", f"import {module}"], check=True, cwd=ROOT)
            seconds.append(time.perf_counter() - start)
        best[module] = min(seconds)
    return [row("import of laws and engine", best["piezo_sim.engine"], "s", best["numpy"])]


def rows() -> list[dict[str, Any]]:
    """Return all rows."""
    loop = closed_loop()
    rate = loop[0]["value"]
    return [*loop, *long_run(rate), *monte_carlo_study(rate), *import_time()]


def _paper_controller() -> FeedbackParameters:
    return build(FeedbackParameters, load(ROOT / "params" / "feedback_paper.yaml", "feedback"))


def row(name: str, value: float, unit: str, reference: float) -> dict[str, Any]:
    """Return one row of bench.json."""
    ratio = value / reference
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}


if __name__ == "__main__":
    for line in rows():
        print(line)
