# SPDX-License-Identifier: Apache-2.0
"""Speed of the engine: against the same loop in C, over a long run, over many draws.

Each function returns rows ``{"name", "value", "unit", "reference", "ratio"}``; `reference` is what was
measured in the same run, `ratio` is value / reference.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_sim import engine
from piezo_sim.experiment import monte_carlo
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

ROOT = Path(__file__).resolve().parent.parent
PLAYS = 10
SAMPLES = 1_000_000
REPEATS = 5


class _Coefficients(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("plays", "relaxations", "order", "delay")),
        *(
            (name, ctypes.c_double * 64)
            for name in ("thresholds", "weights", "inverse_thresholds", "inverse_weights")
        ),
        *((name, ctypes.c_double) for name in ("voltage_limit", "step_limit")),
        ("a", ctypes.c_double * 256),
        ("b", ctypes.c_double * 16),
        ("c", ctypes.c_double * 16),
        ("d", ctypes.c_double),
        ("reference_b", ctypes.c_double * 16),
        ("reference_d", ctypes.c_double),
        ("anti_windup", ctypes.c_double * 16),
        *(
            (name, ctypes.c_double)
            for name in (
                "command_low",
                "command_high",
                "slope",
                "gain_per_degc",
                "lag_per_degc",
                "sensitivity",
                "body_retained",
                "creep_gain",
                "creep_gain_per_degc",
            )
        ),
        ("creep_retained", ctypes.c_double * 32),
        ("creep_released", ctypes.c_double * 32),
        *(
            (name, ctypes.c_double)
            for name in (
                "xx",
                "xv",
                "vx",
                "vv",
                "elastic_constant",
                "resolution",
                "noise",
                "dropout_rate",
                "amplifier_limit",
                "amplifier_change",
                "amplifier_retained",
            )
        ),
    ]


class _State(ctypes.Structure):
    _fields_ = [
        ("plays", ctypes.c_double * 64),
        ("inverse_plays", ctypes.c_double * 64),
        ("x", ctypes.c_double * 16),
        ("creep", ctypes.c_double * 32),
        ("line", ctypes.c_double * 64),
        *(
            (name, ctypes.c_double)
            for name in (
                "position",
                "speed",
                "body",
                "start",
                "applied",
                "last_voltage",
                "clipped",
            )
        ),
    ]


def compile_reference(folder: str) -> Any:
    """Compile bench/engine_reference.c with -O3 and return its function `run`.

    Raises RuntimeError when there is no C compiler.
    """
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("no C compiler (cc, gcc or $CC): the C reference cannot be built")
    library = Path(folder) / "engine_reference.so"
    source = Path(__file__).with_name("engine_reference.c")
    subprocess.run([compiler, "-O3", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
    return ctypes.CDLL(str(library)).run


def in_c(finger: engine.Finger) -> tuple[_Coefficients, _State]:
    """Return coefficients and initial state of a finger for the C reference."""
    plant, state = finger.plant, finger.plant_state
    tip = plant.tip
    c = _Coefficients(
        plays=len(plant.operator.weights),
        relaxations=len(plant.creep_retained),
        order=len(finger.feedback.c),
        delay=len(state.sensor) - 1,
        voltage_limit=finger.feedforward.voltage_limit,
        step_limit=finger.feedforward.step_limit,
        elastic_constant=tip.elastic_constant,
        amplifier_limit=plant.amplifier.limit,
        amplifier_change=plant.amplifier.change,
        amplifier_retained=plant.amplifier.retained,
        **tip.free._asdict(),
        **plant.sensor._asdict(),
    )
    inverse = finger.feedforward.inverse
    arrays = {
        "thresholds": plant.operator.thresholds,
        "weights": plant.operator.weights,
        "inverse_thresholds": inverse.thresholds,
        "inverse_weights": inverse.weights,
    }
    for name, value in {**plant._asdict(), **finger.feedback._asdict(), **arrays}.items():
        if isinstance(value, float):
            setattr(c, name, value)
        elif isinstance(value, np.ndarray):
            getattr(c, name)[: len(value)] = value
    return c, _State(body=state.body[0], start=state.body[1])


def loop_against_c() -> list[dict[str, Any]]:
    """Closed loop with 10 plays each way: samples per second of the engine and of C, best of five.

    Raises RuntimeError when the two disagree by more than 1e-12 m.
    """
    hysteresis = HysteresisParameters(
        thresholds=tuple(3.0 * i for i in range(PLAYS)),
        weights=(3e-7, *[4e-8] * (PLAYS - 1)),
    )
    finger = engine.finger_at_rest(
        CantileverParameters(hysteresis=hysteresis),
        FeedforwardParameters(hysteresis=hysteresis),
        _paper_controller(),
        22.0,
    )
    instants = np.arange(SAMPLES) * 1e-4
    random = np.random.default_rng(1)
    inputs = engine.Inputs(
        15e-6 * np.sin(2.0 * np.pi * 5.0 * instants),
        22.0 + 10.0 * np.sin(2.0 * np.pi * 0.1 * instants),
        1e-4 * np.sin(2.0 * np.pi * 1.0 * instants),
        random.standard_normal(SAMPLES),
        random.random(SAMPLES),
    )
    compiled = engine.compiled_loop()
    ours = engine.Outputs(*np.empty((5, SAMPLES)))
    theirs = engine.Outputs(*np.empty((5, SAMPLES)))
    with tempfile.TemporaryDirectory() as folder:
        reference = compile_reference(folder)
        seconds: tuple[list[float], list[float]] = ([], [])
        for _ in range(REPEATS):
            fresh = engine.copy_finger(finger)
            start = time.perf_counter()
            compiled(fresh, inputs, 0, 1, ours)
            seconds[0].append(time.perf_counter() - start)

            c, state = in_c(finger)
            pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (*inputs, *theirs)]
            start = time.perf_counter()
            reference(ctypes.byref(c), ctypes.byref(state), SAMPLES, *pointers)
            seconds[1].append(time.perf_counter() - start)
    difference = float(np.max(np.abs(ours.true_deflection - theirs.true_deflection)))
    if difference > 1e-12:
        raise RuntimeError(f"engine and C reference differ by {difference} m")
    best = [SAMPLES / min(s) for s in seconds]
    return [row("engine, closed loop, 10 plays each way", best[0], "samples/s", best[1])]


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
    loop = loop_against_c()
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
