# SPDX-License-Identifier: Apache-2.0
"""The feedforward law in front of the very operator it inverts, with and without limits."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.hysteresis import Hysteresis, HysteresisParameters
from piezo_control.parameters import ParameterError, build

SAMPLE_TIME = 1e-4
STEEP = FeedforwardParameters(slew_limit=1e6)  # 100 V a sample
ASYMMETRIC = HysteresisParameters(
    upper_thresholds=(6e-6, 12e-6), upper_weights=(0.15, 0.1),
    lower_thresholds=(9e-6,), lower_weights=(-0.2,), rate_coefficient=1e-6,
)  # fmt: skip
commands = st.lists(st.floats(-40e-6, 40e-6), min_size=1, max_size=60)


def test_sine_is_linearised_to_rounding():
    """1 Hz, +-20 um: what Fig. 9 of the paper shows, on the plant of the same model."""
    law = Feedforward(STEEP, SAMPLE_TIME)
    actuator = Hysteresis(HysteresisParameters(), SAMPLE_TIME)
    command = 20e-6 * np.sin(2 * np.pi * np.arange(0.0, 2.0, 2e-3))
    deflection = [actuator.step(law.step(c)) for c in command.tolist()]
    np.testing.assert_allclose(deflection, command, rtol=0, atol=1e-12 * 44e-6)
    assert law.clipped == 0


@given(commands, st.floats(5.0, 60.0), st.floats(1e4, 2e6))
def test_exact_again_at_the_first_sample_without_a_limit(history, voltage_limit, slew_limit):
    parameters = FeedforwardParameters(
        voltage_low=-voltage_limit,
        voltage_high=voltage_limit,
        slew_limit=slew_limit,
        hysteresis=ASYMMETRIC,
    )
    law = Feedforward(parameters, SAMPLE_TIME)
    actuator = Hysteresis(ASYMMETRIC, SAMPLE_TIME)
    last, clipped = 0.0, 0
    for command in history:
        voltage = law.step(command)
        deflection = actuator.step(voltage)
        assert abs(voltage) <= voltage_limit
        assert abs(voltage - last) <= slew_limit * SAMPLE_TIME * (1 + 1e-12)
        if law.clipped == clipped:
            assert deflection == pytest.approx(command, rel=0, abs=1e-12 * 44e-6)
        else:  # a limit acts, so the voltage is at it
            distances = (
                voltage_limit - abs(voltage), slew_limit * SAMPLE_TIME - abs(voltage - last)
            )  # fmt: skip
            assert min(abs(d) for d in distances) < 1e-9
        last, clipped = voltage, law.clipped


def test_state_follows_a_ramp_to_zero_made_by_others():
    law = Feedforward(STEEP, SAMPLE_TIME)
    actuator = Hysteresis(HysteresisParameters(), SAMPLE_TIME)
    voltage = law.step(18e-6)
    actuator.step(voltage)
    for ramp in np.linspace(voltage, 0.0, 50).tolist():
        law.follow(ramp)
        actuator.step(ramp)
    assert actuator.step(law.step(-3e-6)) == pytest.approx(-3e-6, rel=0, abs=1e-17)


def test_static_gain_is_a_division_within_the_limits():
    parameters = FeedforwardParameters(compensator="static_gain", static_gain=5e-7, slew_limit=1e6)
    law = Feedforward(parameters, SAMPLE_TIME)
    assert law.step(10e-6) == pytest.approx(20.0, rel=1e-15)
    assert law.step(-30e-6) == -40.0
    assert law.clipped == 1
    assert law.reachable_range == pytest.approx((-20e-6, 20e-6), rel=1e-12)


@pytest.mark.parametrize("command", [math.nan, math.inf, -math.inf])
def test_commands_that_are_no_number_change_nothing(command):
    law = Feedforward(FeedforwardParameters(), SAMPLE_TIME)
    law.step(5e-6)
    before = copy.deepcopy(law.state)
    with pytest.raises(ValueError, match="command is"):
        law.step(command)
    assert law.state == before


def test_refusal_names_file_and_index():
    values = {"hysteresis.thresholds": [0.0, 1.0], "hysteresis.weights": [1e-7, -2e-7]}
    with pytest.raises(ParameterError, match=r"mine.yaml: hysteresis.'weights\[1\]'"):
        build(FeedforwardParameters, values, "mine.yaml")
