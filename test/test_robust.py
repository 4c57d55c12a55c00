# SPDX-License-Identifier: Apache-2.0
"""The shipped `robust` controller on the nonlinear finger: hysteresis, creep, heat, sensor and delay."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import settling_time, step_metrics
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_sim.engine import run
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

PARAMS = Path(__file__).resolve().parents[1] / "params"
ROBUST = build(FeedbackParameters, load(PARAMS / "feedback_robust.yaml", "feedback"))
FEEDFORWARD = FeedforwardParameters()
NOMINAL = CantileverParameters()
STEP_AT = 50
BOX = list(itertools.product((0.9, 1.0, 1.1), (0.5, 2.0), (0.9, 1.0, 1.1)))


def finger(resonance: float = 1.0, damping: float = 1.0, gain: float = 1.0) -> CantileverParameters:
    """A finger off the nominal one; the feedforward does not know."""
    a2, a1, _ = NOMINAL.dynamics.denominator
    moved = (a2 / resonance**2, a1 * damping / resonance, 1.0)
    weights = tuple(gain * weight for weight in NOMINAL.hysteresis.weights)
    return replace(
        NOMINAL,
        dynamics=replace(NOMINAL.dynamics, denominator=moved),
        hysteresis=replace(NOMINAL.hysteresis, weights=weights),
    )


def step_response(plant: CantileverParameters, degc: float, height: float):
    profile = Profile([0.0, STEP_AT * NOMINAL.sample_time], [0.0, height])
    temperatures = TemperatureParameters(base_degc=degc)
    done = run(plant, FEEDFORWARD, ROBUST, temperatures, profile, STEP_AT + 1000)
    time = done.time[STEP_AT:] - done.time[STEP_AT]
    return step_metrics(time, done.deflection[STEP_AT:], height)


def test_rate_delay_and_resolution_are_those_asked_for():
    assert NOMINAL.sample_time == 1e-4
    assert NOMINAL.sensor.delay_samples == 1
    assert NOMINAL.sensor.resolution == 10e-9


@pytest.mark.parametrize("degc", [22.0, 32.0])
def test_full_step(degc):
    # 20 µm as in Fig. 13 of the paper; the specification is the paper's.
    found = step_response(finger(), degc, 20e-6)
    assert found.settling_5_reference_s <= 10e-3
    assert found.overshoot <= 0.005
    assert found.static_error <= 0.0005


@pytest.mark.parametrize("degc", [22.0, 32.0])
def test_worst_case_of_the_box(degc):
    # 18 µm: with a gain 10 % too small 20 µm are out of reach of 40 V. The limits are those of the
    # brute-force integrator with roll-off and notch, one sample more: this metric counts samples.
    found = [step_response(finger(*factors), degc, 18e-6) for factors in BOX]
    assert max(m.settling_5_reference_s for m in found) <= 5.6e-3
    assert max(m.overshoot for m in found) <= 0.0049
    assert max(m.static_error for m in found) <= 0.0005


def test_warm_up_moves_the_held_deflection_by_less_than_half_a_micrometre():
    temperatures = TemperatureParameters(profile="step", start=0.1)
    done = run(finger(), FEEDFORWARD, ROBUST, temperatures, Profile([0.0], [20e-6]), 20_000)
    assert np.ptp(done.temperature) == 10.0
    assert np.abs(done.true_deflection[900:] - 20e-6).max() <= 0.5e-6


@pytest.mark.parametrize("damping", [0.5, 1.0])
@pytest.mark.parametrize("resonance", [0.9, 1.0, 1.1])
def test_force_step_stops_ringing(resonance, damping):
    # Open loop: 3 / (zeta omega) = 42 ms nominally.
    static = 3e-6
    force = Profile([0.0, 0.1], [0.0, static / NOMINAL.dynamics.elastic_constant])
    plant = finger(resonance, damping)
    done = run(
        plant, FEEDFORWARD, ROBUST, TemperatureParameters(), Profile([0.0], [5e-6]), 2000, force
    )
    after = done.true_deflection[1000:] - 5e-6
    assert np.abs(after).max() > static
    assert settling_time(done.time[1000:], after, 0.0, 0.05 * static) <= 15e-3
