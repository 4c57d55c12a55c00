# SPDX-License-Identifier: Apache-2.0
"""What each model of the sensorless feedforward is worth, on a finger known from recordings alone.

The finger is excited and identified as on a bench: a decaying sine (hysteresis), steps of the voltage held
for 300 s at two temperatures and a warm-up at 0 V (creep and heat), all read through its sensor. Then steps,
holds and sines run without the sensor: with the inverse hysteresis alone, and with vibration, creep and heat
added one by one. Errors are those of the true tip, in % of the stroke of 40 µm for sines and of the step of
20 µm else.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from piezo_control.creep import CreepParameters
from piezo_control.identification.drift import identify_drift
from piezo_control.identification.excitation import decaying_sine
from piezo_control.identification.hysteresis import equal_thresholds, identify_hysteresis
from piezo_control.identification.measurement import Measurement
from piezo_control.profile import Profile
from piezo_control.sensorless import SensorlessParameters
from piezo_control.shaping import ShapingParameters, delay, shaper
from piezo_control.thermal import ThermalParameters
from piezo_sim.engine import drive, run_sensorless
from piezo_sim.experiment.report import Section, print_table, write_html
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

PLANTS = ("prandtl_ishlinskii", "truth")
SAMPLE_TIME = 1e-4  # s
STEP = 20e-6  # m
STEPS_AT = 1.1  # s
HOLD = 300.0  # s
STROKE = 2.0 * STEP
COLD, WARM = 22.0, 32.0  # °C
PLAYS = 16
SLOW = 1e-2  # s, sample time of the recordings for creep and heat
QUICK = 1e-3  # s, of the one for hysteresis
TEXT = (
    "Computed by the engine, not from bags: models identified from recordings of the finger, and no sensor "
    "in the loop. Errors of the true tip; "
    "step and hold follow one cycle of a sine, sines start from rest and are known ahead by the delay."
)
NO_CREEP = CreepParameters(gain=0.0, gain_per_degc=0.0)
NO_HEAT = ThermalParameters(sensitivity=0.0, gain_per_degc=0.0, lag_per_degc=0.0)


def constant(degc: float) -> TemperatureParameters:
    """Return a temperature that stays."""
    return TemperatureParameters(base_degc=degc)


def warming(start: float, duration: float) -> TemperatureParameters:
    """Return the way from COLD to WARM, in s."""
    return TemperatureParameters(
        profile="ramp", base_degc=COLD, amplitude_degc=WARM - COLD, start=start, duration=duration
    )


def recorded(
    plant: CantileverParameters,
    sample_time: float,
    voltage: Profile,
    temperatures: TemperatureParameters,
    duration: float,
) -> Measurement:
    """Return what a recorder keeps of the bare finger under `voltage`."""
    got = drive(
        replace(plant, sample_time=sample_time),
        temperatures,
        voltage,
        round(duration / sample_time),
    )
    # Sample k of the deflection is read a sample late and before voltage k acts.
    late = 1 + plant.sensor.delay_samples
    return Measurement(
        "engine", got.time[late:], got.voltage[:-late], got.deflection[late:],
        got.temperature[:-late], None, got.number[late:],
    )  # fmt: skip


def identified(plant: CantileverParameters) -> SensorlessParameters:
    """Return the models of a finger from recordings of it; its resonance is taken as known."""
    sine = recorded(plant, QUICK, decaying_sine(40.0), constant(COLD), 20.0)
    hysteresis = identify_hysteresis(sine, equal_thresholds(sine, PLAYS), lag=0.0).parameters
    step = Profile([0.0, 1.0], [0.0, 40.0])
    drifting = [recorded(plant, SLOW, step, constant(degc), 300.0) for degc in (COLD, WARM)]
    drifting.append(recorded(plant, SLOW, Profile([0.0], [0.0]), warming(2.0, 5.0), 20.0))
    drift = identify_drift(drifting, hysteresis)
    return SensorlessParameters(
        slew_limit=plant.amplifier.slew_limit,
        hysteresis=hysteresis,
        dynamics=plant.dynamics,
        creep=CreepParameters(
            drift.creep_gain, drift.creep_gain_per_degc, drift.creep_times, drift.creep_shares
        ),
        thermal=ThermalParameters(
            drift.sensitivity, drift.time_constant, drift.gain_per_degc, lag_per_degc=0.0
        ),
    )


def stages(models: SensorlessParameters) -> Iterator[tuple[str, SensorlessParameters]]:
    """Yield the models one after the other: hysteresis, and what is added to it."""
    alone = replace(models, creep=NO_CREEP, thermal=NO_HEAT, shaping=ShapingParameters(kind="none"))
    yield "hysteresis", alone
    yield "+ vibration", replace(alone, shaping=models.shaping)
    yield "+ creep", replace(alone, shaping=models.shaping, creep=models.creep)
    yield "+ heat", models


def late(models: SensorlessParameters) -> float:
    """Return by how much (s) a finger under these models comes late, held sample and shaper."""
    taps = shaper(models.shaping, models.dynamics.denominator, SAMPLE_TIME)
    return delay(taps, SAMPLE_TIME) + SAMPLE_TIME


def step_error(plant: CantileverParameters, models: SensorlessParameters) -> float:
    """Return the largest error from 2 ms after a step on (m), at COLD."""
    got = run_sensorless(plant, models, constant(COLD), after_a_cycle(), round(1.3 / SAMPLE_TIME))
    return float(np.max(np.abs(got.true_deflection - STEP)[got.time >= STEPS_AT + 2e-3]))


def hold_error(
    plant: CantileverParameters, models: SensorlessParameters, temperatures: TemperatureParameters
) -> float:
    """Return the largest error (m) in HOLD seconds after a step, from 50 ms on."""
    samples = round((STEPS_AT + HOLD) / SAMPLE_TIME)
    got = run_sensorless(plant, models, temperatures, after_a_cycle(), samples, every=10)
    return float(np.max(np.abs(got.true_deflection - STEP)[got.time >= STEPS_AT + 0.05]))


def sine_error(
    plant: CantileverParameters, models: SensorlessParameters, frequency_hz: float, degc: float
) -> float:
    """Return the largest error (m) over three cycles of a sine from rest, known ahead by the delay."""
    time = np.arange(round((0.1 + 3.0 / frequency_hz) / SAMPLE_TIME)) * SAMPLE_TIME

    def wanted(instant: np.ndarray) -> np.ndarray:
        return STEP * np.sin(2.0 * np.pi * frequency_hz * np.maximum(instant - 0.1, 0.0))

    ahead = Profile(time, wanted(time + late(models)))
    got = run_sensorless(plant, models, constant(degc), ahead, len(time))
    return float(np.max(np.abs(got.true_deflection - wanted(got.time))))


def after_a_cycle() -> Profile:
    """Return one cycle of a sine, which makes the hysteresis forget the first rise, and then a step."""
    time = np.arange(0.0, 1.0, 1e-3)
    return Profile([*time, STEPS_AT], [*(STEP * np.sin(2.0 * np.pi * time)), STEP])


def errors(
    plant: CantileverParameters, models: SensorlessParameters
) -> Iterator[tuple[str, float]]:
    """Yield the name and value (%) of each error, with the hold and the sines relative to the stroke."""
    yield "step, after 2 ms [% of step]", 100.0 * step_error(plant, models) / STEP
    for name, temperatures in (
        (f"{COLD:g} °C", constant(COLD)),
        (f"{WARM:g} °C", constant(WARM)),
        (f"{COLD:g} to {WARM:g} °C", warming(10.0, 60.0)),
    ):
        error = hold_error(plant, models, temperatures)
        yield f"hold {HOLD:g} s, {name} [% of stroke]", 100.0 * error / STROKE
    for degc in (COLD, WARM):
        for frequency in (1.0, 10.0, 50.0):
            error = sine_error(plant, models, frequency, degc)
            yield f"{frequency:g} Hz, {degc:g} °C [% of stroke]", 100.0 * error / STROKE


def study() -> tuple[dict[str, dict[str, dict[str, float]]], list[Section]]:
    """Identify both plants and run all stages; return the errors (%) and a table for each plant."""
    found = {}
    sections = []
    for kind in PLANTS:
        plant = CantileverParameters(plant=kind)
        models = identified(plant)
        by_stage = {name: dict(errors(plant, stage)) for name, stage in stages(models)}
        names = list(next(iter(by_stage.values())))
        rows = [[n, *(f"{stage[n]:.2f}" for stage in by_stage.values())] for n in names]
        title = f"Without a sensor, plant {kind}"
        sections.append(Section(title, TEXT, columns=["largest error", *by_stage], rows=rows))
        found[kind] = by_stage
    return found, sections


def main() -> int:
    """Run the command line: write metrics.json and report.html, print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m piezo_sim.experiment.sensorless", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--out", type=Path, default=Path("out/sensorless"))
    out = parser.parse_args().out
    found, sections = study()
    out.mkdir(parents=True, exist_ok=True)
    (out / "metrics.json").write_text(json.dumps(found, indent=2, ensure_ascii=False))
    write_html(out / "report.html", "Without a sensor", sections)
    for section in sections:
        print_table(Console(), section)
    return 0


if __name__ == "__main__":
    sys.exit(main())
