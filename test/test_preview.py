# SPDX-License-Identifier: Apache-2.0
"""Preview: sines of ±20 µm that travel ahead are followed, on the nonlinear finger and with nothing but the law."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from piezo_control.design.preview import asked
from piezo_control.feedback import Feedback, FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_control.shared import shared_folder
from piezo_sim.engine import run
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4
SAMPLES = 2500
PARAMS = shared_folder() / "params"
ROBUST = build(FeedbackParameters, load(PARAMS / "feedback_robust.yaml", "feedback"))
AHEAD = replace(ROBUST, preview_band=150.0)
ONCE_SETTLED = slice(
    1200, SAMPLES - 200
)  # after the start from rest, before the profile's end is felt


def sine(hertz):
    time = H * np.arange(SAMPLES)
    return Profile(time, 20e-6 * np.sin(2.0 * np.pi * hertz * time))


def test_a_rest_stays_where_it_is():
    held = asked(Profile([0.0], [7e-6]), AHEAD)
    assert sum(held.taps) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(held.at(H * np.arange(50)), 7e-6, rtol=1e-12)


def test_values_do_not_depend_on_how_many_are_asked_for_at_once():
    signal = asked(sine(100), AHEAD)
    whole = signal.at(H * np.arange(700))
    parts = [signal.at(H * np.arange(first, first + 7)) for first in range(0, 700, 7)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert np.max(np.abs(whole)) <= signal.largest


def test_without_a_band_or_a_controller_a_signal_is_asked_for_as_it_is():
    signal = sine(10)
    assert asked(signal, ROBUST) is signal
    assert asked(signal, FeedbackParameters(preview_band=150.0)) is signal


@pytest.mark.parametrize("hertz, gain, percent", [(10, 1.0, 1.0), (100, 1.0, 5.0), (10, 1.06, 2.0)])
def test_the_law_stepped_in_python_follows(hertz, gain, percent):
    """Around scipy's sampled D(s), one sample of delay; 1.06: the larger stroke at 32 °C."""
    a, b, _, _, _ = cont2discrete(
        (
            np.array([[0.0, 1.0], [-1.0 / 5.7e-8, -8.1e-6 / 5.7e-8]]),
            np.array([[0.0], [1.0 / 5.7e-8]]),
            np.eye(2)[:1],
            np.zeros((1, 1)),
        ),
        H,
    )
    time = H * np.arange(SAMPLES)
    wanted = sine(hertz).at(time)
    errors = {}
    for name, controller in {"plain": ROBUST, "ahead": AHEAD}.items():
        law, state, late, tip = Feedback(controller), np.zeros((2, 1)), 0.0, []
        for reference in asked(sine(hertz), controller).at(time).tolist():
            tip.append(state[0, 0])
            command = law.step(reference, late)
            late = state[0, 0]
            state = a @ state + b * (gain * command)
        errors[name] = 100.0 * np.abs(np.array(tip) - wanted)[ONCE_SETTLED].max() / 20e-6
    assert errors["ahead"] <= percent
    assert errors["plain"] > 10.0  # without it the loop runs after


@pytest.mark.parametrize(
    "hertz, degc, percent", [(10, 22.0, 1.0), (100, 22.0, 5.0), (10, 32.0, 2.0)]
)
def test_the_nonlinear_finger_follows(hertz, degc, percent):
    done = run(
        CantileverParameters(), FeedforwardParameters(), AHEAD, TemperatureParameters(base_degc=degc),
        sine(hertz), SAMPLES,
    )  # fmt: skip
    error = 100.0 * np.abs(done.true_deflection - done.reference)[ONCE_SETTLED].max() / 20e-6
    assert error <= percent
